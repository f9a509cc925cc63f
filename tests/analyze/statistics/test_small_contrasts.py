from __future__ import annotations

import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy import stats

from tests.kit.made_up_steps import default_grouping, make_steps, replans_of
from vla_attention.analyze.statistics.autocorrelation import autocorrelation_table, autocovariances, effective_count
from vla_attention.analyze.statistics.effect_sizes import (
    cliffs_delta,
    contrast,
    contrast_row,
    hedges_g,
    mean_difference,
    standardised_mean,
)
from vla_attention.analyze.statistics.intervals import Estimand
from vla_attention.analyze.statistics.units import Units

GENERATOR = np.random.default_rng(8)
FIRST, SECOND = GENERATOR.normal(1.0, 0.5, 12), GENERATOR.normal(0.4, 0.5, 9)
NUMBERS = st.floats(-50, 50, allow_subnormal=False).map(lambda value: round(value, 3))
SAMPLES = hnp.arrays(np.float64, st.integers(2, 9), elements=NUMBERS)


def both(first, second):
    values = np.concatenate([first, second])
    return values, np.arange(len(values)) < len(first)


def test_hedges_g_is_the_t_statistic_rescaled_and_corrected():
    n, m = len(FIRST), len(SECOND)
    t = stats.ttest_ind(FIRST, SECOND).statistic
    expected = t * np.sqrt(1 / n + 1 / m) * (1 - 3 / (4 * (n + m) - 9))
    assert hedges_g(FIRST, SECOND) == pytest.approx(expected)
    assert hedges_g(SECOND, FIRST) == pytest.approx(-expected)


def test_cliffs_delta_is_the_u_statistic_rescaled():
    u = stats.mannwhitneyu(FIRST, SECOND).statistic
    assert cliffs_delta(FIRST, SECOND) == pytest.approx(2 * u / (len(FIRST) * len(SECOND)) - 1)
    assert cliffs_delta([1.0, 1.0], [1.0]) == 0
    assert cliffs_delta([], [1.0]) is None


def test_a_task_without_which_all_pairs_agree_leaves_the_effect_without_an_interval():
    tasks = [0, 0, 1, 1, 2, 2]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        effect = standardised_mean([-1.0, -1.0, -1.0, -1.0, 0.0, 0.0], Units.of(tasks))
    assert effect.value == pytest.approx(-2 / 3 / np.std([-1, -1, -1, -1, 0, 0], ddof=1) * (1 - 3 / (4 * 5 - 1)))
    assert effect.error is None


@given(SAMPLES, SAMPLES)
@settings(deadline=None)
def test_effect_sizes_do_not_depend_on_unit_or_origin(first, second):
    assert cliffs_delta(np.exp(first / 10), np.exp(second / 10)) == pytest.approx(cliffs_delta(first, second))
    plain = hedges_g(first, second)
    if plain is None or np.ptp(np.concatenate([first - first.mean(), second - second.mean()])) < 1e-6:
        return
    assert hedges_g(3 * first + 7, 3 * second + 7) == pytest.approx(plain, rel=1e-6, abs=1e-6)


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


def test_effect_sizes_have_the_jackknifes_standard_error():
    values, is_first = both(FIRST, SECOND)
    found = contrast(values, is_first, Units.of(np.zeros(len(values))))
    for size, estimate in ((hedges_g, found.hedges_g), (cliffs_delta, found.cliffs_delta)):
        variance = 0.0
        for member, other in ((FIRST, SECOND), (SECOND, FIRST)):
            # One episode less changes the correction for small samples; the weights keep it.
            n, m = len(member), len(other)
            keep = (1 - 3 / (4 * (n + m - 2) - 1)) / (1 - 3 / (4 * (n + m - 3) - 1)) if size is hedges_g else 1.0
            left_out = [keep * size(np.delete(member, i), other) for i in range(n)]
            variance += (n - 1) / n * ((left_out - np.mean(left_out)) ** 2).sum()
        slope = 1.0 if size is hedges_g else 2 / (1 - estimate.value**2)
        assert estimate.error == pytest.approx(slope * np.sqrt(variance), rel=0.02)
        interval = estimate.interval()
        assert interval.low < estimate.value < interval.high
    assert -1 < found.cliffs_delta.interval().low < found.cliffs_delta.interval().high < 1


