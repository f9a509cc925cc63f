"""The built-in suite: robosuite's own tabletop tasks, which need no download.

Robot, controller, control rate, cameras and picture orientation equal those of the LIBERO protocol, so an adapter of a
policy works for both. The task Door is left out: its default agent camera shows only an edge of the door.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from vla_attention.capture.environments.base import ROBOT, Suite, Task
from vla_attention.capture.environments.simulator import SimulatedEnvironment
from vla_attention.capture.environments.task_families import sentence_template
from vla_attention.schemas.groupings.vocabulary import ObjectKind, SceneObject


@dataclass(frozen=True)
class Part:
    """A scene object of a built-in task: its name, its bodies in the simulator, and its kind."""

    name: str
    bodies: tuple[str, ...]
    kind: ObjectKind
    of_interest: bool = True


@dataclass(frozen=True)
class BuiltinTask:
    """A robosuite environment class with an instruction.

    parts: the visible scene objects. Some tasks have further objects that they move out of sight.
    """

    environment: str
    instruction: str
    parts: tuple[Part, ...]


def _pick_place(name: str, noun: str) -> BuiltinTask:
    # The compartments of the target bin show transparent images of all four objects. They count as the bin.
    ghosts = tuple(f"Visual{kind}_main" for kind in ("Milk", "Bread", "Cereal", "Can"))
    parts = (
        Part(name, (f"{name}_main",), "object"),
        Part("bin1", ("bin1",), "fixture", of_interest=False),
        Part("bin2", ("bin2", *ghosts), "fixture"),
    )
    return BuiltinTask(f"PickPlace{name}", f"pick up the {noun} and place it in its compartment of the dark bin", parts)


def _nut_assembly(shape: str, peg: str, other_peg: str) -> BuiltinTask:
    nut = f"{shape.capitalize()}Nut"
    parts = (
        Part(nut, (f"{nut}_main",), "object"),
        Part(peg, (peg,), "fixture"),
        Part(other_peg, (other_peg,), "fixture", of_interest=False),
    )
    return BuiltinTask(f"NutAssembly{shape.capitalize()}", f"put the {shape} nut on the {shape} peg", parts)


BUILTIN_TASKS: tuple[BuiltinTask, ...] = (
    BuiltinTask("Lift", "lift the red cube", (Part("cube", ("cube_main",), "object"),)),
    BuiltinTask(
        "Stack",
        "stack the red cube on top of the green cube",
        (Part("cubeA", ("cubeA_main",), "object"), Part("cubeB", ("cubeB_main",), "object")),
    ),
    _pick_place("Can", "can"),
    _pick_place("Milk", "milk carton"),
    _pick_place("Bread", "bread"),
    _pick_place("Cereal", "cereal box"),
    _nut_assembly("square", peg="peg1", other_peg="peg2"),
    _nut_assembly("round", peg="peg2", other_peg="peg1"),
)


def list_robosuite_tasks(suite: Suite) -> tuple[Task, ...]:
    """Return the built-in tasks in their fixed order."""
    return tuple(
        Task(
            suite.name,
            task_id,
            task.environment,
            task.instruction,
            suite.initial_states_per_task,
            sentence_template(task.instruction),
        )
        for task_id, task in enumerate(BUILTIN_TASKS)
    )


def initial_state_seed(task_name: str, initial_state_index: int) -> int:
    """Return the seed of one initial state of a task. It is the same on every machine."""
    digest = hashlib.sha256(f"{task_name}/{initial_state_index}".encode()).digest()
    return int.from_bytes(digest[:4], "little")


class RobosuiteEnvironment(SimulatedEnvironment):
    """One built-in task.

    Task and index alone determine an initial state, as for LIBERO's stored states: object placement and the small joint
    noise are drawn from a seed made of both. The `seed` of a reset has no effect, because nothing else in these scenes
    is random.
    """

    def _build(self, options: dict[str, Any]) -> Any:
        from robosuite.environments.base import REGISTERED_ENVS

        return self._construct(REGISTERED_ENVS[self.task.name], **options)

    def _reset_seed(self, initial_state_index: int, seed: int) -> int:
        return initial_state_seed(self.task.name, initial_state_index)

    def _set_initial_state(self, initial_state_index: int) -> None:
        """Do nothing: the seeded reset has set the state."""

    def _describe_objects(self) -> tuple[tuple[SceneObject, ...], Mapping[str, Sequence[str]]]:
        parts = BUILTIN_TASKS[self.task.task_id].parts
        described = [SceneObject(part.name, part.kind, part.of_interest) for part in parts]
        roots: dict[str, Sequence[str]] = {part.name: part.bodies for part in parts}
        return self._with_robot_and_background(described), roots | {ROBOT: self._robot_bodies()}
