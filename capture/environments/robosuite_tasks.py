"""The built-in suite: robosuite's own tabletop tasks, which need no download.

Robot, controller, control rate, cameras and picture orientation equal those of the LIBERO protocol, so an adapter of a
policy works for both. The task Door is left out: its default agent camera shows only an edge of the door.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from vla_attention.capture.environments.base import TaskTexts, initial_state_seed
from vla_attention.capture.environments.simulator import SimulatedEnvironment
from vla_attention.capture.environments.task_families import sentence_template
from vla_attention.schemas.groupings.vocabulary import SceneObject


@dataclass(frozen=True)
class BuiltinTask:
    """A robosuite environment class with an instruction.

    parts: the visible scene objects, each with its bodies in the simulator. Some tasks have further objects that they
    move out of sight.
    """

    environment: str
    instruction: str
    parts: Mapping[SceneObject, tuple[str, ...]]


def _pick_place(name: str, noun: str) -> BuiltinTask:
    # The compartments of the target bin show transparent images of all four objects. They count as the bin.
    ghosts = tuple(f"Visual{kind}_main" for kind in ("Milk", "Bread", "Cereal", "Can"))
    parts = {
        SceneObject(name, "object", True): (f"{name}_main",),
        SceneObject("bin1", "fixture", False): ("bin1",),
        SceneObject("bin2", "fixture", True): ("bin2", *ghosts),
    }
    return BuiltinTask(f"PickPlace{name}", f"pick up the {noun} and place it in its compartment of the dark bin", parts)


def _nut_assembly(shape: str, peg: str, other_peg: str) -> BuiltinTask:
    nut = f"{shape.capitalize()}Nut"
    parts = {
        SceneObject(nut, "object", True): (f"{nut}_main",),
        SceneObject(peg, "fixture", True): (peg,),
        SceneObject(other_peg, "fixture", False): (other_peg,),
    }
    return BuiltinTask(f"NutAssembly{shape.capitalize()}", f"put the {shape} nut on the {shape} peg", parts)


def _cubes(environment: str, instruction: str, *names: str) -> BuiltinTask:
    return BuiltinTask(
        environment, instruction, {SceneObject(name, "object", True): (f"{name}_main",) for name in names}
    )


BUILTIN_TASKS: tuple[BuiltinTask, ...] = (
    _cubes("Lift", "lift the red cube", "cube"),
    _cubes("Stack", "stack the red cube on top of the green cube", "cubeA", "cubeB"),
    _pick_place("Can", "can"),
    _pick_place("Milk", "milk carton"),
    _pick_place("Bread", "bread"),
    _pick_place("Cereal", "cereal box"),
    _nut_assembly("square", peg="peg1", other_peg="peg2"),
    _nut_assembly("round", peg="peg2", other_peg="peg1"),
)


def list_robosuite_tasks() -> list[TaskTexts]:
    """Return the built-in tasks in their fixed order."""
    return [(task.environment, task.instruction, sentence_template(task.instruction)) for task in BUILTIN_TASKS]


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

    def _describe_objects(self) -> tuple[Iterable[SceneObject], Mapping[str, Sequence[str]]]:
        parts = BUILTIN_TASKS[self.task.task_id].parts
        return parts, {part.name: bodies for part, bodies in parts.items()}
