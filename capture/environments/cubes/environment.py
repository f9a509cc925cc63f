"""The environment of the suite `cubes`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from vla_attention.capture.environments.base import ROBOT, EnvironmentSettings, Task
from vla_attention.capture.environments.cubes.scene import EVALUATION, draw_scene, scene_seed
from vla_attention.capture.environments.cubes.tasks import COLOURS, CUBE_TASKS, CubeTask
from vla_attention.capture.environments.simulator import SimulatedEnvironment
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.groupings.vocabulary import SceneObject


class CubesEnvironment(SimulatedEnvironment):
    """One task with cubes.

    The index alone determines the scene, for all tasks with the same number of cubes: the `seed` of a reset has no
    effect. Which objects are of interest depends on the task where it names colours; where it names a place (left,
    right), any of the three can be meant.

    purpose: what the scene's seeds begin with; demonstrations have scenes of their own (`scene.TRAINING`).
    """

    def __init__(self, task: Task, settings: EnvironmentSettings, purpose: str = EVALUATION) -> None:
        self._cube_task: CubeTask = CUBE_TASKS[task.task_id]
        self._purpose = purpose
        super().__init__(task, settings)

    def _build(self, options: dict[str, Any]) -> Any:
        from vla_attention.capture.environments.cubes.table import CubeTable

        return self._construct(CubeTable, self._cube_task, **options)

    def _reset_seed(self, initial_state_index: int, seed: int) -> int:
        return scene_seed(self._purpose, initial_state_index)

    def _reset_simulator(self, initial_state_index: int, seed: int) -> None:
        self._simulator.scene = draw_scene(scene_seed(self._purpose, initial_state_index), self._cube_task.num_cubes)
        self._reset_once()

    def _set_initial_state(self, initial_state_index: int) -> None:
        """Do nothing: the reset has set the state."""

    def _describe_objects(self) -> tuple[tuple[SceneObject, ...], Mapping[str, Sequence[str]]]:
        task = self._cube_task
        names = [f"{colour}_cube" for colour in COLOURS[: task.num_cubes]]
        named = {f"{colour}_cube" for colour in (task.target, task.destination) if colour in COLOURS}
        cubes = [SceneObject(name, "object", of_interest=name in named or not named) for name in names]
        roots: dict[str, Sequence[str]] = {name: (f"{name}_main",) for name in names}
        return self._with_robot_and_background(cubes), roots | {ROBOT: self._robot_bodies()}

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

    def switch_task(self, task: CubeTask) -> None:
        """Ask for another task from now on, in the middle of an episode; nothing counts as touched before."""
        self.give_task(task)
        self._simulator.begin_task()

    @property
    def named_cube(self) -> str:
        """Name of the cube that the task asks for in this episode."""
        return f"{COLOURS[self._simulator.target]}_cube"

    @property
    def first_touched(self) -> str | None:
        """Name of the cube that the gripper touched first in this episode; None before."""
        touched = self._simulator.first_touched
        return None if touched is None else f"{COLOURS[touched]}_cube"
