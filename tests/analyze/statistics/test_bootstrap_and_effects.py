from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy import special, stats

from vla_attention.analyze.statistics import bootstrap
from vla_attention.analyze.statistics.bootstrap import (
    POSITIVE,
    SHARE,
    bootstrap_interval,
    bootstrap_intervals,
    geometric_mean,
    geometric_mean_over_episodes,
    mean_over_episodes,
    ratio_of_means_over_episodes,
    resample_episodes,
    summarize,
    values_with_intervals,
)
from vla_attention.analyze.statistics.small_samples import student_quantile

ONE_TASK = np.zeros(25)
SAMPLE = np.random.default_rng(3).lognormal(1.0, 0.6, 25)
POSITIVE_SAMPLES = hnp.arrays(np.float64, st.integers(2, 12), elements=st.floats(0.01, 1000.0))


def test_summary_is_that_of_numpy_over_finite_values_and_counts_the_others():
    summary = summarize([1.0, np.inf, 4.0, np.nan, -np.inf, 7.0])
    assert (summary.mean, summary.median, summary.min, summary.max) == (4.0, 4.0, 1.0, 7.0)
    assert summary.std == pytest.approx(np.std([1.0, 4.0, 7.0], ddof=0))
    assert summary.num_nonfinite == 3


def test_summary_of_nothing_finite_is_none_not_zero():
    summary = summarize([np.inf, np.nan])
    assert (summary.mean, summary.std, summary.median, summary.min, summary.max) == (None,) * 5
    assert summary.num_nonfinite == 2


def test_geometric_mean_agrees_with_scipy_and_counts_what_has_no_logarithm():
    assert geometric_mean(SAMPLE) == (pytest.approx(stats.gmean(SAMPLE)), 0)
    assert geometric_mean([2.0, 8.0, 0.0, np.inf, np.nan]) == (pytest.approx(4.0), 3)
    assert geometric_mean([0.0]) == (None, 1)


@given(POSITIVE_SAMPLES)
def test_geometric_mean_does_not_depend_on_which_side_is_the_numerator(ratios):
    forward, _ = geometric_mean(ratios)
    backward, _ = geometric_mean(1.0 / ratios)
    assert forward == pytest.approx(1.0 / backward)


@pytest.mark.parametrize("level", [0.95, 0.8])
def test_one_level_mean_agrees_with_scipy(level):
    ours = bootstrap_interval(mean_over_episodes(SAMPLE), ONE_TASK, num_resamples=20000, level=level, widened=False)
    theirs = stats.bootstrap(
        (SAMPLE,), np.mean, n_resamples=20000, confidence_level=level, method="percentile", rng=np.random.default_rng(1)
    ).confidence_interval
    assert (ours.low, ours.high) == pytest.approx(tuple(theirs), rel=0.01)
    assert ours.level == level


def test_one_level_ratio_of_means_agrees_with_scipy():
    above, below = SAMPLE, np.random.default_rng(4).uniform(0.5, 1.5, 25)

    def quotient(x, y, axis=-1):
        return x.mean(axis=axis) / y.mean(axis=axis)

    ours = bootstrap_interval(ratio_of_means_over_episodes(above, below), ONE_TASK, num_resamples=20000, widened=False)
    theirs = stats.bootstrap(
        (above, below), quotient, n_resamples=20000, method="percentile", paired=True, rng=np.random.default_rng(1)
    ).confidence_interval
    assert (ours.low, ours.high) == pytest.approx(tuple(theirs), rel=0.01)


def test_one_level_geometric_mean_agrees_with_scipy():
    ours = bootstrap_interval(
        geometric_mean_over_episodes(np.log(SAMPLE)), ONE_TASK, num_resamples=20000, widened=False
    )
    theirs = stats.bootstrap(
        (SAMPLE,), stats.gmean, n_resamples=20000, method="percentile", rng=np.random.default_rng(1)
    ).confidence_interval
    assert (ours.low, ours.high) == pytest.approx(tuple(theirs), rel=0.01)


