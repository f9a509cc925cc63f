"""Effect sizes: how much larger a quantity is in one of two classes of episodes, such as solved and failed.

A contrast gives two differences. `difference` is that of the classes' means, each the mean over its tasks of the tasks'
means. Where some tasks are solved more often than others, it also contains the difference between tasks.
`within_tasks` does not: it is the mean over the tasks with both classes of the difference inside the task.

Their intervals are those of `intervals`: families of tasks, or tasks where no family is known, are the units where both
classes have several, else episodes. Effect sizes are over all episodes of a class, which weigh the same whatever their
task; their standard errors come from leaving out one unit after the other (jackknife: Efron & Tibshirani 1993, chapter
11), with Student's t. Fewer than `FEWEST_EPISODES` in either class show too little of their own spread, and have no
such interval. Pure numpy functions of one value per episode.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vla_attention.analyze.statistics.family_errors import family_shares
from vla_attention.analyze.statistics.intervals import (
    DEFAULT_LEVEL,
    NO_LIMITS,
    ROUNDING,
    UNKNOWN,
    Estimate,
    named_interval,
    strata_error,
    to_scale,
    welch_degrees,
)
from vla_attention.analyze.statistics.units import Estimand, Units

#: Each class needs at least this many episodes for a comparison.
FEWEST = 2
#: Each class needs at least this many episodes for the interval of an effect size, and this many tasks where tasks are
#: the units; where their families are, `units.FEWEST_FAMILIES`.
FEWEST_EPISODES, FEWEST_TASKS = 5, 3
_BETWEEN_MINUS_ONE_AND_ONE = (-1.0, 1.0)
#: Leave-one-out samples handled at once where all pairs of episodes are compared.
_AT_ONCE = 256


@dataclass(frozen=True)
class Contrast:
    """A quantity in two classes of episodes, first minus second; None (with a `note`) where it cannot be computed.

    Attributes:
        num_first, num_second: episodes of either class with a finite value.
        mean_first, mean_second: means over tasks of the means over these.
        difference: mean_first - mean_second.
        within_tasks: the mean difference inside tasks, over the `num_tasks_with_both` tasks with both classes.
        hedges_g: the difference between all episodes of either class, in standard deviations.
        cliffs_delta: P(first > second) - P(first < second).
        note: why something is missing.
        estimand: what the intervals are about: these tasks, where a class has too few families of tasks.
    """

    num_first: int
    num_second: int
    mean_first: float | None
    mean_second: float | None
    difference: Estimate = UNKNOWN
    within_tasks: Estimate = UNKNOWN
    num_tasks_with_both: int = 0
    hedges_g: Estimate = UNKNOWN
    cliffs_delta: Estimate = UNKNOWN
    note: str = ""
    estimand: Estimand = Estimand.TASKS_LIKE_THESE


def small_sample_factor(degrees: ArrayLike) -> NDArray[np.float64]:
    """J = 1 - 3 / (4 m - 1): makes a standardised difference with m degrees of freedom unbiased (Hedges 1981)."""
    return 1 - 3 / (4 * np.asarray(degrees, dtype=np.float64) - 1)


def hedges_g(first: ArrayLike, second: ArrayLike) -> float | None:
    """Standardised mean difference of two samples (n,) and (m,), corrected for small samples.

    g = J(n + m - 2) * (mean1 - mean2) / s, with s^2 = ((n - 1) s1^2 + (m - 1) s2^2) / (n + m - 2)
    (Hedges 1981, Journal of Educational Statistics 6). None with fewer than two values in either sample, or without
    any spread.
    """
    x, y = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    if len(x) < FEWEST or len(y) < FEWEST:
        return None
    moments = [
        (np.array([float(len(v))]), np.array([v.sum()]), np.array([((v - v.mean()) ** 2).sum()])) for v in (x, y)
    ]
    return _or_none(_standardised(*moments)[0])


def cliffs_delta(first: ArrayLike, second: ArrayLike) -> float | None:
    """P(x > y) - P(x < y) over all pairs of two samples (n,) and (m,): -1 to 1, 0 when neither tends to be larger.

    It needs no spread and no scale, and is the same for values and their logarithms (Cliff 1993, Psychological
    Bulletin 114). None when a sample is empty.
    """
    x, y = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    if len(x) == 0 or len(y) == 0:
        return None
    return float(np.sign(x[:, None] - y[None, :]).mean())


def standardised_mean(differences: ArrayLike, units: Units) -> Estimate:
    """Mean / standard deviation of paired differences (pair,), corrected for small samples: d_z (Cohen 1988) times J.

    `units`: of the pairs. Undefined below `FEWEST_EPISODES` pairs or without any spread.
    """
    sample = np.asarray(differences, dtype=np.float64)
    if len(sample) < FEWEST_EPISODES or not np.ptp(sample) > 0:
        return UNKNOWN
    factor = float(small_sample_factor(len(sample) - 1))

    def value(weights: NDArray[np.float64]) -> NDArray[np.float64]:
        number, total, squares = _moments(weights, sample, np.ones(len(sample), dtype=bool))
        with np.errstate(divide="ignore", invalid="ignore"):
            return factor * total / number / np.sqrt(squares / (number - 1))

    return _jackknife(value, units, [np.ones(len(sample), dtype=bool)])


def contrast(values: ArrayLike, is_first: ArrayLike, units: Units) -> Contrast:
    """Compare the episodes for which `is_first` is true with the others.

    Args:
        values: (episode,) one value per episode; values that are not finite are left out.
        is_first: (episode,) bool.
        units: the episodes' tasks and families, and what the intervals are about; these tasks, where a class has too
            few families for other tasks.
    """
    split = _Classes.of(values, is_first, units)
    x, classes, cells, units = split.x, split.members, split.cells, split.units
    sizes = [int(member.sum()) for member in classes]
    means = [cell.mean if size else None for cell, size in zip(cells, sizes, strict=True)]
    if min(sizes) < FEWEST:
        note = f"{sizes[0]} against {sizes[1]} episodes: at least {FEWEST} of either are needed"
        return Contrast(sizes[0], sizes[1], means[0], means[1], note=note, estimand=units.estimand)
    both = (cells[0].size > 0) & (cells[1].size > 0)
    within = split.difference(both) if both.any() else UNKNOWN

    def standardised(weights: NDArray[np.float64]) -> NDArray[np.float64]:
        first, second = (_moments(weights, x, member) for member in classes)
        return _standardised(first, second)

    def dominance(weights: NDArray[np.float64]) -> NDArray[np.float64]:
        return _dominance(weights, x, *classes)

    return Contrast(
        num_first=sizes[0],
        num_second=sizes[1],
        mean_first=means[0],
        mean_second=means[1],
        difference=split.difference(),
        within_tasks=within,
        num_tasks_with_both=int(both.sum()),
        hedges_g=_jackknife(standardised, units, classes),
        cliffs_delta=_jackknife(dominance, units, classes, _BETWEEN_MINUS_ONE_AND_ONE),
        note="" if both.any() else "no task holds both outcomes: the difference may be one between tasks",
        estimand=units.estimand,
    )


def mean_difference(values: ArrayLike, is_first: ArrayLike, units: Units) -> Estimate:
    """`Contrast.difference` alone; unknown where a class has no finite value.

    Unlike there, it stays about what `units` says: without enough families it has no error.
    """
    split = _Classes.of(values, is_first, units, decide=False)
    first, second = split.cells
    return split.difference() if first.num_tasks and second.num_tasks else UNKNOWN


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

    def part(self, tasks: NDArray[np.bool_]) -> _TaskCells:
        """Without the tasks that are not chosen."""
        return _TaskCells(*(np.where(tasks, values, 0.0) for values in (self.size, self.means, self.squares)))

    @property
    def num_tasks(self) -> int:
        return int((self.size > 0).sum())

    @property
    def mean(self) -> float:
        return float(self.means.sum() / self.num_tasks)


@dataclass(frozen=True)
class _Classes:
    """The episodes of two classes that have a finite value.

    Attributes:
        x: values (episode,), 0 where not finite.
        units: the episodes' tasks and families, and what intervals are about.
        members: (episode,) bool of either class.
        cells: either class by task.
    """

    x: NDArray[np.float64]
    units: Units
    members: tuple[NDArray[np.bool_], NDArray[np.bool_]]
    cells: tuple[_TaskCells, _TaskCells]

    @classmethod
    def of(cls, values: ArrayLike, is_first: ArrayLike, units: Units, decide: bool = True) -> _Classes:
        sample, chosen = np.asarray(values, dtype=np.float64), np.asarray(is_first, dtype=bool)
        finite = np.isfinite(sample)
        x = np.where(finite, sample, 0.0)
        first, second = finite & chosen, finite & ~chosen
        cells = _TaskCells.of(x, first, units), _TaskCells.of(x, second, units)
        return cls(x, units.decided(first, second) if decide else units, (first, second), cells)

    def difference(self, tasks: NDArray[np.bool_] | None = None) -> Estimate:
        """Difference of the means of two classes over all tasks, or over those that are chosen, (task,) bool.

        The units are families of tasks, tasks, or the episodes of every (class, task). Where there are several tasks,
        and other tasks are what the interval is about, one task shows nothing about them: no error.
        """
        sides = self.cells if tasks is None else (self.cells[0].part(tasks), self.cells[1].part(tasks))
        value = sides[0].mean - sides[1].mean
        several = bool(((self.cells[0].size > 0) | (self.cells[1].size > 0)).sum() > 1)
        if several and self.units.estimand.of_other_tasks:
            variance, degrees = self._between_clusters(sides)
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

    def _between_clusters(self, sides: tuple[_TaskCells, _TaskCells]) -> tuple[float, float]:
        """Variance of the difference and its degrees of freedom, with families of tasks, or tasks, as the units.

        This is the bias-reduced linearisation of the regression on both classes: its residuals are those of the means.
        """
        clusters, fewest = self.units.clusters, self.units.fewest_clusters
        parts = [family_shares(side.means - side.mean, side.size > 0, clusters, fewest) for side in sides]
        (first, first_degrees), (second, second_degrees) = parts
        # A cluster in both classes moves both means: its deviations are subtracted before they are squared.
        variance = float(((first - second) ** 2).sum())
        shared = set(clusters[sides[0].size > 0]) & set(clusters[sides[1].size > 0])
        if shared or not math.isfinite(variance):
            return variance, float(np.minimum(first_degrees, second_degrees))
        of_side = np.array([(share**2).sum() for share in (first, second)])
        degrees = float(welch_degrees(of_side, np.array([first_degrees, second_degrees])))
        return variance, degrees if self.units.families is not None else float(np.floor(degrees))


def _jackknife(
    statistic: Callable[[NDArray[np.float64]], NDArray[np.float64]],
    units: Units,
    classes: tuple[NDArray[np.bool_], ...] | list[NDArray[np.bool_]],
    limits: tuple[float, float] = NO_LIMITS,
) -> Estimate:
    """A statistic of weighted episodes, with the standard error from leaving out one unit after the other.

    Args:
        statistic: from weights (sample, episode) to values (sample,).
        units: of the episodes; families of tasks, or tasks, where intervals are about other tasks and every class has
            several, else the episodes of every (class, task).
        classes: (episode,) bool each; the statistic uses the episodes in them.
        limits: of the statistic.
    """
    task_of, cluster_of = units.tasks, units.clusters[units.tasks]
    estimate = _or_none(float(statistic(np.ones((1, len(task_of))))[0]))
    num_clusters = [len(np.unique(cluster_of[member])) for member in classes]
    by_family = units.families is not None
    clusters = units.estimand.of_other_tasks and (by_family or min(num_clusters) > 1)
    fewest = units.fewest_clusters if by_family else FEWEST_TASKS
    few = min(int(member.sum()) for member in classes) < FEWEST_EPISODES or (clusters and min(num_clusters) < fewest)
    low, high = limits
    if estimate is None or few or not low < estimate < high:
        return Estimate(estimate)
    used = np.any(classes, axis=0)
    variances, degrees = [], []
    if clusters:
        names = np.unique(cluster_of[used])
        variances.append(_left_out_variance(statistic(1.0 - (cluster_of[None, :] == names[:, None]))))
        degrees.append(min(num_clusters) - 1.0)
    else:
        for member in classes:
            for task in np.unique(task_of[member]):
                stratum = np.flatnonzero(member & (task_of == task))
                if len(stratum) < 2:
                    return Estimate(estimate)
                weights = np.ones((len(stratum), len(task_of)))
                # The others of the stratum take the weight of the one that is left out.
                weights[:, stratum] = (1.0 - np.eye(len(stratum))) * len(stratum) / (len(stratum) - 1)
                variances.append(_left_out_variance(statistic(weights)))
                degrees.append(len(stratum) - 1.0)
    variance, freedom = float(np.sum(variances)), float(welch_degrees(np.array(variances), np.array(degrees)))
    if not (math.isfinite(variance) and variance > 0):
        return Estimate(estimate)
    return Estimate(estimate, to_scale(estimate, limits)[1] * math.sqrt(variance), int(freedom), limits)


def _left_out_variance(values: NDArray[np.float64]) -> float:
    """(n - 1) / n times the sum of squared deviations of the leave-one-out values (n,); NaN where one is not finite."""
    if not np.isfinite(values).all():  # without that unit all others agree, and a standardised mean is infinite
        return math.nan
    return float((len(values) - 1) / len(values) * ((values - values.mean()) ** 2).sum())


_Moments = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]


def _moments(weights: NDArray[np.float64], x: NDArray[np.float64], member: NDArray[np.bool_]) -> _Moments:
    """Number, sum, and sum of squared deviations of the members, each (sample,)."""
    of_class, values = weights[:, member], x[member]
    number, total = of_class.sum(axis=1), of_class @ values
    # Deviations from the class's mean over all episodes: sums of squares of raw values would lose the last digits.
    centre = values.mean()
    squares = of_class @ (values - centre) ** 2
    with np.errstate(divide="ignore", invalid="ignore"):
        return number, total, squares - (total - number * centre) ** 2 / number


def _standardised(first: _Moments, second: _Moments) -> NDArray[np.float64]:
    degrees = first[0] + second[0] - 2
    with np.errstate(divide="ignore", invalid="ignore"):
        pooled = np.sqrt(np.maximum(first[2] + second[2], 0.0) / degrees)
        gap: NDArray[np.float64] = first[1] / first[0] - second[1] / second[0]
        return small_sample_factor(degrees) * gap / pooled


def _dominance(
    weights: NDArray[np.float64], x: NDArray[np.float64], first: NDArray[np.bool_], second: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Cliff's delta of every weighted sample, (sample,)."""
    signs = np.sign(x[first][:, None] - x[second][None, :])
    values = np.empty(len(weights))
    for start in range(0, len(weights), _AT_ONCE):
        part = weights[start : start + _AT_ONCE]
        above, below = part[:, first], part[:, second]
        with np.errstate(divide="ignore", invalid="ignore"):
            pairs = above.sum(axis=1) * below.sum(axis=1)
            values[start : start + _AT_ONCE] = ((above @ signs) * below).sum(axis=1) / pairs
    return values


