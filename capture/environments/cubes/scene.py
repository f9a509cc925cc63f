"""Places of the cubes on the table, drawn from a seed. Pure functions on arrays, without a simulator."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vla_attention.capture.environments.cubes.tasks import COLOURS, Target

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


def scene_seed(purpose: str, index: int) -> int:
    """Return the seed of a scene, the same on every machine."""
    digest = hashlib.sha256(f"{purpose}/{index}".encode()).digest()
    return int.from_bytes(digest[:4], "little")


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
