from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from vla_attention.analyze.statistics.intervals import Estimand
from vla_attention.analyze.statistics.two_samples import mean_difference
from vla_attention.analyze.statistics.units import Units

GENERATOR = np.random.default_rng(8)
FIRST, SECOND = GENERATOR.normal(1.0, 0.5, 12), GENERATOR.normal(0.4, 0.5, 9)


def both(first, second):
    values = np.concatenate([first, second])
    return values, np.arange(len(values)) < len(first)


@pytest.mark.parametrize("estimand", Estimand)
def test_the_difference_in_one_task_agrees_with_scipy(estimand):
    values, is_first = both(FIRST, SECOND)
    found = mean_difference(values, is_first, Units.of(np.zeros(len(values)), estimand))
    assert (found.num_first, found.num_second) == (12, 9)
    assert found.difference.value == pytest.approx(FIRST.mean() - SECOND.mean())
    welch = stats.ttest_ind(FIRST, SECOND, equal_var=False)
    assert found.difference.degrees == pytest.approx(welch.df, abs=2)
    interval, theirs = found.difference.interval(), welch.confidence_interval()
    assert (interval.low, interval.high) == pytest.approx((theirs.low, theirs.high), rel=0.03)


def test_over_common_tasks_it_is_the_paired_t_test_over_task_means():
    generator = np.random.default_rng(7)
    tasks = np.repeat(np.arange(8), 6)
    is_first = np.tile([True, True, True, True, False, False], 8)
    values = generator.normal(0, 2.0, 8)[tasks] + 0.3 * is_first + generator.normal(0, 0.4, 48)
    gaps = [values[(tasks == t) & is_first].mean() - values[(tasks == t) & ~is_first].mean() for t in range(8)]
    estimate = mean_difference(values, is_first, Units.of(tasks)).difference
    assert estimate.p_value(0.0) == pytest.approx(stats.ttest_1samp(gaps, 0.0).pvalue)
    interval = estimate.interval()
    expected = stats.t.interval(0.95, 7, np.mean(gaps), stats.sem(gaps))
    assert (interval.low, interval.high) == pytest.approx(expected)


def test_of_different_tasks_it_is_the_t_test_between_their_means():
    generator = np.random.default_rng(7)
    tasks = np.repeat(np.arange(12), 4)
    values = generator.normal(0, 1.0, 12)[tasks] + generator.normal(0, 0.4, 48)
    means = np.array([values[tasks == task].mean() for task in range(12)])
    found = mean_difference(values, tasks < 5, Units.of(tasks))
    welch = stats.ttest_ind(means[:5], means[5:], equal_var=False)
    assert found.difference.value == pytest.approx(means[:5].mean() - means[5:].mean())
    assert found.difference.error == pytest.approx(found.difference.value / welch.statistic)


def test_one_task_on_one_side_shows_nothing_about_tasks_like_these():
    generator = np.random.default_rng(3)
    tasks = np.repeat(np.arange(6), 5)
    values = generator.normal(0, 2.0, 6)[tasks] + generator.normal(0, 0.2, 30)
    found = mean_difference(values, tasks == 0, Units.of(tasks))
    assert found.difference.value is not None
    assert found.difference.interval() is found.difference.p_value(0.0) is None
    these = Units.of(tasks, Estimand.THESE_TASKS)
    assert mean_difference(values, tasks == 0, these).difference.interval() is not None


def test_two_beside_twenty_seldom_exclude_zero():
    generator = np.random.default_rng(5)
    excluded = 0
    for _ in range(400):
        values, is_first = both(generator.normal(size=20), generator.normal(size=2))
        excluded += mean_difference(values, is_first, Units.of(np.zeros(22))).difference.p_value(0.0) <= 0.05
    assert excluded / 400 <= 0.083  # their own variance alone: 15 %


@pytest.mark.parametrize("size", [0, 1, 5, 6])
def test_a_class_of_none_has_no_difference_and_one_of_one_no_interval(size):
    found = mean_difference(np.arange(6.0), np.arange(6) < size, Units.of(np.zeros(6)))
    assert (found.difference.value is None) == (size in (0, 6))
    assert found.difference.interval() is None
    assert found.mean_first == (None if size == 0 else pytest.approx(np.arange(size).mean()))


def test_values_that_are_not_finite_leave_the_class_they_are_in():
    values = np.array([1.0, np.inf, 2.0, 5.0, np.nan, 6.0])
    found = mean_difference(values, np.array([True, True, True, False, False, False]), Units.of(np.zeros(6)))
    assert (found.num_first, found.num_second, found.difference.value) == (2, 2, -4.0)
