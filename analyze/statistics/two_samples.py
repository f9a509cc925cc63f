"""The difference of a quantity between two classes of episodes, such as those of two runs. Pure numpy functions.

The mean of a class is that over its tasks of the tasks' means. Intervals are those of `intervals`: families of tasks,
or tasks where no family is known, are the units where both classes have several, else episodes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vla_attention.analyze.statistics.intervals import (
    ROUNDING,
    UNKNOWN,
    Estimate,
    family_shares,
    strata_error,
    welch_degrees,
)
from vla_attention.analyze.statistics.units import Estimand, Units


@dataclass(frozen=True)
class MeanDifference:
    """A quantity in two classes of episodes, first minus second.

    Attributes:
        num_first, num_second: episodes of either class with a finite value.
        mean_first, mean_second: means over tasks of the means over these; None without any.
        difference: mean_first - mean_second; unknown where a class has no value.
        estimand: what the interval is about: these tasks, where a class has too few families of tasks.
    """

    num_first: int
    num_second: int
    mean_first: float | None
    mean_second: float | None
    difference: Estimate
    estimand: Estimand


def mean_difference(values: ArrayLike, is_first: ArrayLike, units: Units) -> MeanDifference:
    """Compare the episodes for which `is_first` is true with the others.

    The units are families of tasks, tasks, or the episodes of every (class, task). About these tasks, where a class has
    too few families for other tasks.

    Args:
        values: (episode,) one value per episode; values that are not finite are left out.
        is_first: (episode,) bool.
        units: the episodes' tasks and families, and what the interval is about.
    """
    sample, chosen = np.asarray(values, dtype=np.float64), np.asarray(is_first, dtype=bool)
    finite = np.isfinite(sample)
    classes = finite & chosen, finite & ~chosen
    units = units.decided(*classes)
    member = (units.tasks[:, None] == np.arange(units.num_tasks)).astype(np.float64)  # (episode, task)
    used, x = np.stack(classes).astype(np.float64), np.where(finite, sample, 0.0)
    size = used @ member  # (class, task)
    means = np.divide((used * x) @ member, size, out=np.zeros_like(size), where=size > 0)
    squares = (used * (x - means[:, units.tasks]) ** 2) @ member
    numbers = (size > 0).sum(axis=1)
    both = [float(own.sum() / number) if number else None for own, number in zip(means, numbers, strict=True)]
    difference = UNKNOWN
    if None not in both:
        value = float(means[0].sum() / numbers[0] - means[1].sum() / numbers[1])
        # One task of several shows nothing about others: no error.
        if units.estimand.of_other_tasks and (size > 0).any(axis=0).sum() > 1:
            variance, degrees = _between_clusters(means, size > 0, units)
        else:
            squared_error, freedom = strata_error(squares.ravel(), size.ravel(), np.repeat(numbers, size.shape[1]))
            variance, degrees = float(squared_error), math.floor(freedom) if np.isfinite(freedom) else 0
        # The variance is not a number with too few clusters, and where a stratum has a single episode.
        known = variance > (ROUNDING * np.abs(means).max()) ** 2 and degrees >= 1
        difference = Estimate(value, math.sqrt(variance), degrees) if known else Estimate(value)
    of_class = used.sum(axis=1).astype(int).tolist()
    return MeanDifference(of_class[0], of_class[1], both[0], both[1], difference, units.estimand)


def _between_clusters(means: NDArray[np.float64], there: NDArray[np.bool_], units: Units) -> tuple[float, float]:
    """Variance of the difference and its degrees of freedom, with families of tasks, or tasks, as the units.

    This is the bias-reduced linearisation of the regression on both classes: its residuals are those of the means.

    Args:
        means: (class, task).
        there: which tasks each class has, (class, task).
        units: the tasks' families.
    """
    deviations = means - means.sum(axis=1, keepdims=True) / there.sum(axis=1, keepdims=True)
    shares, degrees = family_shares(deviations, there, units.clusters, units.fewest_clusters)
    # A cluster in both classes moves both means: its deviations are subtracted before they are squared.
    variance = float(((shares[0] - shares[1]) ** 2).sum())
    if set(units.clusters[there[0]]) & set(units.clusters[there[1]]) or not math.isfinite(variance):
        return variance, float(degrees.min())
    welch = float(welch_degrees((shares**2).sum(axis=1), degrees))
    return variance, welch if units.families is not None else float(np.floor(welch))
