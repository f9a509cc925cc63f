"""The tasks of the suite `cubes`: instructions, and what each of them asks for.

All tasks with the same number of cubes share their scenes: the initial state of an index is the same in each of them,
so that nothing but the instruction says what is right. Needs no simulator.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from vla_attention.capture.environments.base import Suite, TaskTexts

#: The cubes by colour. The last one is in some scenes only, and no instruction names it.
COLOURS = ("red", "green", "blue", "yellow")
NAMED_COLOURS = COLOURS[:3]

Verb = Literal["touch", "lift", "push_left", "push_right", "put_on"]
#: Which cube is meant: its colour, or its place among the cubes. Left is the robot's left (+y), which is on the left of
#: the pictures that pi policies get.
Target = Literal["red", "green", "blue", "leftmost", "rightmost"]


@dataclass(frozen=True)
class CubeTask:
    """One task.

    destination: the colour of the cube on which the target is put, for `put_on`.
    num_cubes: 3, or 4 with the yellow cube, which no instruction names.
    """

    verb: Verb
    target: Target
    destination: Target | None = None
    num_cubes: int = 3

    @property
    def name(self) -> str:
        """Name of the task, for instance `push_left_red`."""
        place = f"_on_{self.destination}" if self.destination else ""
        extra = "_of_four" if self.num_cubes == len(COLOURS) else ""
        return f"{self.verb.removesuffix('_on')}_{self.target}{place}{extra}"

    @property
    def instruction(self) -> str:
        """The sentence that the policy gets."""
        places = {"leftmost": "the cube on the left", "rightmost": "the cube on the right"}
        return self._sentence(places.get(self.target, f"the {self.target} cube"), str(self.destination))

    @property
    def family(self) -> str:
        """The sentence template: the instruction without its colours and sides, whatever the number of cubes."""
        return self._sentence("the COLOUR cube" if self.target in COLOURS else "the cube on the SIDE", "COLOUR")

    def _sentence(self, target: str, destination: str) -> str:
        return {
            "touch": f"touch {target}",
            "lift": f"lift {target}",
            "push_left": f"push {target} to the left",
            "push_right": f"push {target} to the right",
            "put_on": f"put {target} on the {destination} cube",
        }[self.verb]


def _all_tasks() -> tuple[CubeTask, ...]:
    verbs: tuple[Verb, ...] = ("touch", "lift", "push_left", "push_right")
    colours: tuple[Target, ...] = ("red", "green", "blue")
    tasks = [CubeTask(verb, colour) for verb in verbs for colour in colours]
    tasks += [CubeTask("lift", "leftmost"), CubeTask("lift", "rightmost")]
    tasks += [CubeTask("lift", colour, num_cubes=4) for colour in colours]
    tasks += [CubeTask("put_on", one, other) for one in colours for other in colours if one != other]
    return tuple(tasks)


#: The tasks in the order of their numbers. The first `NUM_BASE_TASKS` share scenes of three cubes and four verbs; the
#: suite `cubes` has those before the ones that put a cube on another, `cubes_harder` has all.
CUBE_TASKS = _all_tasks()
NUM_BASE_TASKS = 12


#: Suites for control policies: the base tasks, with a mark in the picture that says what the instruction says
#: (`scene.paste_mark`). In `cubes_marked` both are given; in `cubes_mark_only` all instructions are `MARK_INSTRUCTION`.
MARKED, MARK_ONLY = "cubes_marked", "cubes_mark_only"
MARK_INSTRUCTION = "do what the mark says"


def list_cube_tasks(suite: Suite) -> list[TaskTexts]:
    """Return the tasks of the suite, or of one of the suites with a mark, in their fixed order."""
    told = {MARK_ONLY: MARK_INSTRUCTION}.get(suite.name)
    # The family says what is to be done, also where the mark says it.
    return [(task.name, told or task.instruction, task.family) for task in CUBE_TASKS[: suite.num_tasks]]
