"""Effect sizes: how much larger a quantity is in one of two classes of episodes, such as solved and failed.

A contrast gives two differences. `difference` is that of the means over all episodes of either class. Where some tasks
are solved more often than others, it also contains the difference between tasks. `within_tasks` does not: it is the
coefficient of the class in a linear model with a constant for every task, which is the mean of the tasks' differences
with weights n_first * n_second / (n_first + n_second). Tasks with one class only have weight 0.

Every interval is a two-level bootstrap (see `bootstrap`); tasks are the units where several tasks have the rarer
class. Pure numpy functions of one value per episode.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vla_attention.analyze.statistics.bootstrap import (
    DEFAULT_LEVEL,
    NO_LIMITS,
    Interval,
    Resamples,
    interval_of_values,
    named_interval,
)

#: Each class needs at least this many episodes for a comparison.
FEWEST = 2
_BETWEEN_MINUS_ONE_AND_ONE = (-1.0, 1.0)
#: Resamples handled at once where all pairs of episodes are compared.
_AT_ONCE = 256


@dataclass(frozen=True)
class Contrast:
    """A quantity in two classes of episodes, first minus second; None (with a `note`) where it cannot be computed.

    Attributes:
        num_first, num_second: episodes of either class with a finite value.
        mean_first, mean_second: means over these.
        difference: mean_first - mean_second, with its interval.
        within_tasks: the difference inside tasks, with its interval, over the `num_tasks_with_both` tasks with both
            classes.
        hedges_g: the difference in standard deviations, with its interval.
        cliffs_delta: P(first > second) - P(first < second), with its interval.
        note: why something is missing.
    """

    num_first: int
    num_second: int
    mean_first: float | None
    mean_second: float | None
    difference: float | None = None
    difference_interval: Interval | None = None
    within_tasks: float | None = None
    within_tasks_interval: Interval | None = None
    num_tasks_with_both: int = 0
    hedges_g: float | None = None
    hedges_g_interval: Interval | None = None
    cliffs_delta: float | None = None
    cliffs_delta_interval: Interval | None = None
    note: str = ""


def hedges_g(first: ArrayLike, second: ArrayLike) -> float | None:
    """Standardised mean difference of two samples (n,) and (m,), corrected for small samples.

    g = J * (mean1 - mean2) / s, with s^2 = ((n - 1) s1^2 + (m - 1) s2^2) / (n + m - 2)
    and J = 1 - 3 / (4 (n + m - 2) - 1) (Hedges 1981, Journal of Educational Statistics 6).
    None with fewer than two values in either sample, or without any spread.
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


def contrast(values: ArrayLike, is_first: ArrayLike, resamples: Resamples, level: float = DEFAULT_LEVEL) -> Contrast:
    """Compare the episodes for which `is_first` is true with the others.

    Args:
        values: (episode,) one value per episode; values that are not finite are left out.
        is_first: (episode,) bool.
        resamples: draws of these episodes.
        level: level of the intervals.
    """
    sample, chosen = np.asarray(values, dtype=np.float64), np.asarray(is_first, dtype=bool)
    finite = np.isfinite(sample)
    classes = (finite & chosen, finite & ~chosen)
    sizes = [int(member.sum()) for member in classes]
    means = [float(sample[member].mean()) if size else None for member, size in zip(classes, sizes, strict=True)]
    if min(sizes) < FEWEST:
        note = f"{sizes[0]} against {sizes[1]} episodes: at least {FEWEST} of either are needed"
        return Contrast(sizes[0], sizes[1], means[0], means[1], note=note)
    x = np.where(finite, sample, 0.0)
    counts = resamples.counts
    num_units = min(resamples.num_units(member) for member in classes)

    def interval(
        of: NDArray[np.float64], estimate: float | None, limits: tuple[float, float] = NO_LIMITS, units: int = num_units
    ) -> Interval | None:
        return interval_of_values(of, estimate, units, level, limits)

    original = np.ones((1, len(x)))
    moments = [[_moments(weights, x, member) for member in classes] for weights in (original, counts)]
    difference = [_mean(first) - _mean(second) for first, second in moments]
    standardised = [_standardised(first, second) for first, second in moments]
    dominance = [_dominance(weights, x, *classes) for weights in (original, counts)]
    within = [_within_tasks(weights, x, classes, resamples.task_of) for weights in (original, counts)]
    both = np.intersect1d(*(resamples.task_of[member] for member in classes))
    in_both = np.isin(resamples.task_of, both)
    units_within = min(resamples.num_units(member & in_both) for member in classes) if len(both) else 0
    estimates = [_or_none(of[0][0]) for of in (difference, within, standardised, dominance)]
    note = "" if len(both) else "no task holds both outcomes: the difference may be one between tasks"
    return Contrast(
        num_first=sizes[0],
        num_second=sizes[1],
        mean_first=means[0],
        mean_second=means[1],
        difference=estimates[0],
        difference_interval=interval(difference[1], estimates[0]),
        within_tasks=estimates[1],
        within_tasks_interval=interval(within[1], estimates[1], units=units_within),
        num_tasks_with_both=len(both),
        hedges_g=estimates[2],
        hedges_g_interval=interval(standardised[1], estimates[2]),
        cliffs_delta=estimates[3],
        cliffs_delta_interval=interval(dominance[1], estimates[3], _BETWEEN_MINUS_ONE_AND_ONE),
        note=note,
    )


