from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy import stats

from tests.kit.made_up_steps import default_grouping, make_steps, replans_of
from vla_attention.analyze.statistics.autocorrelation import autocorrelation_table, autocovariances, effective_count
from vla_attention.analyze.statistics.bootstrap import resample_episodes
from vla_attention.analyze.statistics.effect_sizes import cliffs_delta, contrast, contrast_row, hedges_g

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


@given(SAMPLES, SAMPLES)
@settings(deadline=None)
def test_effect_sizes_do_not_depend_on_unit_or_origin(first, second):
    assert cliffs_delta(np.exp(first / 10), np.exp(second / 10)) == pytest.approx(cliffs_delta(first, second))
    plain = hedges_g(first, second)
    if plain is None or np.ptp(np.concatenate([first - first.mean(), second - second.mean()])) < 1e-6:
        return
    assert hedges_g(3 * first + 7, 3 * second + 7) == pytest.approx(plain, rel=1e-6, abs=1e-6)


def test_the_whole_contrast_agrees_with_scipy_and_plain_loops():
    values, is_first = both(FIRST, SECOND)
    found = contrast(values, is_first, resample_episodes(np.zeros(len(values)), 20000))
    assert (found.num_first, found.num_second) == (12, 9)
    assert found.difference == pytest.approx(FIRST.mean() - SECOND.mean())
    assert found.within_tasks == pytest.approx(found.difference)  # one task
    assert found.hedges_g == pytest.approx(hedges_g(FIRST, SECOND))
    assert found.cliffs_delta == pytest.approx(cliffs_delta(FIRST, SECOND))
    # Our resamples draw from all episodes, scipy's from each class: the same to a few hundredths, but for our widening.
    theirs = stats.bootstrap(
        (FIRST, SECOND),
        lambda x, y, axis: x.mean(axis=axis) - y.mean(axis=axis),
        n_resamples=20000,
        method="percentile",
        rng=np.random.default_rng(0),
    ).confidence_interval
    factor = stats.t.ppf(0.975, 8) / stats.norm.ppf(0.975) * np.sqrt(9 / 8)
    expected = [found.difference + factor * (end - found.difference) for end in theirs]
    assert (found.difference_interval.low, found.difference_interval.high) == pytest.approx(expected, abs=0.08)


def test_resampled_effect_sizes_are_those_of_the_drawn_episodes():
    values, is_first = both(FIRST, SECOND)
    tasks = np.arange(len(values)) % 4
    resamples = resample_episodes(tasks, 300, seed=2)
    found = contrast(values, is_first, resamples, level=0.9)
    g, delta, difference, within = [], [], [], []
    for counts in resamples.counts.astype(int):
        drawn = np.repeat(np.arange(len(values)), counts)
        x, y = values[drawn[is_first[drawn]]], values[drawn[~is_first[drawn]]]
        g.append(hedges_g(x, y))
        delta.append(cliffs_delta(x, y))
        difference.append(x.mean() - y.mean())
        # The coefficient of the class in a linear model with a constant per task.
        design = np.stack([is_first[drawn], *(tasks[drawn] == task for task in np.unique(tasks[drawn]))], axis=1)
        within.append(np.linalg.lstsq(design.astype(float), values[drawn], rcond=None)[0][0])
    factor = stats.t.ppf(0.95, 3) / stats.norm.ppf(0.95) * np.sqrt(4 / 3)
    for name, drawn in (("difference", difference), ("hedges_g", g), ("within_tasks", within)):
        value, interval = getattr(found, name), getattr(found, f"{name}_interval")
        low, high = np.quantile(np.array(drawn, dtype=float), [0.05, 0.95])
        assert interval.low == pytest.approx(value + factor * (low - value)), name
        assert interval.high == pytest.approx(value + factor * (high - value)), name
    odds = lambda x: np.log((1 + x) / (1 - x))  # noqa: E731
    low, high = odds(np.quantile(delta, [0.05, 0.95]))
    centre = odds(found.cliffs_delta)
    assert odds(found.cliffs_delta_interval.low) == pytest.approx(centre + factor * (low - centre))
    assert odds(found.cliffs_delta_interval.high) == pytest.approx(centre + factor * (high - centre))


def test_a_difference_between_tasks_is_not_one_within_tasks():
    """Easy tasks have high values and are solved; inside tasks success changes nothing."""
    generator = np.random.default_rng(1)
    tasks = np.repeat(np.arange(8), 20)
    easy = tasks < 4
    solved = generator.random(len(tasks)) < np.where(easy, 0.9, 0.1)
    values = 2.0 * easy + generator.normal(0, 0.2, len(tasks))
    found = contrast(values, solved, resample_episodes(tasks))
    assert found.difference > 1.2
    assert abs(found.within_tasks) < 0.15
    assert found.within_tasks_interval.low < 0 < found.within_tasks_interval.high


def test_a_planted_effect_is_found_inside_tasks():
    generator = np.random.default_rng(2)
    tasks = np.repeat(np.arange(10), 12)
    solved = generator.random(len(tasks)) < 0.5
    values = generator.normal(0, 1.0, 10)[tasks] + 0.5 * solved + generator.normal(0, 0.3, len(tasks))
    found = contrast(values, solved, resample_episodes(tasks))
    assert found.within_tasks_interval.low < 0.5 < found.within_tasks_interval.high
    assert found.within_tasks_interval.low > 0.2


@pytest.mark.parametrize(
    ("solved", "said"), [(0, "0 against 6"), (1, "1 against 5"), (5, "5 against 1"), (6, "6 against 0")]
)
def test_classes_of_none_or_one_are_said_and_not_computed(solved, said):
    values = np.arange(6.0)
    found = contrast(values, np.arange(6) < solved, resample_episodes(np.zeros(6), 50))
    row = contrast_row(found, "success", "failure")
    assert said in row["note"]
    assert row["difference"] is row["hedges_g"] is row["cliffs_delta"] is row["difference_low"] is None
    assert row["mean_success"] == (None if solved == 0 else pytest.approx(values[:solved].mean()))


def test_values_that_are_not_finite_leave_the_class_they_are_in():
    values = np.array([1.0, np.inf, 2.0, 5.0, np.nan, 6.0])
    found = contrast(values, np.array([True, True, True, False, False, False]), resample_episodes(np.zeros(6), 200))
    assert (found.num_first, found.num_second, found.difference) == (2, 2, -4.0)


def test_tasks_with_one_outcome_each_have_no_difference_within():
    found = contrast(np.arange(6.0), np.arange(6) < 3, resample_episodes(np.repeat([0, 1], 3), 200))
    assert found.within_tasks is found.within_tasks_interval is None
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
