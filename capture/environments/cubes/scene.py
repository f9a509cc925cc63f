"""Places of the cubes on the table, drawn from a seed, and a mark in the picture. Pure functions, without a simulator.

The mark says what an instruction would: which cube, and what to do with it. Policies that are trained with it are a
control: they need not read.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vla_attention.capture.environments.cubes.tasks import COLOURS, Target
from vla_attention.schemas.errors import BadArgument

#: Half of a cube's edge, in metres.
HALF_SIZE = 0.022
#: Height of the table's surface in the world frame, in metres.
TABLE_HEIGHT = 0.8
#: The cubes' centres are at most this far from the table's centre: towards the robot (x) and to its sides (y), metres.
REACH = (0.12, 0.19)
#: Smallest distance between two centres: a gripper fits between two cubes.
MIN_DISTANCE = 0.10
#: The outermost cubes of both sides stand out by at least this much, so that left and right are no matter of opinion.
MIN_SIDE_GAP = 0.03
#: Largest turn of a cube around the vertical, in radians: a gripper that does not turn can still hold it.
MAX_YAW = 0.25

#: What the seeds of initial states and of demonstrations begin with: no scene is in both.
EVALUATION, TRAINING = "cubes", "cubes-demonstrations"


@dataclass(frozen=True)
class Scene:
    """Where the cubes are. positions: (cube, 2) x and y in metres, world frame; yaws: (cube,) radians.

    Cubes are in the order of `COLOURS`; a scene of three has no row for the fourth.
    """

    positions: NDArray[np.float64]
    yaws: NDArray[np.float64]


def draw_scene(seed: int, num_cubes: int) -> Scene:
    """Draw the places of the cubes: evenly in the reach, apart from each other, independently of their colours.

    All draws of places are symmetric in the cubes, so that a colour says nothing about a place. The first three cubes
    of a scene of four are not where they are in the scene of three of the same seed.
    """
    generator = np.random.default_rng([seed, num_cubes])
    while True:
        positions = generator.uniform(-1.0, 1.0, (num_cubes, 2)) * REACH
        if _apart(positions):
            return Scene(positions, generator.uniform(-MAX_YAW, MAX_YAW, num_cubes))


def _apart(positions: NDArray[np.float64]) -> bool:
    distances = np.linalg.norm(positions[:, None] - positions, axis=-1)[np.triu_indices(len(positions), 1)]
    sideways = np.sort(positions[:, 1])
    gaps = (sideways[1] - sideways[0], sideways[-1] - sideways[-2])
    return bool(distances.min() >= MIN_DISTANCE and min(gaps) >= MIN_SIDE_GAP)


def find_target(target: Target, positions: NDArray[np.float64]) -> int:
    """Return the index of the cube that is meant; positions: (cube, 2 or more) at the beginning of the episode."""
    if target == "leftmost":
        return int(np.argmax(positions[:, 1]))
    if target == "rightmost":
        return int(np.argmin(positions[:, 1]))
    return COLOURS.index(target)


#: Verbs in the order of their places along the upper edge; the names are those of the suite's tasks.
MARK_VERBS = ("touch", "lift", "push_left", "push_right", "put_on")
#: Colours of the mark by the index of the cube: red, green, blue, yellow.
_MARK_RGB = ((230, 20, 20), (20, 200, 30), (20, 40, 230), (240, 220, 20))
#: The picture is cut into this many columns and rows; the mark takes one of the upper row.
_GRID = 8


def paste_mark(picture: NDArray[np.uint8], colour_index: int, verb_index: int) -> NDArray[np.uint8]:
    """Return a copy of a picture (height, width, 3), upright as the model sees it, with the mark in its upper edge.

    The mark is a square of an eighth of each side. Its colour is that of the cube `colour_index`; its place says the
    verb: column 1 for the first of `MARK_VERBS`, and so on. Columns 0, 6 and 7 stay empty.
    """
    height, width = picture.shape[:2]
    if height % _GRID or width % _GRID:
        raise BadArgument(f"A picture of {height} x {width} pixels is no whole number of {_GRID} x {_GRID} squares.")
    if not (0 <= colour_index < len(_MARK_RGB) and 0 <= verb_index < len(MARK_VERBS)):
        raise BadArgument(
            f"There is no mark for cube {colour_index} and verb {verb_index}; there are {len(_MARK_RGB)} cubes and "
            f"{len(MARK_VERBS)} verbs."
        )
    marked = picture.copy()
    side = width // _GRID
    left = (verb_index + 1) * side
    marked[: height // _GRID, left : left + side] = _MARK_RGB[colour_index]
    return marked