_Moments = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]


def _moments(weights: NDArray[np.float64], x: NDArray[np.float64], member: NDArray[np.bool_]) -> _Moments:
    """Number, sum, and sum of squared deviations of the members, each (resample,)."""
    of_class, values = weights[:, member], x[member]
    number, total = of_class.sum(axis=1), of_class @ values
    # Deviations from the class's mean over all episodes: sums of squares of raw values would lose the last digits.
    centre = values.mean()
    squares = of_class @ (values - centre) ** 2
    with np.errstate(divide="ignore", invalid="ignore"):
        return number, total, squares - (total - number * centre) ** 2 / number


def _mean(moments: _Moments) -> NDArray[np.float64]:
    with np.errstate(divide="ignore", invalid="ignore"):
        return moments[1] / moments[0]


def _standardised(first: _Moments, second: _Moments) -> NDArray[np.float64]:
    degrees = first[0] + second[0] - 2
    with np.errstate(divide="ignore", invalid="ignore"):
        pooled = np.sqrt(np.maximum(first[2] + second[2], 0.0) / degrees)
        return (1 - 3 / (4 * degrees - 1)) * (_mean(first) - _mean(second)) / pooled


def _dominance(
    weights: NDArray[np.float64], x: NDArray[np.float64], first: NDArray[np.bool_], second: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Cliff's delta in every resample, (resample,)."""
    signs = np.sign(x[first][:, None] - x[second][None, :])
    values = np.empty(len(weights))
    for start in range(0, len(weights), _AT_ONCE):
        part = weights[start : start + _AT_ONCE]
        above, below = part[:, first], part[:, second]
        with np.errstate(divide="ignore", invalid="ignore"):
            pairs = above.sum(axis=1) * below.sum(axis=1)
            values[start : start + _AT_ONCE] = ((above @ signs) * below).sum(axis=1) / pairs
    return values


def _within_tasks(
    weights: NDArray[np.float64],
    x: NDArray[np.float64],
    classes: tuple[NDArray[np.bool_], NDArray[np.bool_]],
    task_of: NDArray[np.int64],
) -> NDArray[np.float64]:
    """The difference inside tasks in every resample, (resample,)."""
    membership = (task_of[:, None] == np.unique(task_of)[None, :]).astype(np.float64)

    def per_task(member: NDArray[np.bool_]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        of_class = weights * member
        return of_class @ membership, (of_class * x) @ membership

    (number, total), (other_number, other_total) = per_task(classes[0]), per_task(classes[1])
    both = (number > 0) & (other_number > 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        weight = np.where(both, number * other_number / (number + other_number), 0.0)
        gap = np.where(both, total / number - other_total / other_number, 0.0)
        within: NDArray[np.float64] = (weight * gap).sum(axis=1) / weight.sum(axis=1)
    return within


def _or_none(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


#: The columns of a contrast in a table: its value and interval by name.
CONTRAST_COLUMNS: dict[str, Callable[[Contrast], tuple[float | None, Interval | None]]] = {
    "difference": lambda found: (found.difference, found.difference_interval),
    "within_tasks": lambda found: (found.within_tasks, found.within_tasks_interval),
    "hedges_g": lambda found: (found.hedges_g, found.hedges_g_interval),
    "cliffs_delta": lambda found: (found.cliffs_delta, found.cliffs_delta_interval),
}


def contrast_row(found: Contrast, first: str, second: str) -> dict[str, float | int | str | None]:
    """A contrast as a table row.

    Columns: `num_NAME` and `mean_NAME` of either class, `num_tasks_with_both`, and `X`, `X_low`, `X_high` of every X in
    `CONTRAST_COLUMNS`, `note`.
    """
    row: dict[str, float | int | str | None] = {
        f"num_{first}": found.num_first,
        f"num_{second}": found.num_second,
        f"mean_{first}": found.mean_first,
        f"mean_{second}": found.mean_second,
        "num_tasks_with_both": found.num_tasks_with_both,
    }
    for name, read in CONTRAST_COLUMNS.items():
        row |= named_interval(name, *read(found))
    return row | {"note": found.note or None}
