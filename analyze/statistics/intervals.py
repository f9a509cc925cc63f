"""Means over episodes and tasks, with intervals. Pure numpy functions on arrays, no draws, no tables and no I/O.

Replans of one episode follow each other within a second and are strongly correlated. The episode is therefore the unit:
every function here takes one value (or one pair of values) per episode. Episodes of one task share their instruction
and their scene, so a mean is the mean over tasks of the tasks' means: every task weighs the same.

An interval is about one of these (`Estimand`):

    tasks like these   the mean over a population of tasks of which the store's tasks are a sample. Tasks of one family
                       are related, so the units are the families, and from four of them on there is an interval: the
                       error is cluster-robust (`family_shares`). Episodes vary inside the tasks' means already. To
                       count them once more, as a bootstrap of tasks and then of episodes does, makes the interval too
                       wide (Field & Welsh 2007, "Bootstrapping clustered data", Journal of the Royal Statistical
                       Society B 69).
                       Where no family is known, the units are the tasks: t = (mean - truth) / (s / sqrt(T)) has T - 1
                       degrees of freedom.
    these tasks        the mean over exactly these tasks, with endless episodes of each. Tasks are strata: the variance
                       is the sum over tasks of s_t^2 / n_t, divided by T^2, with the degrees of freedom of Welch 1947
                       (Biometrika 34; the approximation with n_t + 1 and - 2, which is unbiased for equal variances),
                       and a floor under the variance of small strata (`strata_error`).

With one task both are the same: t over its episodes. A quotient of two means is linearised (delta method), which for
these units is the infinitesimal jackknife (Efron & Tibshirani 1993, "An introduction to the bootstrap", chapter 11).
The interval is symmetric on a scale on which the quantity has no limits: the logarithm for masses and ratios, the
log odds for fractions. `benchmarks/interval_coverage.py` measures the coverage.

The error by families. The estimate is the mean over tasks, and every task weighs the same; only its error is by
families. With T tasks, deviations e_t from the mean and families g of n_g tasks,

    variance = sum over g of (sum of the e_t in g)^2 / (T (T - n_g)).

This is the bias-reduced linearisation of a mean ("CR2": Bell & McCaffrey 2002, "Bias reduction in standard errors for
linear regression with multi-stage samples", Survey Methodology 28): residuals of a family are multiplied by
(I - H_gg)^(-1/2), which for a mean is 1 / sqrt(1 - n_g / T) of their sum. It is unbiased where tasks are independent
and spread alike. The degrees of freedom are Satterthwaite's under the same working model: with p_gh the matrix of the
quadratic form, (sum p_gg)^2 / sum p_gh^2 (Bell & McCaffrey 2002; Pustejovsky & Tipton 2018, "Small-sample methods for
cluster-robust variance estimation and hypothesis testing in fixed effects models", Journal of Business & Economic
Statistics 36). They depend on the sizes of the families alone, and are few where one family has most of the tasks.

With families of one task each, this is s^2 / T with T - 1 degrees of freedom; with G families of equal size, the t
interval over the means of families with G - 1.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vla_attention.analyze.statistics.student import student_quantile, two_sided_p
from vla_attention.analyze.statistics.units import Estimand as Estimand
from vla_attention.analyze.statistics.units import Units

DEFAULT_LEVEL = 0.95
#: Natural limits of a quantity, for `mean_over_episodes`. An interval never leaves them.
NO_LIMITS = (-np.inf, np.inf)
POSITIVE = (0.0, np.inf)
SHARE = (0.0, 1.0)
#: A stratum of fewer episodes than `_FEW` beside larger ones has at least this part of the pooled variance; chosen so
#: that strata of equal spread cover 95 to 97 %.
_FEW, _SMALL_STRATUM = 5, 0.85
#: A spread below this share of the values is rounding. Values without spread have no interval.
ROUNDING = 1e-12
#: An interval of a ratio with ends farther apart than by this factor says nothing of its size: it is not printed. From
#: two units, half of the intervals are longer than 9 standard deviations, from three 3, from four 2.
_WIDEST = 100.0
#: Degrees of freedom this close to a whole number are that number.
_WHOLE = 1e-9


def says_a_size(low: float, high: float) -> bool:
    """Whether the interval of a ratio is narrow enough to be printed."""
    return not 0.0 <= low * _WIDEST < high


class Interval(NamedTuple):
    """Both ends of an interval."""

    low: float
    high: float


@dataclass(frozen=True)
class EpisodeStatistic:
    """A statistic over episodes: g(mean of `numerator` / mean of `denominator`), both means over tasks of task means.

    Or many of one kind over the same episodes, one for each place of the axes before that of the episodes.

    Attributes:
        numerator: (..., episode) float64.
        denominator: (..., episode) float64; 1 for a plain mean.
        used: (..., episode) bool, which episodes are used.
        exponentiate: g is exp (geometric mean) instead of the identity.
        limits: natural limits of the quotient before g: `NO_LIMITS`, `POSITIVE`, `SHARE`.
    """

    numerator: NDArray[np.float64]
    denominator: NDArray[np.float64]
    used: NDArray[np.bool_]
    exponentiate: bool = False
    limits: tuple[float, float] = NO_LIMITS


@dataclass(frozen=True)
class Estimate:
    """A value with its standard error on a scale without limits.

    Attributes:
        value: the statistic; +inf for a positive mean over zero, None when it is undefined.
        error: standard error of `on_scale(value)`, None where there is none: fewer than two units, no spread between
            them, or a value on a limit.
        degrees: degrees of freedom of the error; by families they need not be whole, else they are rounded down.
        limits, exponentiate: as in `EpisodeStatistic`.
    """

    value: float | None
    error: float | None = None
    degrees: float = 0
    limits: tuple[float, float] = NO_LIMITS
    exponentiate: bool = False

    def interval(self, level: float = DEFAULT_LEVEL) -> Interval | None:
        """The interval of this level, None without a standard error."""
        if self.error is None or self.value is None:
            return None
        centre, reach = self._on_scale(self.value), student_quantile(level, self.degrees) * self.error
        return Interval(self._from_scale(centre - reach), self._from_scale(centre + reach))

    def p_value(self, null: float) -> float | None:
        """Two-sided p of the hypothesis that the truth is `null` (inside the limits); None without a standard error."""
        if self.error is None or self.value is None:
            return None
        return two_sided_p((self._on_scale(self.value) - self._on_scale(null)) / self.error, self.degrees)

    def detectable(self, null: float, level: float = 1 - DEFAULT_LEVEL, power: float = 0.8) -> float | None:
        """The smallest truth above `null` that would be shown, with p at most `level`, in this part of such runs.

        A run of this size, whose units scatter as these do; None without a standard error. On a logarithmic scale one
        over it, of the null, is the largest truth below.
        """
        if self.error is None or self.value is None:
            return None
        reach = student_quantile(1 - level, self.degrees) + student_quantile(2 * power - 1, self.degrees)
        return self._from_scale(self._on_scale(null) + reach * self.error)

    def _on_scale(self, value: float) -> float:
        return to_scale(math.log(value) if self.exponentiate else value, self.limits)[0]

    def _from_scale(self, place: float) -> float:
        value = _from_scale(place, self.limits)
        return _exp(value) if self.exponentiate else value


#: No value at all.
UNKNOWN = Estimate(None)


def mean_over_episodes(values: ArrayLike, limits: tuple[float, float] = NO_LIMITS) -> EpisodeStatistic:
    """Mean of one value per episode, shape (..., episode); episodes whose value is not finite are left out and counted.

    `limits`: `POSITIVE` for masses and ratios, `SHARE` for fractions; an interval never contains impossible values.
    """
    sample = np.asarray(values, dtype=np.float64)
    used = np.isfinite(sample)
    return EpisodeStatistic(np.where(used, sample, 0.0), used.astype(np.float64), used, limits=limits)


def ratio_of_means_over_episodes(numerator: ArrayLike, denominator: ArrayLike) -> EpisodeStatistic:
    """Mean numerator mass / mean denominator mass, both (..., episode). It uses episodes with an infinite ratio."""
    above, below = np.asarray(numerator, dtype=np.float64), np.asarray(denominator, dtype=np.float64)
    used = np.isfinite(above) & np.isfinite(below)
    return EpisodeStatistic(np.where(used, above, 0.0), np.where(used, below, 0.0), used, limits=POSITIVE)


def geometric_mean_over_episodes(log_means: ArrayLike) -> EpisodeStatistic:
    """exp of the mean over episodes of each episode's mean log ratio (natural logarithm), (..., episode)."""
    mean = mean_over_episodes(log_means)
    return EpisodeStatistic(mean.numerator, mean.denominator, mean.used, exponentiate=True)


