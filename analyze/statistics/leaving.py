"""Where an episode leaves others that began like it. Pure functions on paths.

A path is (moment, quantity) in metres: where the hand is as seen from every named object, and these objects as seen
from one another, so that it is the same wherever on the table they lie. Episodes differ in pace: a moment is held
against the nearest one of another path at most `SLACK` steps before or after it. A path that has ended stays where it
ended.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Steps by which another episode may be ahead or behind.
SLACK = 10
#: Episodes nearer than 1 cm are together, however alike the others are.
TOGETHER = 0.01
#: An episode that is elsewhere in fewer replans than these, at its end, has not left.
FEWEST = 3


def path_of(hand: Array, things: Sequence[Array]) -> Array:
    """The path (moment, quantity) of the hand and of things, each (moment, 3)."""
    seen = [hand - thing for thing in things] or [hand]
    seen += [other - thing for i, thing in enumerate(things) for other in things[i + 1 :]]
    return np.concatenate(seen, axis=1)


def distance(path: Array, other: Array) -> Array:
    """How far a path is from another one at each of its moments (moment,): root mean square over positions, metres."""
    at = np.arange(len(path))[:, None] + np.arange(-SLACK, SLACK + 1)
    apart = ((path[:, None] - other[at.clip(0, len(other) - 1)]) ** 2).sum(axis=2).min(axis=1)
    root: Array = np.sqrt(apart / (path.shape[1] / 3))
    return root


def by_replan(moments: Array, starts: NDArray[np.int64]) -> Array:
    """Means (replan,) of values (moment,) over the moments behind the steps that each replan executed."""
    ends = np.append(starts[1:], len(moments) - 1)
    return np.array([moments[begin + 1 : end + 1].mean() for begin, end in zip(starts, ends, strict=True)])


def band(distances: Sequence[Array], length: int) -> Array:
    """How far apart episodes are that do the same, (replan,): the largest of theirs at each replan and beside it.

    distances: (replan,) each, from one such episode to its own nearest.
    """
    held = np.stack([one[np.arange(length).clip(0, len(one) - 1)] for one in distances])
    largest = np.pad(held.max(axis=0), 1, mode="edge")
    beside: Array = np.maximum(np.max([largest[:-2], largest[1:-1], largest[2:]], axis=0), TOGETHER)
    return beside


def leaves_at(apart: Array, within: Array, fewest: int = FEWEST) -> int | None:
    """The replan from which on an episode is farther apart than `within`, each (replan,), to its end; None: never.

    Being outside in fewer than `fewest` last replans is no leaving.
    """
    inside = np.flatnonzero(apart <= within)
    first = int(inside[-1]) + 1 if len(inside) else 0
    return first if first + min(fewest, len(apart)) <= len(apart) else None