def test_two_levels_agree_with_a_plain_loop():
    generator = np.random.default_rng(5)
    sizes = [3, 5, 2, 6]
    tasks = np.repeat([7, 1, 4, 2], sizes)
    values = generator.normal(np.repeat([0.0, 3.0, -1.0, 2.0], sizes), 0.5) + 10
    ours = bootstrap_interval(mean_over_episodes(values), tasks, num_resamples=20000, widened=False)
    means = []
    for _ in range(4000):
        drawn = generator.choice([7, 1, 4, 2], 4)
        parts = [generator.choice(values[tasks == task], (tasks == task).sum()) for task in drawn]
        means.append(np.concatenate(parts).mean())
    low, high = np.quantile(means, [0.025, 0.975])
    assert (ours.low, ours.high) == pytest.approx((low, high), rel=0.02)
    # Tasks differ far more than episodes do: ignoring the first level would claim too much.
    one_level = bootstrap_interval(mean_over_episodes(values), np.zeros(len(values)), widened=False)
    assert ours.high - ours.low > 1.5 * (one_level.high - one_level.low)


@given(st.lists(st.integers(0, 4), min_size=1, max_size=15), st.integers(0, 100))
@settings(deadline=None)
def test_every_resample_draws_whole_tasks(tasks, seed):
    tasks = np.array(tasks)
    counts = resample_episodes(tasks, num_resamples=20, seed=seed).counts
    labels, sizes = np.unique(tasks, return_counts=True)
    for row in counts:
        # A task that was drawn k times contributes k times as many draws as it has episodes.
        times = np.array([row[tasks == label].sum() for label in labels]) / sizes
        assert (times == times.round()).all()
        assert times.sum() == len(labels)


def test_draws_in_pieces_still_draw_each_episode_equally_often(monkeypatch):
    monkeypatch.setattr("vla_attention.analyze.statistics.bootstrap._DRAWS_AT_ONCE", 50)
    counts = resample_episodes(np.array([0, 0, 0, 1, 1, 1]), num_resamples=4000, seed=1).counts
    assert counts.shape == (4000, 6)
    assert (counts.sum(axis=1) == 6).all()
    assert counts.mean(axis=0) == pytest.approx(np.ones(6), abs=0.06)


@given(POSITIVE_SAMPLES, st.floats(0.1, 50.0))
@settings(deadline=None)
def test_scaling_the_values_scales_the_interval(values, factor):
    tasks = np.arange(len(values)) // 3
    plain = bootstrap_interval(mean_over_episodes(values), tasks, num_resamples=200)
    scaled = bootstrap_interval(mean_over_episodes(values * factor), tasks, num_resamples=200)
    assert (scaled.low, scaled.high) == pytest.approx((plain.low * factor, plain.high * factor), rel=1e-9)
    logs = np.log(values)
    plain = bootstrap_interval(geometric_mean_over_episodes(logs), tasks, num_resamples=200)
    scaled = bootstrap_interval(geometric_mean_over_episodes(logs + np.log(factor)), tasks, num_resamples=200)
    assert (scaled.low, scaled.high) == pytest.approx((plain.low * factor, plain.high * factor), rel=1e-9)


@given(POSITIVE_SAMPLES)
@settings(deadline=None)
def test_percentile_intervals_stay_inside_the_range_of_the_values_and_around_the_mean(values):
    statistic, one_task = mean_over_episodes(values), np.zeros(len(values))
    interval = bootstrap_interval(statistic, one_task, num_resamples=1000, widened=False)
    slack = 1e-9 * values.max()
    assert values.min() - slack <= interval.low <= interval.high <= values.max() + slack
    assert interval.low <= values.mean() + slack
    # The bootstrap distribution of very skewed samples can leave the mean at its edge, never beyond the other side.
    assert interval.high >= values.mean() - slack - 0.2 * np.ptp(values)


@pytest.mark.parametrize("episodes", [2, 5, 25])
def test_one_task_is_widened_by_students_t_and_the_lost_degree_of_freedom(episodes):
    values = SAMPLE[:episodes]
    plain, widened = (
        bootstrap_interval(mean_over_episodes(values), np.zeros(episodes), widened=flag) for flag in (False, True)
    )
    factor = stats.t.ppf(0.975, episodes - 1) / stats.norm.ppf(0.975) * np.sqrt(episodes / (episodes - 1))
    assert widened.low == pytest.approx(values.mean() + factor * (plain.low - values.mean()))
    assert widened.high == pytest.approx(values.mean() + factor * (plain.high - values.mean()))


