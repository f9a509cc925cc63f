"""Summaries and two-level bootstrap intervals. Pure numpy functions on arrays, seeded, no tables and no I/O.

Replans of one episode follow each other within a second and are strongly correlated. The episode is therefore the unit:
every function here takes one value (or one pair of sums) per episode. Resampling has two levels, tasks and then
episodes within the drawn tasks, because episodes of one task share their instruction and their scene (a cluster
bootstrap; Davison & Hinkley 1997, section 3.8).

With several tasks, an interval is about tasks like these: they are taken to be a sample of tasks. With one task it is
about episodes like these of that task. For exactly the tasks in the store the interval is wider than necessary.

Intervals are percentile intervals, widened by a factor for few tasks or episodes (`small_samples`). Plain percentile
intervals of nominal 95 % cover 84 % with 5 episodes of a task and 90 % with 10 tasks that differ. Where tasks do not
differ, two-level intervals cover more than their level, because the noise of episodes enters at both levels (Davison &
Hinkley, the same section).

A ratio can be infinite (no mass in the denominator) or undefined (no mass on either side). Such values are in no mean;
each function here returns how many values it left out.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vla_attention.analyze.statistics.small_samples import widen, widening

DEFAULT_RESAMPLES = 2000
DEFAULT_LEVEL = 0.95
DEFAULT_SEED = 0
#: Natural limits of a quantity, for `mean_over_episodes`. An interval never leaves them.
NO_LIMITS = (-np.inf, np.inf)
POSITIVE = (0.0, np.inf)
SHARE = (0.0, 1.0)
#: Draws made at once. This bounds the working memory to some tens of megabytes for any number of episodes.
_DRAWS_AT_ONCE = 2_000_000
#: Sets of draws that are kept; one takes 16 kB per episode. A store needs one per number of episodes of a task, and a
#: few more.
_KEPT_DRAWS = 64


@dataclass(frozen=True)
class SampleSummary:
    """Five numbers over the finite values of a sample (None without any), and how many values are not finite.

    `std` is the standard deviation of the values themselves (ddof 0), as in the published scripts.
    """

    mean: float | None
    std: float | None
    median: float | None
    min: float | None
    max: float | None
    num_nonfinite: int


@dataclass(frozen=True)
class Interval:
    """An interval. `num_undefined` counts the resamples without a finite value of the statistic; they were left out."""

    low: float
    high: float
    level: float
    num_undefined: int = 0


@dataclass(frozen=True)
class EpisodeStatistic:
    """A statistic over episodes that is a quotient of two sums: g(sum of numerator / sum of denominator).

    Attributes:
        numerator: (episode,) float64.
        denominator: (episode,) float64; for a mean it is 1 for the episodes that are used and 0 for the others.
        used: (episode,) bool, which episodes are used.
        exponentiate: g is exp (geometric mean) instead of the identity.
        limits: natural limits of the quotient before g, which its interval never leaves: `NO_LIMITS`, `POSITIVE`,
            `SHARE`.
    """

    numerator: NDArray[np.float64]
    denominator: NDArray[np.float64]
    used: NDArray[np.bool_]
    exponentiate: bool = False
    limits: tuple[float, float] = NO_LIMITS

    @property
    def num_left_out(self) -> int:
        """Number of episodes that have no finite value and are not used."""
        return int((~self.used).sum())

    @property
    def value(self) -> float | None:
        """The statistic over all episodes; +inf for a positive sum over zero, None when it is undefined."""
        value = float(_quotient(self.numerator.sum(), self.denominator.sum(), self.exponentiate))
        return None if np.isnan(value) else value


@dataclass(frozen=True)
class Resamples:
    """Draws of the two-level bootstrap.

    Attributes:
        counts: (resample, episode) how often each episode was drawn.
        task_of: (episode,) number of each episode's task, from 0.
    """

    counts: NDArray[np.float64]
    task_of: NDArray[np.int64]

    def num_units(self, used: NDArray[np.bool_]) -> int:
        """Number of units of an interval: tasks with used episodes or, with one such task, its used episodes."""
        tasks = len(np.unique(self.task_of[used]))
        return tasks if tasks > 1 else int(used.sum())


def summarize(values: ArrayLike) -> SampleSummary:
    """Summarize a sample of shape (n,) over its finite values; NaN and infinities are counted in `num_nonfinite`."""
    sample = np.asarray(values, dtype=np.float64)
    finite = sample[np.isfinite(sample)]
    left_out = int(sample.size - finite.size)
    if finite.size == 0:
        return SampleSummary(None, None, None, None, None, left_out)
    return SampleSummary(
        mean=float(finite.mean()),
        std=float(finite.std()),
        median=float(np.median(finite)),
        min=float(finite.min()),
        max=float(finite.max()),
        num_nonfinite=left_out,
    )


def geometric_mean(ratios: ArrayLike) -> tuple[float | None, int]:
    """exp(mean(log ratio)) over the finite positive ratios of shape (n,), and how many ratios were left out.

    Unlike the mean, it does not depend on which side is the numerator: geometric_mean(1/x) = 1/geometric_mean(x).
    """
    sample = np.asarray(ratios, dtype=np.float64)
    usable = sample[np.isfinite(sample) & (sample > 0)]
    left_out = int(sample.size - usable.size)
    return (float(np.exp(np.log(usable).mean())) if usable.size else None), left_out


def mean_over_episodes(values: ArrayLike, limits: tuple[float, float] = NO_LIMITS) -> EpisodeStatistic:
    """Mean of one value per episode, shape (episode,); episodes whose value is not finite are left out and counted.

    `limits`: `POSITIVE` for masses and ratios, `SHARE` for fractions; an interval never contains impossible values.
    """
    sample = np.asarray(values, dtype=np.float64)
    used = np.isfinite(sample)
    return EpisodeStatistic(np.where(used, sample, 0.0), used.astype(np.float64), used, limits=limits)


def ratio_of_means_over_episodes(numerator: ArrayLike, denominator: ArrayLike) -> EpisodeStatistic:
    """Mean numerator mass / mean denominator mass, both (episode,). It uses episodes with an infinite ratio."""
    above, below = np.asarray(numerator, dtype=np.float64), np.asarray(denominator, dtype=np.float64)
    used = np.isfinite(above) & np.isfinite(below)
    return EpisodeStatistic(np.where(used, above, 0.0), np.where(used, below, 0.0), used, limits=POSITIVE)


def geometric_mean_over_episodes(log_means: ArrayLike) -> EpisodeStatistic:
    """exp of the mean over episodes of each episode's mean log ratio (natural logarithm), shape (episode,)."""
    mean = mean_over_episodes(log_means)
    return EpisodeStatistic(mean.numerator, mean.denominator, mean.used, exponentiate=True)


