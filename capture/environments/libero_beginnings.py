"""What LIBERO's task files say of the beginning, where it is so under the MuJoCo of the published evaluations.

A task file's `:init` says what is on or in what. Most of it names a region of the table, which is not so under any
version. The others, between two objects or an object and furniture, were looked at after the waiting steps of every
stored state (`benchmarks/validation/libero_physics.py`); `libero_beginnings.txt` has the states in which they hold.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

FILE = Path(__file__).with_name("libero_beginnings.txt")
#: Its first lines.
HEAD = """\
# Suite, task, what its file says of the beginning: the initial states in which it is so at the first policy call, under
# the MuJoCo of the published evaluations. Written by: python -m benchmarks.validation.libero_physics"""


@dataclass(frozen=True)
class Relation:
    """words: a predicate of LIBERO with its two things, as `("on", "bowl_1", "ramekin_1")`."""

    words: tuple[str, ...]

    @property
    def text(self) -> str:
        """It as people write it: `bowl_1 on ramekin_1`."""
        predicate, first, second = self.words
        return f"{first} {predicate} {second}"


def relations_of(suite: str, task_id: int, initial_state_index: int) -> tuple[Relation, ...]:
    """Return what holds at the first policy call of an initial state under the published MuJoCo."""
    known = _known().get((suite, task_id), ())
    return tuple(relation for relation, states in known if initial_state_index in states)


@cache
def _known() -> dict[tuple[str, int], list[tuple[Relation, frozenset[int]]]]:
    known: dict[tuple[str, int], list[tuple[Relation, frozenset[int]]]] = {}
    for line in FILE.read_text(encoding="utf-8").splitlines():
        if line.startswith("#"):
            continue
        about, _, states = line.partition(":")
        suite, task_id, *words = about.split()
        known.setdefault((suite, int(task_id)), []).append((Relation(tuple(words)), read_numbers(states)))
    return known


def read_numbers(text: str) -> frozenset[int]:
    """Return the numbers of `0-3 7 9-12`."""
    parts = [part.partition("-") for part in text.split()]
    return frozenset(i for first, _, last in parts for i in range(int(first), int(last or first) + 1))


def write_numbers(numbers: list[int]) -> str:
    """Return sorted numbers as `read_numbers` reads them."""
    runs: list[list[int]] = []
    for number in numbers:
        if runs and number == runs[-1][1] + 1:
            runs[-1][1] = number
        else:
            runs.append([number, number])
    return " ".join(str(first) if first == last else f"{first}-{last}" for first, last in runs)
