"""The environment of the suite `cubes`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vla_attention.capture.environments.base import EnvironmentSettings, StepResult, Task, initial_state_seed
from vla_attention.capture.environments.cubes.scene import EVALUATION, MARK_VERBS, draw_scene, paste_mark
from vla_attention.capture.environments.cubes.tasks import COLOURS, CUBE_TASKS, MARK_ONLY, MARKED, CubeTask
from vla_attention.capture.environments.episode_protocol import CAMERAS
from vla_attention.capture.environments.simulator import SimulatedEnvironment, goal_of
from vla_attention.schemas.episode_steps import TaskGoal
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.groupings.vocabulary import SceneObject

#: Name of the mark as a scene object, and the camera whose pictures have it.
MARK, MARKED_CAMERA = "mark", CAMERAS[0]


class CubesEnvironment(SimulatedEnvironment):
    """One task with cubes.

    The index alone determines the scene, for all tasks with the same number of cubes: the `seed` of a reset has no
    effect. Which objects are of interest depends on the task where it names colours; where it names a place (left,
    right), any of the three can be meant.

    In the suites with a mark, the agent camera's pictures have it, and it is a scene object.

    purpose: what the scene's seeds begin with; demonstrations have scenes of their own (`scene.TRAINING`).
    """

    def __init__(
        self,
        task: Task,
        settings: EnvironmentSettings,
        suite_tasks: Sequence[Task] = (),
        purpose: str = EVALUATION,
    ) -> None:
        self._cube_task: CubeTask = CUBE_TASKS[task.task_id]
        self._purpose = purpose
        self._has_mark = task.suite in (MARKED, MARK_ONLY)
        super().__init__(task, settings, suite_tasks)

    def _build(self, options: dict[str, Any]) -> Any:
        from vla_attention.capture.environments.cubes.table import CubeTable

        return self._construct(CubeTable, self._cube_task, **options)

    def _reset_seed(self, initial_state_index: int, seed: int) -> int:
        return initial_state_seed(self._purpose, initial_state_index)

    def _reset_simulator(self, initial_state_index: int, seed: int) -> None:
        self._simulator.scene = draw_scene(
            initial_state_seed(self._purpose, initial_state_index), self._cube_task.num_cubes
        )
        self._reset_once()

    def _describe_objects(self) -> tuple[Iterable[SceneObject], Mapping[str, Sequence[str]]]:
        names, named = _cubes_of(self._cube_task), _named_cubes(self._cube_task)
        cubes = [SceneObject(name, "object", of_interest=name in named) for name in names]
        if self._has_mark:
            cubes.append(SceneObject(MARK, "object", of_interest=True))  # no body: it exists in pictures only
        return cubes, {name: (f"{name}_main",) for name in names}

    def _scene_goals(self) -> Sequence[TaskGoal]:
        sharing = [
            (task, CUBE_TASKS[task.task_id])
            for task in self._suite_tasks
            if CUBE_TASKS[task.task_id].num_cubes == self._cube_task.num_cubes
        ]
        self._sharing = [cube_task for _, cube_task in sharing]
        return [goal_of(task, (cube_task.name,), _named_cubes(cube_task)) for task, cube_task in sharing]

    def _held(self) -> Sequence[bool]:
        return [self._simulator.solves(task) for task in self._sharing]

    def step(self, action: NDArray[np.floating], observe: bool) -> StepResult:
        """Advance by one control step; see `Environment.step`."""
        result = super().step(action, observe)
        if not self._has_mark or result.observation is None:
            return result
        images = dict(result.observation.images)
        images[MARKED_CAMERA] = self._marked(images[MARKED_CAMERA])
        return replace(result, observation=replace(result.observation, images=images))

    def segmentation(self, camera: str) -> NDArray[np.int32]:
        """Return the object of every pixel of the last picture; see `Environment.segmentation`."""
        segmentation = super().segmentation(camera)
        if self._has_mark and camera == MARKED_CAMERA:
            plain = np.zeros((*segmentation.shape, 3), dtype=np.uint8)
            number = [thing.name for thing in self.objects].index(MARK)
            segmentation = np.where(self._marked(plain).any(axis=2), np.int32(number), segmentation)
        return segmentation

    def _marked(self, picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
        # The simulator's pictures have the bottom row first; a mark is pasted into the picture as policies get it.
        verb = MARK_VERBS.index(self._cube_task.verb)
        marked = paste_mark(np.ascontiguousarray(picture[::-1, ::-1]), self._simulator.target, verb)
        return np.ascontiguousarray(marked[::-1, ::-1])

    @property
    def simulator(self) -> Any:
        """The `CubeTable`, for experts and demonstrations, which see the simulation state."""
        return self._simulator

    def give_task(self, task: CubeTask) -> None:
        """Ask for another task with the same number of cubes from the next reset on."""
        if task.num_cubes != self._cube_task.num_cubes:
            raise BadArgument(
                f"This table has {self._cube_task.num_cubes} cubes, and the task '{task.name}' needs {task.num_cubes}."
            )
        self._cube_task = task
        self._simulator.task = task


def _cubes_of(task: CubeTask) -> list[str]:
    return [f"{colour}_cube" for colour in COLOURS[: task.num_cubes]]


def _named_cubes(task: CubeTask) -> list[str]:
    """The cubes that a task is about: those of its colours, or all where it names a place."""
    named = [f"{colour}_cube" for colour in (task.target, task.destination) if colour in COLOURS]
    return named or _cubes_of(task)
