"""The difference of a quantity between two classes of episodes, such as those of two runs. Pure numpy functions.

The mean of a class is that over its tasks of the tasks' means. Intervals are those of `intervals`: families of tasks,
or tasks where no family is known, are the units where both classes have several, else episodes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vla_attention.analyze.statistics.family_errors import family_shares
from vla_attention.analyze.statistics.intervals import ROUNDING, UNKNOWN, Estimate, strata_error, welch_degrees
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


def mean_difference(values: ArrayLike, is_first: ArrayLike, units: Units, decide: bool = False) -> MeanDifference:
    """Compare the episodes for which `is_first` is true with the others.

    Args:
        values: (episode,) one value per episode; values that are not finite are left out.
        is_first: (episode,) bool.
        units: the episodes' tasks and families, and what the interval is about.
        decide: about these tasks, where a class has too few families for other tasks; else it then has no error.
    """
    sample, chosen = np.asarray(values, dtype=np.float64), np.asarray(is_first, dtype=bool)
    finite = np.isfinite(sample)
    x = np.where(finite, sample, 0.0)
    first, second = finite & chosen, finite & ~chosen
    cells = _TaskCells.of(x, first, units), _TaskCells.of(x, second, units)
    units = units.decided(first, second) if decide else units
    known = all(cell.num_tasks for cell in cells)
    mean_first, mean_second = (cell.mean if cell.num_tasks else None for cell in cells)
    difference = _difference(cells, units) if known else UNKNOWN
    return MeanDifference(int(first.sum()), int(second.sum()), mean_first, mean_second, difference, units.estimand)


@dataclass(frozen=True)
class _TaskCells:
    """The episodes of one class by task: number, mean and sum of squared deviations, each (task,); 0 where none."""

    size: NDArray[np.float64]
    means: NDArray[np.float64]
    squares: NDArray[np.float64]

    @classmethod
    def of(cls, x: NDArray[np.float64], member: NDArray[np.bool_], units: Units) -> _TaskCells:
        count, task_of = len(units.clusters), units.tasks
        size = np.bincount(task_of[member], minlength=count).astype(np.float64)
        total: NDArray[np.float64] = np.bincount(task_of[member], x[member], minlength=count).astype(np.float64)
        means = np.divide(total, size, out=np.zeros(count), where=size > 0)
        deviations = (x[member] - means[task_of[member]]) ** 2
        return cls(size, means, np.bincount(task_of[member], deviations, minlength=count).astype(np.float64))

    @property
    def num_tasks(self) -> int:
        return int((self.size > 0).sum())

    @property
    def mean(self) -> float:
        return float(self.means.sum() / self.num_tasks)


def _difference(sides: tuple[_TaskCells, _TaskCells], units: Units) -> Estimate:
    """Difference of the means of two classes.

    The units are families of tasks, tasks, or the episodes of every (class, task). Where there are several tasks, and
    other tasks are what the interval is about, one task shows nothing about them: no error.
    """
    value = sides[0].mean - sides[1].mean
    several = bool(((sides[0].size > 0) | (sides[1].size > 0)).sum() > 1)
    if several and units.estimand.of_other_tasks:
        variance, degrees = _between_clusters(sides, units)
    else:
        squares, sizes = (np.concatenate([getattr(side, name) for side in sides]) for name in ("squares", "size"))
        divisors = np.repeat([float(side.num_tasks) for side in sides], [len(side.size) for side in sides])
        squared_error, freedom = strata_error(squares, sizes, divisors)
        variance, degrees = float(squared_error), math.floor(freedom) if np.isfinite(freedom) else 0
    largest = max(float(np.abs(side.means).max()) for side in sides)
    # The variance is not a number with too few clusters, and where a stratum has a single episode.
    if not variance > (ROUNDING * largest) ** 2 or degrees < 1:
        return Estimate(value)
    return Estimate(value, math.sqrt(variance), degrees)


def _between_clusters(sides: tuple[_TaskCells, _TaskCells], units: Units) -> tuple[float, float]:
    """Variance of the difference and its degrees of freedom, with families of tasks, or tasks, as the units.

    This is the bias-reduced linearisation of the regression on both classes: its residuals are those of the means.
    """
    clusters = units.clusters
    parts = [family_shares(side.means - side.mean, side.size > 0, clusters, units.fewest_clusters) for side in sides]
    (first, first_degrees), (second, second_degrees) = parts
    # A cluster in both classes moves both means: its deviations are subtracted before they are squared.
    variance = float(((first - second) ** 2).sum())
    shared = set(clusters[sides[0].size > 0]) & set(clusters[sides[1].size > 0])
    if shared or not math.isfinite(variance):
        return variance, float(np.minimum(first_degrees, second_degrees))
    of_side = np.array([(share**2).sum() for share in (first, second)])
    degrees = float(welch_degrees(of_side, np.array([first_degrees, second_degrees])))
    return variance, degrees if units.families is not None else float(np.floor(degrees))