def _or_none(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


#: The columns of a contrast in a table: its estimates by name.
CONTRAST_COLUMNS: dict[str, Callable[[Contrast], Estimate]] = {
    "difference": lambda found: found.difference,
    "within_tasks": lambda found: found.within_tasks,
    "hedges_g": lambda found: found.hedges_g,
    "cliffs_delta": lambda found: found.cliffs_delta,
}


def contrast_row(
    found: Contrast, first: str, second: str, level: float = DEFAULT_LEVEL
) -> dict[str, float | int | str | None]:
    """A contrast as a table row.

    Columns: `num_NAME` and `mean_NAME` of either class, `num_tasks_with_both`, and `X`, `X_low`, `X_high` of every X in
    `CONTRAST_COLUMNS`, `intervals` (what these are about), `note`.
    """
    row: dict[str, float | int | str | None] = {
        f"num_{first}": found.num_first,
        f"num_{second}": found.num_second,
        f"mean_{first}": found.mean_first,
        f"mean_{second}": found.mean_second,
        "num_tasks_with_both": found.num_tasks_with_both,
    }
    for name, read in CONTRAST_COLUMNS.items():
        estimate = read(found)
        row |= named_interval(name, estimate.value, estimate.interval(level))
    return row | {"intervals": found.estimand.value, "note": found.note or None}
