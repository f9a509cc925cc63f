from __future__ import annotations

import numpy as np
import pytest
from scipy import stats
from vla_attention.analyze.statistics.effect_sizes import (
    cliffs_delta,
    contrast,
    contrast_row,
    hedges_g,
    mean_difference,
)

from vla_attention.analyze.statistics.intervals import Estimand
from vla_attention.analyze.statistics.units import Units

GENERATOR = np.random.default_rng(8)
FIRST, SECOND = GENERATOR.normal(1.0, 0.5, 12), GENERATOR.normal(0.4, 0.5, 9)


def both(first, second):
    values = np.concatenate([first, second])
    return values, np.arange(len(values)) < len(first)


@pytest.mark.parametrize("estimand", Estimand)
def test_the_contrast_of_one_task_agrees_with_scipy(estimand):
    values, is_first = both(FIRST, SECOND)
    found = contrast(values, is_first, Units.of(np.zeros(len(values)), estimand))
    assert (found.num_first, found.num_second) == (12, 9)
    assert found.difference.value == pytest.approx(FIRST.mean() - SECOND.mean())
    assert found.within_tasks == found.difference
    assert mean_difference(values, is_first, Units.of(np.zeros(len(values)), estimand)) == found.difference
    assert found.hedges_g.value == pytest.approx(hedges_g(FIRST, SECOND))
    assert found.cliffs_delta.value == pytest.approx(cliffs_delta(FIRST, SECOND))
    welch = stats.ttest_ind(FIRST, SECOND, equal_var=False)
    assert found.difference.degrees == pytest.approx(welch.df, abs=2)
    interval, theirs = found.difference.interval(), welch.confidence_interval()
    assert (interval.low, interval.high) == pytest.approx((theirs.low, theirs.high), rel=0.03)


def test_a_contrast_over_common_tasks_is_the_paired_t_test_over_task_means():
    generator = np.random.default_rng(7)
    tasks = np.repeat(np.arange(8), 6)
    is_first = np.tile([True, True, True, True, False, False], 8)
    values = generator.normal(0, 2.0, 8)[tasks] + 0.3 * is_first + generator.normal(0, 0.4, 48)
    gaps = [values[(tasks == t) & is_first].mean() - values[(tasks == t) & ~is_first].mean() for t in range(8)]
    found = contrast(values, is_first, Units.of(tasks))
    for estimate in (found.difference, found.within_tasks):
        assert estimate.p_value(0.0) == pytest.approx(stats.ttest_1samp(gaps, 0.0).pvalue)
        interval = estimate.interval()
        expected = stats.t.interval(0.95, 7, np.mean(gaps), stats.sem(gaps))
        assert (interval.low, interval.high) == pytest.approx(expected)


def test_a_contrast_of_different_tasks_is_the_t_test_between_their_means():
    generator = np.random.default_rng(7)
    tasks = np.repeat(np.arange(12), 4)
    is_first = tasks < 5
    values = generator.normal(0, 1.0, 12)[tasks] + generator.normal(0, 0.4, 48)
    means = np.array([values[tasks == task].mean() for task in range(12)])
    found = contrast(values, is_first, Units.of(tasks))
    welch = stats.ttest_ind(means[:5], means[5:], equal_var=False)
    assert found.difference.value == pytest.approx(means[:5].mean() - means[5:].mean())
    assert found.difference.error == pytest.approx(found.difference.value / welch.statistic)
    assert found.within_tasks.value is None


def test_one_task_on_one_side_shows_nothing_about_tasks_like_these():
    generator = np.random.default_rng(3)
    tasks = np.repeat(np.arange(6), 5)
    values = generator.normal(0, 2.0, 6)[tasks] + generator.normal(0, 0.2, 30)
    found = contrast(values, tasks == 0, Units.of(tasks))
    assert found.difference.value is not None
    assert found.difference.interval() is found.difference.p_value(0.0) is None
    assert contrast(values, tasks == 0, Units.of(tasks, Estimand.THESE_TASKS)).difference.interval() is not None