def resample_episodes(tasks: ArrayLike, num_resamples: int = DEFAULT_RESAMPLES, seed: int = DEFAULT_SEED) -> Resamples:
    """Draw episodes for the two-level bootstrap: how often each episode is in each resample.

    Tables one draws as many tasks as there are, with replacement. Tables two draws, for each drawn task, as many of its
    episodes as it has, with replacement. With one task only the second level is left: the usual bootstrap over
    episodes. For statistics that are quotients of sums, all resamples are then two matrix products.

    Draws are kept, because many statistics are over the same episodes; labels that sort alike share theirs.

    Args:
        tasks: (episode,) labels of the episodes' tasks. Which episodes are drawn depends on their order.
        num_resamples: number of resamples.
        seed: seed of numpy's default generator; equal arguments give equal counts.
    """
    _, task_of = np.unique(np.asarray(tasks), return_inverse=True)
    return _drawn(task_of.astype(np.int64).tobytes(), num_resamples, seed)


@functools.lru_cache(maxsize=_KEPT_DRAWS)
def _drawn(tasks: bytes, num_resamples: int, seed: int) -> Resamples:
    """The draws for episodes of tasks numbered from 0 (int64 as bytes)."""
    task_of = np.frombuffer(tasks, dtype=np.int64)
    by_task = np.argsort(task_of, kind="stable")
    size = np.bincount(task_of)
    first = np.cumsum(size) - size
    generator = np.random.default_rng(seed)
    num_tasks, num_episodes = len(size), len(task_of)
    slot = np.arange(size.max())
    at_once = max(1, _DRAWS_AT_ONCE // (num_tasks * len(slot)))
    counts = np.empty((num_resamples, num_episodes))
    for start in range(0, num_resamples, at_once):
        rows = min(at_once, num_resamples - start)
        drawn = generator.integers(num_tasks, size=(rows, num_tasks))
        sizes = size[drawn][:, :, None]
        uniform = generator.random((rows, num_tasks, len(slot)))
        # floor(u * n) < n holds for u < 1; tasks with fewer episodes than the largest leave their last slots unused.
        position = first[drawn][:, :, None] + (uniform * sizes).astype(np.int64)
        episode = by_task[np.minimum(position, num_episodes - 1)]
        cell = np.arange(rows)[:, None, None] * num_episodes + episode
        used = slot < sizes
        counts[start : start + rows] = np.bincount(cell[used], minlength=rows * num_episodes).reshape(rows, -1)
    counts.setflags(write=False)
    return Resamples(counts, task_of)


def bootstrap_intervals(
    statistics: Sequence[EpisodeStatistic],
    resamples: Resamples,
    level: float = DEFAULT_LEVEL,
    widened: bool = True,
) -> list[Interval | None]:
    """Intervals of several statistics over the same episodes, with draws from `resample_episodes`.

    None where fewer than two episodes are used: a single episode does not show how much episodes differ.
    `widened=False` gives the plain percentile interval, which covers less than its level with few units.
    """
    if not statistics:
        return []
    above = np.stack([statistic.numerator for statistic in statistics]) @ resamples.counts.T
    below = np.stack([statistic.denominator for statistic in statistics]) @ resamples.counts.T
    values = _quotient(above, below, exponentiate=False)  # (statistic, resample): contiguous for quantiles
    finite = np.isfinite(values)
    tail = (1.0 - level) / 2.0
    # Quantiles of all statistics at once; `_interval` computes them again for the few with undefined resamples. exp is
    # monotonic, so it may be applied to the ends.
    quantiles = np.quantile(np.where(finite, values, 0.0), [tail, 1.0 - tail], axis=1)
    intervals: list[Interval | None] = []
    for i, statistic in enumerate(statistics):
        whole = bool(finite[i].all())
        bounds = quantiles[:, i] if whole else None
        estimate = float(_quotient(statistic.numerator.sum(), statistic.denominator.sum(), exponentiate=False))
        num_units = resamples.num_units(statistic.used)
        interval = _interval(values[i], estimate, num_units, level, statistic.limits, widened, bounds)
        if interval is not None and statistic.exponentiate:
            low, high = np.exp([interval.low, interval.high])
            interval = Interval(float(low), float(high), level, interval.num_undefined)
        intervals.append(interval)
    return intervals


def values_with_intervals(
    statistics: Mapping[str, EpisodeStatistic], resamples: Resamples, level: float = DEFAULT_LEVEL
) -> dict[str, float | None]:
    """Columns `X`, `X_low`, `X_high` of a table row for every statistic X; None without a value or an interval."""
    intervals = bootstrap_intervals(list(statistics.values()), resamples, level)
    row: dict[str, float | None] = {}
    for (name, statistic), interval in zip(statistics.items(), intervals, strict=True):
        row |= named_interval(name, statistic.value, interval)
    return row


def named_interval(name: str, value: float | None, interval: Interval | None) -> dict[str, float | None]:
    """Columns `name`, `name_low`, `name_high` of a table row; None without an interval."""
    low, high = ends(interval)
    return {name: value, f"{name}_low": low, f"{name}_high": high}


def ends(interval: Interval | None) -> tuple[float | None, float | None]:
    """Both ends of an interval; None twice without one."""
    return (None, None) if interval is None else (interval.low, interval.high)


def bootstrap_interval(
    statistic: EpisodeStatistic,
    tasks: ArrayLike,
    num_resamples: int = DEFAULT_RESAMPLES,
    level: float = DEFAULT_LEVEL,
    seed: int = DEFAULT_SEED,
    widened: bool = True,
) -> Interval | None:
    """Two-level interval of one statistic; `tasks` are the episodes' task labels, shape (episode,)."""
    return bootstrap_intervals([statistic], resample_episodes(tasks, num_resamples, seed), level, widened)[0]


def interval_of_values(
    values: NDArray[np.float64],
    estimate: float | None,
    num_units: int,
    level: float = DEFAULT_LEVEL,
    limits: tuple[float, float] = NO_LIMITS,
) -> Interval | None:
    """The widened interval of any statistic, from its values (resample,) and its value over all episodes.

    `num_units`: see `Resamples.num_units`; with fewer than two there is no interval.
    """
    return None if estimate is None else _interval(values, estimate, num_units, level, limits)


def _interval(
    values: NDArray[np.float64],
    estimate: float,
    num_units: int,
    level: float,
    limits: tuple[float, float],
    widened: bool = True,
    bounds: NDArray[np.float64] | None = None,
) -> Interval | None:
    finite = np.isfinite(values)
    if num_units < 2 or not finite.any() or not np.isfinite(estimate):
        return None
    if bounds is None:
        tail = (1.0 - level) / 2.0
        bounds = np.quantile(values[finite], [tail, 1.0 - tail])
    if widened:
        bounds = widen(estimate, bounds, widening(num_units, level), limits)
    return Interval(float(bounds[0]), float(bounds[1]), level, int((~finite).sum()))


def _quotient(above: ArrayLike, below: ArrayLike, exponentiate: bool) -> NDArray[np.float64]:
    with np.errstate(divide="ignore", invalid="ignore"):
        quotient = np.divide(above, below, dtype=np.float64)
    return np.exp(quotient) if exponentiate else quotient
