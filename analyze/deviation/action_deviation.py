"""How far a policy's actions are from a data set's. Pure functions on one episode's arrays.

Dimensions of an action have different units. A deviation is therefore measured in the data set's own spread: 1 is the
root mean square deviation of a policy that always answers with the data set's mean action.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Fewest replans with a value on either side of which a rank correlation is taken.
FEWEST_REPLANS = 4


def scaled_deviation(actions: Array, of_data: Array, counts: NDArray[np.integer], spread: Array) -> Array:
    """(action - data set's action) / spread, over the steps that both have; NaN behind them.

    Args:
        actions: the policy's, (replan, step, dimension).
        of_data: the data set's, (replan, step, dimension); other numbers of steps are allowed.
        counts: (replan,) how many of the data set's steps there are.
        spread: (dimension,) the units; NaN for dimensions that are not compared.

    Returns:
        (replan, step, dimension), with the smaller number of steps.
    """
    steps = min(actions.shape[1], of_data.shape[1])
    found: Array = (actions[:, :steps] - of_data[:, :steps]) / spread
    found[np.arange(steps)[None] >= np.asarray(counts)[:, None]] = np.nan
    return found


def root_mean_square(values: Array, axis: int | tuple[int, ...]) -> Array:
    """Root mean square of the values that are there; NaN where none is."""
    there = np.isfinite(values)
    count = there.sum(axis=axis)
    with np.errstate(invalid="ignore"):
        found: Array = np.sqrt(
            np.where(there, values, 0.0).__pow__(2).sum(axis=axis) / np.where(count > 0, count, np.nan)
        )
    return found


def rank_correlation(first: Array, second: Array) -> float:
    """Spearman's correlation of the places where both are finite; NaN where it is not defined.

    Equal values share their mean rank. It is not defined for fewer than `FEWEST_REPLANS` places, or where one side is
    the same everywhere.
    """
    both = np.isfinite(first) & np.isfinite(second)
    if both.sum() < FEWEST_REPLANS:
        return float("nan")
    x, y = (_ranks(values[both]) for values in (first, second))
    x, y = x - x.mean(), y - y.mean()
    size = float(np.sqrt((x**2).sum() * (y**2).sum()))
    return float((x * y).sum() / size) if size > 0 else float("nan")


def _ranks(values: Array) -> Array:
    _, place, count = np.unique(values, return_inverse=True, return_counts=True)
    last = np.cumsum(count)
    mean: Array = (last - (count - 1) / 2.0)[place]
    return mean