def test_ratios_are_widened_on_a_logarithmic_scale_and_fractions_on_that_of_the_odds():
    tasks = np.arange(25) // 5
    factor = stats.t.ppf(0.975, 4) / stats.norm.ppf(0.975) * np.sqrt(5 / 4)
    shares = SAMPLE / SAMPLE.max() * 0.99
    for values, limits, scale in ((SAMPLE, POSITIVE, np.log), (shares, SHARE, special.logit)):
        plain, widened = (
            bootstrap_interval(mean_over_episodes(values, limits), tasks, widened=flag) for flag in (False, True)
        )
        centre = scale(values.mean())
        assert scale(widened.low) == pytest.approx(centre + factor * (scale(plain.low) - centre))
        assert scale(widened.high) == pytest.approx(centre + factor * (scale(plain.high) - centre))


@given(hnp.arrays(np.float64, st.integers(2, 8), elements=st.floats(0.0, 1.0)), st.integers(1, 4))
@settings(deadline=None)
def test_widened_intervals_hold_the_percentile_interval_and_never_leave_the_limits(values, per_task):
    tasks = np.arange(len(values)) // per_task
    for limits in (SHARE, POSITIVE):
        statistic = mean_over_episodes(values, limits)
        plain, widened = (bootstrap_interval(statistic, tasks, 200, widened=flag) for flag in (False, True))
        assert limits[0] <= widened.low <= widened.high <= limits[1]
        slack = 1e-9
        # With one-sided resamples even the percentile interval may lie beside the estimate, and then moves as a whole.
        if plain.low <= statistic.value <= plain.high:
            assert widened.low <= plain.low + slack
            assert widened.high >= plain.high - slack


@pytest.mark.parametrize("level", [0.5, 0.9, 0.95, 0.999])
def test_quantiles_of_students_t_agree_with_scipy(level):
    for degrees in (1, 2, 3, 4, 5, 9, 30, 49, 600, 5000):
        assert student_quantile(level, degrees) == pytest.approx(stats.t.ppf(0.5 + level / 2, degrees), rel=1e-3)
        if degrees < 2000:
            assert student_quantile(level, degrees) == pytest.approx(stats.t.ppf(0.5 + level / 2, degrees), rel=1e-9)


def test_five_episodes_are_covered_like_by_students_interval_and_far_better_than_by_percentiles():
    """A thousand samples with a known mean. Student's interval covers exactly 95 % in the long run."""
    generator = np.random.default_rng(11)
    hits = {True: 0, False: 0, "student": 0}
    for i in range(1000):
        sample = generator.normal(3.0, 0.5, 5)
        for widened in (True, False):
            interval = bootstrap_interval(mean_over_episodes(sample), np.zeros(5), seed=i, widened=widened)
            hits[widened] += interval.low <= 3.0 <= interval.high
        low, high = stats.t.interval(0.95, 4, sample.mean(), stats.sem(sample))
        hits["student"] += low <= 3.0 <= high
    assert hits[True] > hits["student"] - 25
    assert hits[False] < hits["student"] - 60


def test_order_of_episodes_matters_no_more_than_the_seed():
    order = np.random.default_rng(0).permutation(25)
    tasks = np.arange(25) // 5
    first = bootstrap_interval(mean_over_episodes(SAMPLE), tasks, num_resamples=20000)
    second = bootstrap_interval(mean_over_episodes(SAMPLE[order]), tasks[order], num_resamples=20000)
    assert (first.low, first.high) == pytest.approx((second.low, second.high), rel=0.02)


def test_the_same_seed_gives_the_same_interval_and_another_one_does_not():
    statistic = mean_over_episodes(SAMPLE)
    assert bootstrap_interval(statistic, ONE_TASK, seed=4) == bootstrap_interval(statistic, ONE_TASK, seed=4)
    assert bootstrap_interval(statistic, ONE_TASK, seed=4) != bootstrap_interval(statistic, ONE_TASK, seed=5)


def test_one_episode_or_one_usable_episode_gives_no_interval():
    assert bootstrap_interval(mean_over_episodes([3.0]), [0]) is None
    statistic = mean_over_episodes([3.0, np.inf, np.nan])
    assert statistic.num_left_out == 2
    assert statistic.value == 3.0
    assert bootstrap_interval(statistic, [0, 0, 0]) is None
    assert mean_over_episodes([np.inf]).value is None