@pytest.mark.parametrize("sizes", [(2, 2), (4, 9)])
def test_effect_sizes_of_few_episodes_have_no_interval(sizes):
    """Two against two episodes had an interval of width zero, and a third of null samples excluded 0."""
    generator = np.random.default_rng(0)
    for _ in range(50):
        values, is_first = both(generator.normal(size=sizes[0]), generator.normal(size=sizes[1]))
        found = contrast(values, is_first, Units.of(np.zeros(len(values))))
        assert found.cliffs_delta.interval() is found.hedges_g.interval() is None
    row = contrast_row(found, "success", "failure")
    assert row["cliffs_delta"] is not None
    assert row["cliffs_delta_low"] is row["cliffs_delta_high"] is None


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


def test_the_standardised_mean_of_pairs_is_cohens_d_z_corrected():
    differences = FIRST
    found = standardised_mean(differences, Units.of(np.zeros(12)))
    assert found.value == pytest.approx((1 - 3 / (4 * 11 - 1)) * differences.mean() / differences.std(ddof=1))
    interval = found.interval()
    assert interval.low < found.value < interval.high
    assert standardised_mean(FIRST[:4], Units.of(np.zeros(4))).value is None
    assert standardised_mean(np.ones(9), Units.of(np.zeros(9))).value is None


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


def test_autocovariances_are_the_definition():
    series = np.random.default_rng(0).normal(size=17)
    centred = series - series.mean()
    expected = [(centred[: 17 - lag] * centred[lag:]).sum() / 17 for lag in range(17)]
    assert autocovariances(series) == pytest.approx(expected)


def test_initial_positive_sequence_by_hand():
    series = np.random.default_rng(4).normal(size=40).cumsum()
    g = autocovariances(series)
    total, m = 0.0, 0
    while 2 * m + 1 < 40 and g[2 * m] + g[2 * m + 1] > 0:
        total += g[2 * m] + g[2 * m + 1]
        m += 1
    found = effective_count(series)
    assert found.time == pytest.approx(-1 + 2 * total / g[0])
    assert found.effective == pytest.approx(40 / found.time)


@pytest.mark.parametrize("rho", [0.0, 0.5, 0.8])
def test_a_long_autoregression_has_the_known_time(rho):
    generator = np.random.default_rng(3)
    times = []
    for _ in range(40):
        series = np.zeros(4000)
        noise = generator.normal(size=4000)
        for i in range(1, 4000):
            series[i] = rho * series[i - 1] + noise[i]
        times.append(effective_count(series).time)
    assert np.mean(times) == pytest.approx((1 + rho) / (1 - rho), rel=0.12)


@given(hnp.arrays(np.float64, st.integers(0, 30), elements=st.floats(-9, 9)))
@settings(deadline=None)
def test_a_series_is_never_worth_more_than_its_length_nor_less_than_nothing(series):
    found = effective_count(series)
    assert found.num_values == len(series)
    if found.effective is not None:
        assert 0 < found.effective <= len(series)
        assert found.time >= 1


@pytest.mark.parametrize("series", [[], [1.0, 2.0, 3.0], [2.0] * 9, [1.0, 2.0, np.inf, 3.0, 4.0]])
def test_what_cannot_be_estimated_is_none(series):
    found = effective_count(series)
    assert found.time is found.effective is None


def test_the_table_of_counts_is_per_episode_and_layer():
    replans = replans_of(make_steps(num_replans=20), default_grouping()).cells
    by = ["suite", "task_id", "episode_index", "layer"]
    table = autocorrelation_table(replans, by, "log2_ratio")
    assert table.columns == [*by, "series", "num_replans", "autocorrelation_time", "effective_replans"]
    assert table.height == 2 * 3 * 4  # three layers and their mean
    row = table.filter(task_id=1, episode_index=2, layer="25").row(0, named=True)
    series = replans.filter(task_id=1, episode_index=2, layer="25").sort("replan")["log2_ratio"].to_numpy()
    assert row["effective_replans"] == pytest.approx(effective_count(series).effective)
    assert (row["num_replans"], row["series"]) == (20, "log2_ratio")
