"""How the commands that a robot executed moved and turned its hand. Pure functions on arrays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vla_attention.schemas.episode_steps import EXECUTED, HAND, POSES
from vla_attention.schemas.stores.reader import StoredEpisode

Array = NDArray[np.float64]

#: The dimensions of an action that move and turn the hand, along the axes of the world and around them. Every suite of
#: the capture side drives robosuite's Panda arm.
TRANSLATION, ROTATION = slice(0, 3), slice(3, 6)


@dataclass(frozen=True)
class Commands:
    """Of an episode, by replan: the executed commands summed up, and how the hand moved. Each (replan, 3).

    moved: metres. told: sum of the translations. turned: rotation vectors in radians, around the world's axes.
    told_turn: sum of the rotations.
    """

    moved: Array
    told: Array
    turned: Array
    told_turn: Array


@dataclass(frozen=True)
class Fit:
    """How commands move the hand: moved = factor x command, least squares through 0.

    factor: per unit of a command. error: its standard error, jackknife over episodes. explained: part of the squared
    movements of held-out episodes that the others' factor explains, at most 1.
    """

    factor: float
    error: float
    explained: float


def commands_of(episode: StoredEpisode, arrays: Mapping[str, Array]) -> Commands | None:
    """The commands of an episode, from its arrays `POSES` and `EXECUTED`; None where it has none of our simulators."""
    steps = episode.attributes.steps
    if steps is None or not {POSES, EXECUTED} <= arrays.keys():
        return None
    executed, env_step = arrays[EXECUTED], np.array(episode.attributes.env_step)
    starts = env_step - env_step[0]
    if executed.shape[1] != 7 or starts[-1] >= len(executed):
        return None
    hand = arrays[POSES][np.append(starts, len(executed)), steps.bodies.index(HAND)]
    sums = np.add.reduceat(executed, starts, axis=0)
    turned = rotation_vectors(hand[:, 3:])
    return Commands(np.diff(hand[:, :3], axis=0), sums[:, TRANSLATION], turned, sums[:, ROTATION])


def fitted(pairs: Sequence[tuple[Array, Array]]) -> Fit | None:
    """Fit what moved to what was told, each (replan, axis) by episode; None where nothing was told or moved.

    One episode is left out at a time; of a single episode one replan.
    """
    if len(pairs) == 1:
        pairs = [(told[None], moved[None]) for told, moved in zip(*pairs[0], strict=True)]
    sums = np.array([((told * moved).sum(), (told**2).sum(), (moved**2).sum()) for told, moved in pairs])
    both, told, moved = sums.sum(axis=0)
    others = sums.sum(axis=0) - sums
    if len(pairs) < 2 or told <= 0 or moved <= 0 or (others[:, 1] <= 0).any():
        return None
    factors = others[:, 0] / others[:, 1]
    left = (sums[:, 2] - 2 * factors * sums[:, 0] + factors**2 * sums[:, 1]).sum()
    n = len(pairs)
    error = np.sqrt((n - 1) / n * ((factors - factors.mean()) ** 2).sum())
    return Fit(float(both / told), float(error), float(1 - left / moved))


def rotation_vectors(quaternions: Array) -> Array:
    """From each orientation (moment, 4: w, x, y, z) to the next, axis x angle in radians, in the world (moment - 1, 3).

    Of unit quaternions, q_next x conjugate(q); the shorter way round.
    """
    w, v = quaternions[:, 0], quaternions[:, 1:]
    scalar = w[1:] * w[:-1] + (v[1:] * v[:-1]).sum(axis=1)
    vector = -w[1:, None] * v[:-1] + w[:-1, None] * v[1:] - np.cross(v[1:], v[:-1])
    vector = np.where(scalar[:, None] < 0, -vector, vector)
    length = np.linalg.norm(vector, axis=1)
    angle = 2 * np.arctan2(length, np.abs(scalar))
    with np.errstate(invalid="ignore", divide="ignore"):
        found: Array = np.where(length[:, None] > 0, vector / length[:, None], 0.0) * angle[:, None]
    return found
