"""How far the actions of a rerun are from those of its base. Pure functions on one episode's arrays.

Dimensions of an action have different units (metres, radians, a gripper command). A change is therefore measured in
units of the base run's own spread: 1 is a change as large as the actions of the base differ from each other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vla_attention.analyze.measures.alignment import GRIPPER
from vla_attention.analyze.show.numbers import row_interval
from vla_attention.analyze.statistics.intervals import estimates, ratio_of_means_over_episodes
from vla_attention.analyze.statistics.units import Units

Array = NDArray[np.float64]

#: The dimensions of an action that move the hand. Every suite of the capture side drives robosuite's Panda arm.
TRANSLATION = slice(0, 3)
#: A dimension with less spread than this part of the largest one is not driven by the policy. Division by its spread
#: would make what is left of it, rounding or noise of the denoising, as large as a real movement.
LEAST_SPREAD = 0.01
#: A dimension that another noise seed changes by more than this many spreads is more than half noise: two draws of
#: noise of variance v differ by 2 v on average.
MOST_NOISE = 1.0
#: Why such a dimension is not compared.
MOSTLY_NOISE = "mostly noise"


@dataclass(frozen=True)
class Noise:
    """Root mean square change by another noise seed over all replans and steps, in spreads.

    change: (dimension,); NaN where there is no spread. low, high: ends (dimension,) of its interval over the episodes,
    NaN where there is none (a single episode).
    """

    change: Array
    low: Array
    high: Array

    def cells(self, dimension: int) -> tuple[float, str]:
        """The change of a dimension, and its interval as text."""
        bounds = {"low": float(self.low[dimension]), "high": float(self.high[dimension])}
        return float(self.change[dimension]), "-" if np.isnan(bounds["low"]) else row_interval(bounds)


@dataclass(frozen=True)
class ActionSpread:
    """The units of changes.

    Attributes:
        spread: (dimension,) standard deviation over all replans and all steps of their chunks.
        used: (dimension,) bool, the dimensions that are compared.
        noise: change by another noise seed; None where it is not known.
        reasons: (dimension,) why a dimension is not compared; empty for those that are.
    """

    spread: Array
    used: NDArray[np.bool_]
    noise: Noise | None = None
    reasons: tuple[str, ...] = ()

    @property
    def left_out(self) -> tuple[int, ...]:
        """The dimensions that are not compared."""
        return tuple(int(i) for i in np.flatnonzero(~self.used))


def action_spread(actions: Sequence[Array], dimensions: Sequence[int] | None = None) -> ActionSpread:
    """The spread of the base run's actions, each (replan, step, dimension); steps may differ in number.

    `dimensions`: only these are compared. A dimension without spread (see `LEAST_SPREAD`) is never compared.
    """
    flat = np.concatenate([chunk.reshape(-1, chunk.shape[-1]) for chunk in actions])
    spread = flat.std(axis=0)
    moves = spread > LEAST_SPREAD * spread.max(initial=0.0)
    chosen = np.isin(np.arange(len(spread)), list(dimensions)) if dimensions is not None else np.ones_like(moves)
    reasons = ["no spread" if not a else "" if b else "not chosen" for a, b in zip(moves, chosen, strict=True)]
    return ActionSpread(spread, moves & chosen, reasons=tuple(reasons))


def with_noise(spread: ActionSpread, noise: Noise, leave_out: bool) -> ActionSpread:
    """The same with the change by another noise seed; `leave_out`: dimensions that are mostly noise are not compared.

    Such a dimension would make every effect as large as its noise. It is left out where the whole interval lies above
    `MOST_NOISE`, so that no chance of the episodes decides; where all of them would be, all are kept.
    """
    mostly = spread.used & (noise.low > MOST_NOISE)
    if not leave_out or mostly[spread.used].all():
        return replace(spread, noise=noise)
    reasons = [MOSTLY_NOISE if drop else reason for drop, reason in zip(mostly, spread.reasons, strict=True)]
    return replace(spread, used=spread.used & ~mostly, noise=noise, reasons=tuple(reasons))


def noise_of(pairs: Sequence[tuple[Array, Array]], spread: Array) -> Noise:
    """The change by another noise seed, with its interval over episodes.

    pairs: per episode the actions (replan, step, dimension) of the base and of a rerun.
    """
    squares = np.array([((other - base) ** 2).sum(axis=(0, 1)) for base, other in pairs]).T  # (dimension, episode)
    number = np.array([base.shape[0] * base.shape[1] for base, _ in pairs], dtype=np.float64)
    statistic = ratio_of_means_over_episodes(squares, np.broadcast_to(number, squares.shape))
    # The episodes are those of which the units are, whatever their tasks.
    spreads = estimates([statistic], Units.of(np.zeros(len(pairs))))
    # Several episodes that do not differ agree on the value; a single one says nothing of others.
    alike = (np.nan, np.nan) if len(pairs) < 2 else None
    intervals = [(one.interval(), one.value) for one in spreads]
    ends = np.array(
        [(interval.low, interval.high) if interval else alike or (value, value) for interval, value in intervals],
        np.float64,
    )
    values = np.array([[one.value for one in spreads], *ends.T], dtype=np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        change, low, high = np.where(spread > 0, np.sqrt(values) / spread, np.nan)
    return Noise(change, low, high)


def root_mean_square_change(base: Array, other: Array, spread: ActionSpread, steps: NDArray[np.int64]) -> Array:
    """Root mean square over the first steps of each chunk, and over dimensions, of the change in units of the spread.

    Args:
        base, other: actions (replan, step, dimension).
        spread: the units.
        steps: (replan,) how many steps of each chunk count, at least 1.

    Returns:
        (replan,).
    """
    change = (other - base)[..., spread.used] / spread.spread[spread.used]
    squares = (change**2).mean(axis=2)
    result: Array = np.sqrt((squares * counted(steps, squares.shape[1])).sum(axis=1) / steps)
    return result


def first_angle(base: Array, other: Array) -> Array:
    """Angle in degrees (replan,) between the translations of the first actions; NaN where one of them is zero."""
    with np.errstate(divide="ignore", invalid="ignore"):
        first, second = (
            part / np.linalg.norm(part, axis=1, keepdims=True)
            for part in (base[:, 0, TRANSLATION], other[:, 0, TRANSLATION])
        )
    # Kahan's formula: exact for small angles, where the arc cosine loses half of the digits.
    angle: Array = np.degrees(
        2 * np.arctan2(np.linalg.norm(first - second, axis=1), np.linalg.norm(first + second, axis=1))
    )
    return angle


def gripper_flips(base: Array, other: Array, steps: NDArray[np.int64]) -> Array:
    """Share (replan,) of the first `steps` steps in which the gripper command has the other sign."""
    flipped = base[..., GRIPPER] * other[..., GRIPPER] < 0
    share: Array = (flipped * counted(steps, flipped.shape[1])).sum(axis=1) / steps
    return share


def counted(steps: NDArray[np.int64], horizon: int) -> NDArray[np.bool_]:
    """Which steps count, (replan, horizon) bool: the first `steps` (replan,) of each chunk."""
    return np.arange(horizon)[None, :] < steps[:, None]