def test_undefined_resamples_are_counted():
    statistic = mean_over_episodes([1.0, 2.0, np.inf])
    interval = bootstrap_interval(statistic, [0, 0, 0], num_resamples=5000, widened=False)
    # All three draws hit the infinite episode with probability 1/27.
    assert interval.num_undefined / 5000 == pytest.approx(1 / 27, abs=0.01)
    assert 1.0 <= interval.low <= interval.high <= 2.0


def test_ratio_of_means_without_any_denominator_is_infinite():
    statistic = ratio_of_means_over_episodes([0.5, 0.6], [0.0, 0.0])
    assert statistic.value == np.inf
    assert bootstrap_interval(statistic, [0, 0]) is None


def test_several_statistics_at_once_are_the_same_as_one_by_one():
    tasks = np.arange(25) // 5
    statistics = [mean_over_episodes(SAMPLE), geometric_mean_over_episodes(np.where(SAMPLE > 6, np.nan, SAMPLE))]
    together = bootstrap_intervals(statistics, resample_episodes(tasks, 500, 9))
    for statistic, interval in zip(statistics, together, strict=True):
        alone = bootstrap_interval(statistic, tasks, 500, seed=9)
        assert (interval.low, interval.high) == pytest.approx((alone.low, alone.high), rel=1e-12)


class RecordedGenerator:
    """numpy's generator; records the size of every array of uniform draws."""

    def __init__(self, generator: np.random.Generator, sizes: list[int]):
        self.integers = generator.integers
        self._random, self._sizes = generator.random, sizes

    def random(self, shape: tuple[int, ...]) -> np.ndarray:
        self._sizes.append(int(np.prod(shape)))
        return self._random(shape)


@pytest.mark.parametrize("most", [bootstrap._DRAWS_AT_ONCE, 1_234])
def test_draws_are_made_in_few_pieces_of_bounded_size(monkeypatch, most):
    make, sizes = np.random.default_rng, []
    monkeypatch.setattr(np.random, "default_rng", lambda seed: RecordedGenerator(make(seed), sizes))
    monkeypatch.setattr(bootstrap, "_DRAWS_AT_ONCE", most)
    num_resamples, tasks = 2000, np.arange(500) // 50
    counts = resample_episodes(tasks, num_resamples, seed=most).counts
    assert max(sizes) <= most
    assert len(sizes) == -(-num_resamples // (most // len(tasks)))
    assert sum(sizes) == num_resamples * len(tasks)
    assert np.array_equal(counts.sum(axis=1), np.full(num_resamples, len(tasks)))


def test_statistics_over_the_same_episodes_share_their_draws():
    tasks = np.arange(25) // 5
    draws = resample_episodes(tasks, 200, seed=3)
    assert resample_episodes([f"task {task}" for task in tasks], 200, seed=3) is draws
    assert resample_episodes(tasks + 10, 200, seed=3) is draws
    assert resample_episodes(tasks, 200, seed=4) is not draws
    assert resample_episodes(tasks[:-1], 200, seed=3) is not draws
    assert not draws.counts.flags.writeable
    one_task, other_task = (resample_episodes(np.full(5, task), 200, seed=3) for task in (2, 7))
    assert one_task is other_task


def test_columns_of_a_row_are_values_and_ends_by_name():
    tasks = np.arange(25) // 5
    draws = resample_episodes(tasks, 200, seed=3)
    statistics = {"mean": mean_over_episodes(SAMPLE), "nothing": mean_over_episodes(np.full(25, np.nan))}
    row = values_with_intervals(statistics, draws, level=0.8)
    interval = bootstrap_interval(statistics["mean"], tasks, 200, level=0.8, seed=3)
    assert list(row) == ["mean", "mean_low", "mean_high", "nothing", "nothing_low", "nothing_high"]
    expected = (statistics["mean"].value, interval.low, interval.high)
    assert (row["mean"], row["mean_low"], row["mean_high"]) == pytest.approx(expected, rel=1e-12)
    assert row["nothing"] is row["nothing_low"] is row["nothing_high"] is None