def test_two_failures_beside_many_solved_seldom_exclude_zero():
    generator = np.random.default_rng(5)
    excluded = 0
    for _ in range(400):
        values, is_first = both(generator.normal(size=20), generator.normal(size=2))
        excluded += contrast(values, is_first, Units.of(np.zeros(22))).difference.p_value(0.0) <= 0.05
    assert excluded / 400 <= 0.083  # their own variance alone: 15 %


@pytest.mark.parametrize("sizes", [(5, 5), (6, 20)])
def test_null_samples_seldom_exclude_zero(sizes):
    generator = np.random.default_rng(1)
    excluded = {"difference": 0, "hedges_g": 0, "cliffs_delta": 0}
    for _ in range(400):
        values, is_first = both(generator.normal(size=sizes[0]), generator.normal(size=sizes[1]))
        found = contrast(values, is_first, Units.of(np.zeros(len(values))))
        for name in excluded:
            interval = getattr(found, name).interval()
            excluded[name] += interval is not None and not interval.low <= 0 <= interval.high
    assert all(count / 400 <= 0.083 for count in excluded.values()), excluded  # 5 % and three standard errors


def test_a_difference_between_tasks_is_not_one_within_tasks():
    """Easy tasks have high values, and three of the four are always solved; inside tasks success changes nothing."""
    generator = np.random.default_rng(1)
    tasks = np.repeat(np.arange(8), 20)
    easy = tasks < 4
    solved = np.where(tasks % 4 < 3, easy, generator.random(len(tasks)) < 0.5)
    values = 2.0 * easy + generator.normal(0, 0.2, len(tasks))
    found = contrast(values, solved, Units.of(tasks))
    assert found.difference.value > 0.8
    assert found.num_tasks_with_both == 2
    assert abs(found.within_tasks.value) < 0.15
    assert found.within_tasks.interval().low < 0 < found.within_tasks.interval().high


def test_a_planted_effect_is_found_inside_tasks():
    generator = np.random.default_rng(2)
    tasks = np.repeat(np.arange(10), 12)
    solved = generator.random(len(tasks)) < 0.5
    values = generator.normal(0, 1.0, 10)[tasks] + 0.5 * solved + generator.normal(0, 0.3, len(tasks))
    found = contrast(values, solved, Units.of(tasks))
    assert found.within_tasks.interval().low < 0.5 < found.within_tasks.interval().high
    assert found.within_tasks.interval().low > 0.2


@pytest.mark.parametrize(
    ("solved", "said"), [(0, "0 against 6"), (1, "1 against 5"), (5, "5 against 1"), (6, "6 against 0")]
)
def test_classes_of_none_or_one_are_said_and_not_computed(solved, said):
    values = np.arange(6.0)
    found = contrast(values, np.arange(6) < solved, Units.of(np.zeros(6)))
    row = contrast_row(found, "success", "failure")
    assert said in row["note"]
    assert row["difference"] is row["hedges_g"] is row["cliffs_delta"] is row["difference_low"] is None
    assert row["mean_success"] == (None if solved == 0 else pytest.approx(values[:solved].mean()))


def test_values_that_are_not_finite_leave_the_class_they_are_in():
    values = np.array([1.0, np.inf, 2.0, 5.0, np.nan, 6.0])
    found = contrast(values, np.array([True, True, True, False, False, False]), Units.of(np.zeros(6)))
    assert (found.num_first, found.num_second, found.difference.value) == (2, 2, -4.0)


def test_tasks_with_one_outcome_each_have_no_difference_within():
    found = contrast(np.arange(6.0), np.arange(6) < 3, Units.of(np.repeat([0, 1], 3)))
    assert found.within_tasks.value is found.within_tasks.interval() is None
    assert found.num_tasks_with_both == 0
    assert "between tasks" in found.note
