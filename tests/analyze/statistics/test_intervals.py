"""Intervals over episodes and tasks, against scipy's t intervals, plain loops and known truths."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy import special, stats

from vla_attention.analyze.statistics.intervals import (
    POSITIVE,
    SHARE,
    Estimand,
    estimates,
    geometric_mean_over_episodes,
    mean_over_episodes,
    ratio_of_means_over_episodes,
)
from vla_attention.analyze.statistics.student import student_quantile, two_sided_p
from vla_attention.analyze.statistics.units import Units

LIKE, THESE = Estimand.TASKS_LIKE_THESE, Estimand.THESE_TASKS
SAMPLE = np.random.default_rng(3).lognormal(1.0, 0.6, 25)
UNBALANCED = np.repeat(np.arange(6), [2, 9, 3, 5, 4, 2])
POSITIVE_SAMPLES = hnp.arrays(np.float64, st.integers(2, 12), elements=st.floats(0.01, 1000.0))


def one(statistic, tasks, estimand=LIKE):
    return estimates([statistic], Units.of(tasks, estimand))[0]


def ends_of(estimate, level=0.95):
    interval = estimate.interval(level)
    return interval.low, interval.high


@pytest.mark.parametrize("estimand", Estimand)
@pytest.mark.parametrize("level", [0.95, 0.8])
def test_one_task_is_students_interval_over_its_episodes(estimand, level):
    estimate = one(mean_over_episodes(SAMPLE), np.zeros(25), estimand)
    assert ends_of(estimate, level) == pytest.approx(stats.t.interval(level, 24, SAMPLE.mean(), stats.sem(SAMPLE)))
    assert estimate.p_value(3.0) == pytest.approx(stats.ttest_1samp(SAMPLE, 3.0).pvalue)
    logs = one(geometric_mean_over_episodes(np.log(SAMPLE)), np.zeros(25), estimand)
    expected = np.exp(stats.t.interval(level, 24, np.log(SAMPLE).mean(), stats.sem(np.log(SAMPLE))))
    assert ends_of(logs, level) == pytest.approx(tuple(expected))
    assert logs.p_value(3.0) == pytest.approx(stats.ttest_1samp(np.log(SAMPLE), np.log(3.0)).pvalue)


@pytest.mark.parametrize("degrees", [2, 24])
def test_a_truth_that_is_detectable_is_shown_in_the_given_part_of_runs(degrees):
    """By drawing: t tests of samples whose mean is the detectable truth, with the scatter that the sample has."""
    generator, n = np.random.default_rng(0), degrees + 1
    sample = generator.normal(0, 1.0, n)
    estimate = one(mean_over_episodes((sample - sample.mean()) / sample.std(ddof=1)), np.zeros(n))
    truth = estimate.detectable(0.0, level=0.05, power=0.8)
    assert truth == pytest.approx((stats.t.ppf(0.975, degrees) + stats.t.ppf(0.8, degrees)) / np.sqrt(n))
    shown = stats.ttest_1samp(generator.normal(truth, 1.0, (20_000, n)), 0.0, axis=1).pvalue <= 0.05
    assert shown.mean() == pytest.approx(0.8, abs=0.02 if degrees > 10 else 0.15)
    logs = one(geometric_mean_over_episodes(sample), np.zeros(n))
    assert np.log(logs.detectable(2.0)) - np.log(2.0) == pytest.approx(truth * sample.std(ddof=1))


def test_tasks_like_these_is_the_t_interval_over_task_means():
    values = np.random.default_rng(1).normal(UNBALANCED, 1.0)
    means = np.array([values[task == UNBALANCED].mean() for task in range(6)])
    estimate = one(mean_over_episodes(values), UNBALANCED)
    assert estimate.value == pytest.approx(means.mean())
    assert ends_of(estimate) == pytest.approx(stats.t.interval(0.95, 5, means.mean(), stats.sem(means)))
    assert estimate.p_value(2.0) == pytest.approx(stats.ttest_1samp(means, 2.0).pvalue)


def test_these_tasks_has_the_variance_of_strata_and_the_degrees_of_welch():
    tasks = np.repeat(np.arange(6), [6, 9, 5, 5, 7, 8])
    values = np.random.default_rng(1).normal(tasks, 1.0 + tasks)
    parts = [values[task == tasks] for task in range(6)]
    variances = np.array([part.var(ddof=1) / len(part) for part in parts])
    sizes = np.array([len(part) for part in parts])
    degrees = variances.sum() ** 2 / (variances**2 / (sizes + 1)).sum() - 2
    estimate = one(mean_over_episodes(values), tasks, THESE)
    assert estimate.degrees == int(degrees)
    reach = stats.t.ppf(0.975, int(degrees)) * np.sqrt(variances.sum()) / 6
    centre = np.mean([part.mean() for part in parts])
    assert ends_of(estimate) == pytest.approx((centre - reach, centre + reach))


def test_the_ratio_of_means_has_the_delta_methods_interval_on_the_logarithm():
    above, below = SAMPLE, np.random.default_rng(4).uniform(0.5, 1.5, 25)
    estimate = one(ratio_of_means_over_episodes(above, below), np.zeros(25))
    quotient = above.mean() / below.mean()
    assert estimate.value == pytest.approx(quotient)
    error = stats.sem(above - quotient * below) / below.mean() / quotient
    reach = stats.t.ppf(0.975, 24) * error
    assert ends_of(estimate) == pytest.approx((quotient * np.exp(-reach), quotient * np.exp(reach)))
    # Every task weighs the same: a task's value does not change when its episodes are repeated.
    tasks = np.arange(25) // 5
    again = np.concatenate([np.arange(25), np.flatnonzero(tasks == 2)])
    repeated = ratio_of_means_over_episodes(above[again], below[again])
    assert ends_of(one(repeated, tasks[again])) == pytest.approx(
        ends_of(one(ratio_of_means_over_episodes(above, below), tasks))
    )


def test_fractions_have_intervals_on_the_log_odds():
    shares = SAMPLE / SAMPLE.max() * 0.9
    estimate = one(mean_over_episodes(shares, SHARE), np.zeros(25))
    centre = shares.mean()
    reach = stats.t.ppf(0.975, 24) * stats.sem(shares) * (1 / centre + 1 / (1 - centre))
    expected = special.expit(special.logit(centre) + np.array([-reach, reach]))
    assert ends_of(estimate) == pytest.approx(tuple(expected))


@given(hnp.arrays(np.float64, st.integers(2, 10), elements=st.floats(0.0, 1.0)), st.integers(1, 4))
@settings(deadline=None)
def test_intervals_hold_the_estimate_and_never_leave_the_limits(values, per_task):
    tasks = np.arange(len(values)) // per_task
    for limits in (SHARE, POSITIVE):
        for estimand in Estimand:
            estimate = one(mean_over_episodes(values, limits), tasks, estimand)
            interval = estimate.interval()
            if interval is not None:
                assert limits[0] <= interval.low <= estimate.value <= interval.high <= limits[1]


@given(POSITIVE_SAMPLES, st.floats(0.1, 50.0))
@settings(deadline=None)
def test_scaling_the_values_scales_the_interval(values, factor):
    tasks = np.arange(len(values)) // 3
    for make, scaled in (
        (mean_over_episodes, values * factor),
        (lambda x: mean_over_episodes(x, POSITIVE), values * factor),
    ):
        plain, other = one(make(values), tasks), one(make(scaled), tasks)
        if plain.interval() is not None and other.interval() is not None:
            assert ends_of(other) == pytest.approx(tuple(factor * end for end in ends_of(plain)), rel=1e-6)


def test_the_order_of_episodes_and_the_names_of_tasks_do_not_matter():
    order = np.random.default_rng(0).permutation(25)
    tasks = np.arange(25) // 5
    first = one(mean_over_episodes(SAMPLE), tasks)
    second = one(mean_over_episodes(SAMPLE[order]), [f"task {task}" for task in tasks[order]])
    assert ends_of(first) == pytest.approx(ends_of(second))


def test_no_interval_where_none_can_be_had():
    assert one(mean_over_episodes([3.0]), [0]).interval() is None
    left_out = mean_over_episodes([3.0, np.inf, np.nan])
    assert (~left_out.used).sum() == 2
    assert one(left_out, [0, 0, 0]).value == 3.0
    assert one(left_out, [0, 0, 0]).interval() is None
    assert one(mean_over_episodes([np.inf]), [0]).value is None
    # Without any spread the width would be zero.
    for values in ([2.0, 2.0, 2.0], [0.1 + 0.2, 0.3, 0.3]):
        assert one(mean_over_episodes(values), [0, 0, 0]).interval() is None
        assert one(mean_over_episodes(values), [0, 0, 0]).p_value(1.0) is None
    # On a limit there is no scale.
    assert one(mean_over_episodes([0.0, 0.0, 0.0], SHARE), [0, 1, 2]).interval() is None
    # A task with a single episode does not show how much its episodes differ.
    assert one(mean_over_episodes([1.0, 2.0, 4.0]), [0, 0, 1], THESE).interval() is None
    assert one(mean_over_episodes([1.0, 2.0, 4.0]), [0, 0, 1], LIKE).interval() is not None


def test_ratio_of_means_without_any_denominator_is_infinite():
    estimate = one(ratio_of_means_over_episodes([0.5, 0.6], [0.0, 0.0]), [0, 0])
    assert estimate.value == np.inf
    assert estimate.interval() is None


def test_many_of_a_kind_are_the_same_as_one_by_one():
    rng = np.random.default_rng(1)
    values, tasks = rng.lognormal(size=(2, 3, 12)), np.repeat(np.arange(3), 4)
    values[0, 1, 5] = np.nan
    for estimand in Estimand:
        together = estimates(
            [mean_over_episodes(values, POSITIVE), mean_over_episodes(tasks)], Units.of(tasks, estimand)
        )
        alone = [
            estimates([mean_over_episodes(one, POSITIVE)], Units.of(tasks, estimand))[0]
            for one in values.reshape(6, 12)
        ]
        for mine, theirs in zip(together[:-1], alone, strict=True):
            assert mine.value == pytest.approx(theirs.value, rel=1e-14)
            assert mine.error == pytest.approx(theirs.error, rel=1e-12)
            assert (mine.degrees, mine.limits) == (theirs.degrees, theirs.limits)
        assert together[-1].value == 1.0


@pytest.mark.parametrize("level", [0.5, 0.9, 0.95, 0.999])
def test_student_agrees_with_scipy(level):
    for degrees in (1, 2, 3, 4, 5, 9, 30, 49, 600, 5000):
        quantile = stats.t.ppf(0.5 + level / 2, degrees)
        assert student_quantile(level, degrees) == pytest.approx(quantile, rel=1e-3 if degrees > 2000 else 1e-9)
        assert two_sided_p(-quantile, degrees) == pytest.approx(1 - level, rel=1e-2 if degrees > 2000 else 1e-9)


@pytest.mark.parametrize("sizes", [[2, 50], [2, 10, 10, 10, 10], [3, 50, 50]])
def test_a_small_task_beside_large_ones_does_not_narrow_the_interval(sizes):
    """The variance of two episodes is often far too small: their own alone covers 85 to 92 %."""
    generator = np.random.default_rng(2)
    tasks = np.repeat(np.arange(len(sizes)), sizes)
    hits = 0
    for _ in range(1500):
        low, high = ends_of(one(mean_over_episodes(generator.normal(size=len(tasks))), tasks, THESE))
        hits += low <= 0 <= high
    assert 0.94 <= hits / 1500 <= 0.98


@pytest.mark.parametrize(
    ("sizes", "between", "within"),
    [([5] * 5, 0.3, 0.25), ([2, 3, 5, 10, 30], 0.3, 0.6), ([6], 0.0, 0.6)],
)
def test_ninety_five_per_cent_cover_ninety_five_per_cent(sizes, between, within):
    """The geometric mean of log-normal ratios with a known truth; two standard errors of 1500 stores are 1.1 %."""
    generator = np.random.default_rng(5)
    tasks = np.repeat(np.arange(len(sizes)), sizes)
    hits = {LIKE: 0, THESE: 0}
    for _ in range(1500):
        means = generator.normal(0.0, between, len(sizes))
        logs = generator.normal(means[tasks], within)
        for estimand, truth in ((LIKE, 0.0 if len(sizes) > 1 else means[0]), (THESE, means.mean())):
            low, high = ends_of(one(geometric_mean_over_episodes(logs), tasks, estimand))
            hits[estimand] += low <= np.exp(truth) <= high
    for estimand, count in hits.items():
        assert 0.935 <= count / 1500 <= 0.976, (estimand, count / 1500)
