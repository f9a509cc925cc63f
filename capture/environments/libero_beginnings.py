"""How LIBERO's stored initial states begin under the MuJoCo of the published evaluations, and what begins otherwise.

Of every state it is known, after the waiting steps, where objects stand, and what of the task file's `:init` is so.
Most of that names a region of the table and is not so under any version; known is what holds between two objects, or an
object and furniture. `benchmarks/validation/libero_physics.py` measures both and writes the file.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

FILE = Path(__file__).with_name("libero_beginnings.npz")
#: An object that stands farther than this from its place stands elsewhere. Furniture, which other seeds place up to
#: 18 mm elsewhere, moves what stands on it less.
ELSEWHERE_M = 0.02


@dataclass(frozen=True)
class Beginning:
    """places: object -> (3,) metres, world frame. relations: what holds, in LIBERO's words: `("on", "bowl", "box")`."""

    places: Mapping[str, NDArray[np.float64]]
    relations: tuple[tuple[str, ...], ...]

    def displaced(self, places: Mapping[str, NDArray[np.floating]]) -> dict[str, float]:
        """Return the objects that stand elsewhere, with their distance in metres."""
        moved = {name: float(np.linalg.norm(places[name] - place)) for name, place in self.places.items()}
        return {name: distance for name, distance in moved.items() if distance > ELSEWHERE_M}


def beginning_of(suite: str, task_id: int, initial_state_index: int) -> Beginning | None:
    """Return how a stored state begins; None where that was not measured."""
    task = _measured(suite, task_id)
    if task is None or initial_state_index >= len(task["places"]):
        return None
    places = task["places"][initial_state_index] / 1000  # from millimetres
    holds = task["holds"][initial_state_index]
    relations = [tuple(words.split()) for words, so in zip(task["relations"].tolist(), holds, strict=True) if so]
    return Beginning(dict(zip(task["objects"].tolist(), places, strict=True)), tuple(relations))


#: What the file has of a task, after its name: (object,) names, (state, object, 3) int16 millimetres, (relation,)
#: words, (state, relation) bool.
PARTS = ("objects", "places", "relations", "holds")


@cache
def _measured(suite: str, task_id: int) -> dict[str, NDArray] | None:  # type: ignore[type-arg]  # of several types
    with np.load(FILE) as every:
        if f"{suite}_{task_id}/{PARTS[0]}" not in every.files:
            return None
        return {part: every[f"{suite}_{task_id}/{part}"] for part in PARTS}