def estimates(statistics: Sequence[EpisodeStatistic], units: Units) -> list[Estimate]:
    """Values and standard errors of several statistics over the same episodes.

    Args:
        statistics: over the same episodes; one of many of a kind gives as many estimates, in C order.
        units: the episodes' tasks and families, and what the intervals are about. Each task counts with the episodes
            that the statistic uses. About tasks like these, the tasks must be of `FEWEST_FAMILIES` families; about
            `THESE_TASKS` every task needs two episodes.
    """
    if not statistics:
        return []
    task_of = units.tasks
    member = (task_of[:, None] == np.arange(len(units.clusters))).astype(np.float64)  # (episode, task)
    used, above, below = (
        np.concatenate([part.reshape(-1, len(task_of)) for part in parts]).astype(np.float64, copy=False)
        for parts in zip(*((one.used, one.numerator, one.denominator) for one in statistics), strict=True)
    )
    # (statistic, episode) each, and there can be thousands of both: what can be is done in place.
    above *= used
    below *= used
    size = used @ member  # (statistic, task)
    num_tasks = (size > 0).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        task_above, task_below = (np.where(size > 0, (part @ member) / size, 0.0) for part in (above, below))
        mean_above, mean_below = (part.sum(axis=1) / num_tasks for part in (task_above, task_below))
        quotient = mean_above / mean_below
        # One episode's, and one task's, share in the deviation of the quotient from its truth, to first order.
        by_task = (task_above - quotient[:, None] * task_below) / mean_below[:, None]
        largest = np.maximum(above.max(axis=1, initial=0.0), -above.min(axis=1, initial=0.0))
        scale = np.where(mean_below == 0, 0.0, largest / mean_below)
        below *= quotient[:, None]
        above -= below
        above /= mean_below[:, None]
        above -= by_task[:, task_of]
        above *= above
        above *= used
        squares = above @ member
    variance, degrees = strata_error(squares, size, num_tasks[:, None])
    degrees = np.floor(degrees)
    if units.estimand.of_other_tasks:
        between, of_clusters = family_error(by_task, size > 0, units.clusters, units.fewest_clusters)
        # A single task whose family nobody knows: an interval over its episodes, as nothing says how tasks differ.
        clusters = (num_tasks > 1) | (units.families is not None)
        variance, degrees = np.where(clusters, between, variance), np.where(clusters, of_clusters, degrees)
    kinds = [statistic for statistic in statistics for _ in range(statistic.used.size // len(task_of))]
    each = zip(*(part.tolist() for part in (quotient, variance, degrees, scale)), kinds, strict=True)
    return [_estimate(*one) for one in each]


def family_shares(
    deviations: NDArray[np.float64], there: NDArray[np.bool_], families: NDArray[np.intp], fewest: int = 2
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """What each family adds to the error of a mean over tasks: its square is a part of the variance.

    Args:
        deviations: from the mean, (..., task).
        there: which tasks the mean is over, (..., task).
        families: number of each task's family, (task,).
        fewest: with fewer families in the mean there is no error.

    Returns:
        Shares (..., family), 0 where a family has no task in the mean, and the degrees of freedom (...); NaN where
        there is no error.
    """
    member = (families[:, None] == np.arange(families.max(initial=-1) + 1)).astype(np.float64)  # (task, family)
    sums, size = np.where(there, deviations, 0.0) @ member, there.astype(np.float64) @ member
    total = size.sum(axis=-1, keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        shares = np.where(size > 0, sums / np.sqrt(total * (total - size)), 0.0)
        # p_gg = n_g / T^2 and p_gh^2 = a_g a_h / T^2, with a_g = n_g^2 / (T (T - n_g)).
        a = size**2 / (total * (total - size))
        off_diagonal = a.sum(axis=-1) ** 2 - (a**2).sum(axis=-1)
        degrees = 1.0 / ((size**2).sum(axis=-1) / total[..., 0] ** 2 + off_diagonal)
    enough = (size > 0).sum(axis=-1) >= max(fewest, 2)
    whole = np.round(degrees)
    degrees = np.where(np.abs(degrees - whole) < _WHOLE, whole, degrees)
    return np.where(enough[..., None], shares, np.nan), np.where(enough, degrees, np.nan)


def family_error(
    deviations: NDArray[np.float64], there: NDArray[np.bool_], families: NDArray[np.intp], fewest: int = 2
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Variance of a mean over tasks and its degrees of freedom, (...) each; the arguments are those of
    `family_shares`.
    """
    shares, degrees = family_shares(deviations, there, families, fewest)
    variance: NDArray[np.float64] = (shares**2).sum(axis=-1)
    return variance, degrees


def strata_error(
    squares: NDArray[np.float64], size: NDArray[np.float64], num_tasks: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Variance of a sum of stratum means, each divided by `num_tasks`, and its degrees of freedom, (...) each.

    The variance of two to four episodes is often far too small, and where such a stratum stands beside much larger
    ones, it decides the whole: 2 + 50 episodes would cover 85 %. A stratum of fewer than five, and of fewer than half
    of the largest, therefore has at least `_SMALL_STRATUM` of the pooled variance of all strata.

    Args:
        squares: sums of squared deviations from the stratum's mean, (..., stratum).
        size: episodes of the strata, (..., stratum); 0 where a stratum is not there.
        num_tasks: the divisor, of a shape that broadcasts.

    Returns:
        NaN where a stratum has a single episode.
    """
    has_episodes, degrees = size > 0, np.maximum(size - 1, 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        of_its_own = squares / (size - 1)
        freedom = degrees.sum(axis=-1, keepdims=True)
        pooled = _SMALL_STRATUM * np.where(has_episodes, squares, 0.0).sum(axis=-1, keepdims=True) / freedom
        small = has_episodes & (size < _FEW) & (size < size.max(axis=-1, keepdims=True) / 2) & (of_its_own < pooled)
        of_stratum = np.where(has_episodes, np.where(small, pooled, of_its_own) / size, 0.0) / num_tasks**2
    variance: NDArray[np.float64] = of_stratum.sum(axis=-1)
    return variance, welch_degrees(of_stratum, np.where(small, freedom, degrees))


def welch_degrees(variances: NDArray[np.float64], degrees: NDArray[np.float64]) -> NDArray[np.float64]:
    """Degrees of freedom of a sum of independent variances (..., part) with `degrees` (..., part) each (Welch 1947).

    (sum v)^2 / sum(v^2 / (d + 2)) - 2, at least the smallest and at most the sum of the parts' degrees; parts without
    degrees count nothing.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        raw = variances.sum(axis=-1) ** 2 / (variances**2 / (degrees + 2)).sum(axis=-1) - 2
    known = degrees > 0
    fewest = np.where(known, degrees, np.inf).min(axis=-1)
    clipped: NDArray[np.float64] = np.clip(raw, fewest, np.where(known, degrees, 0.0).sum(axis=-1))
    return clipped


def _estimate(quotient: float, variance: float, degrees: float, size: float, statistic: EpisodeStatistic) -> Estimate:
    value = None if math.isnan(quotient) else _exp(quotient) if statistic.exponentiate else quotient
    low, high = statistic.limits
    spread = math.isfinite(variance) and variance > (ROUNDING * size) ** 2 and low < quotient < high
    if value is None or not spread or not degrees >= 1:
        return Estimate(value)
    _, slope = to_scale(quotient, statistic.limits)
    return Estimate(value, slope * math.sqrt(variance), degrees, statistic.limits, statistic.exponentiate)


def to_scale(value: float, limits: tuple[float, float]) -> tuple[float, float]:
    """`value` on a scale without limits, and the slope there: log(x - low), log odds, or x itself without limits."""
    low, high = limits
    if math.isinf(low) and math.isinf(high):
        return value, 1.0
    if math.isinf(high):
        return math.log(value - low), 1.0 / (value - low)
    return math.log((value - low) / (high - value)), 1.0 / (value - low) + 1.0 / (high - value)


def _from_scale(place: float, limits: tuple[float, float]) -> float:
    low, high = limits
    if math.isinf(low) and math.isinf(high):
        return place
    if math.isinf(high):
        return low + _exp(place)
    return low + (high - low) / (1.0 + _exp(-place))


def _exp(value: float) -> float:
    return math.exp(value) if value < 709.0 else math.inf
