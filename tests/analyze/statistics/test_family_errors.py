"""The cluster-robust error of a mean over tasks: against its definition by matrices, t intervals and known truths."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import linalg, stats

from vla_attention.analyze.statistics.intervals import (
    estimates,
    family_error,
    mean_over_episodes,
    ratio_of_means_over_episodes,
)
from vla_attention.analyze.statistics.two_samples import mean_difference
from vla_attention.analyze.statistics.units import Estimand, Units

SIZES = (3, 6, 3, 3, 2)
FAMILIES = np.repeat(np.arange(len(SIZES)), SIZES)
GENERATOR = np.random.default_rng(5)


def by_definition(values, families, columns=None):
    """CR2 variance and Satterthwaite degrees of the first coefficient of a regression on `columns`, by matrices."""
    count = len(values)
    x = np.ones((count, 1)) if columns is None else columns
    weight = np.array([1.0, *[-1.0] * (x.shape[1] - 1)])
    inverse = np.linalg.inv(x.T @ x)
    rest = np.eye(count) - x @ inverse @ x.T
    vectors = []
    for family in np.unique(families):
        own = families == family
        adjust = linalg.fractional_matrix_power(rest[np.ix_(own, own)], -0.5).real
        vectors.append(rest[own].T @ adjust @ x[own] @ inverse @ weight)
    quadratic = np.array(vectors)
    gram = quadratic @ quadratic.T
    return ((quadratic @ values) ** 2).sum(), np.trace(gram) ** 2 / (gram**2).sum()


def of_mean(values, families):
    variance, degrees = family_error(values - values.mean(), np.ones(len(values), dtype=bool), families)
    return float(variance), float(degrees)


@pytest.mark.parametrize("sizes", [SIZES, (5, 1, 1, 1, 1, 1), (2, 2, 2, 2), (1, 1, 1, 1, 1), (12, 4, 2, 1)])
def test_the_error_is_that_of_its_definition(sizes):
    families = np.repeat(np.arange(len(sizes)), sizes)
    values = GENERATOR.normal(size=len(families))
    assert of_mean(values, families) == pytest.approx(by_definition(values, families))


def test_families_of_one_task_are_the_t_interval_over_tasks():
    values = GENERATOR.normal(size=9)
    variance, degrees = of_mean(values, np.arange(9))
    assert (variance, degrees) == (pytest.approx(values.var(ddof=1) / 9), 8.0)


def test_families_of_equal_size_are_the_t_interval_over_their_means():
    values = GENERATOR.normal(size=(6, 4))
    variance, degrees = of_mean(values.ravel(), np.repeat(np.arange(6), 4))
    assert (variance, degrees) == (pytest.approx(values.mean(axis=1).var(ddof=1) / 6), 5.0)


@given(st.lists(st.integers(1, 9), min_size=2, max_size=8), st.integers(0, 1000))
@settings(deadline=None, max_examples=50)
def test_the_variance_is_unbiased_where_tasks_are_independent_and_degrees_are_between_one_and_families(sizes, seed):
    families = np.repeat(np.arange(len(sizes)), sizes)
    # The expectation of a quadratic form of independent values of variance 1 is its trace: over the unit vectors.
    units = np.eye(len(families))
    expected = sum(of_mean(unit, families)[0] for unit in units)
    assert expected == pytest.approx(1 / len(families))
    degrees = of_mean(np.random.default_rng(seed).normal(size=len(families)), families)[1]
    assert 1 <= degrees <= len(sizes) - 1 + 1e-9


def test_each_statistic_counts_the_families_of_the_tasks_that_it_uses():
    tasks = np.repeat(np.arange(17), 2)
    values = GENERATOR.normal(size=(3, 34))
    values[1, FAMILIES[tasks] == 4] = np.nan  # without the last family
    values[2, FAMILIES[tasks] > 2] = np.nan  # of three families
    units = Units.of(tasks, families=[f"family {family}" for family in FAMILIES[tasks]])
    found = estimates([mean_over_episodes(values)], units)
    for number, used in enumerate((np.arange(17), np.flatnonzero(FAMILIES < 4))):
        one = found[number]
        means = np.array([values[number, tasks == task].mean() for task in used])
        variance, degrees = by_definition(means, FAMILIES[used])
        assert one.value == pytest.approx(means.mean())
        assert (one.error, one.degrees) == (pytest.approx(np.sqrt(variance)), pytest.approx(degrees))
    assert found[2].value is not None
    assert found[2].error is None
    assert found[0].interval().high == pytest.approx(
        found[0].value + stats.t.ppf(0.975, found[0].degrees) * found[0].error
    )


def test_the_quotient_of_means_is_linearised():
    above, below = GENERATOR.uniform(1, 2, 17), GENERATOR.uniform(2, 3, 17)
    one = estimates([ratio_of_means_over_episodes(above, below)], Units.of(np.arange(17), families=FAMILIES))[0]
    quotient = above.mean() / below.mean()
    variance, degrees = by_definition((above - quotient * below) / below.mean(), FAMILIES)
    assert one.value == pytest.approx(quotient)
    assert one.error == pytest.approx(np.sqrt(variance) / quotient)  # of the logarithm
    assert one.degrees == pytest.approx(degrees)


def test_related_tasks_are_not_counted_as_independent():
    """Families differ by 1 and their tasks by 0.4: intervals by families cover, those over tasks miss a third."""
    generator, tasks = np.random.default_rng(11), np.arange(17)
    kinds = {"families": Units.of(tasks, families=FAMILIES), "tasks": Units.of(tasks)}
    held = dict.fromkeys(kinds, 0)
    for _ in range(400):
        values = generator.normal(size=len(SIZES))[FAMILIES] + 0.4 * generator.normal(size=17)
        for name, units in kinds.items():
            interval = estimates([mean_over_episodes(values)], units)[0].interval()
            held[name] += interval.low <= 0 <= interval.high
    assert 0.92 < held["families"] / 400 < 0.98
    assert held["tasks"] / 400 < 0.75


def classes(shared):
    """Values of two classes of episodes with the units; every task has an episode of either, or of one of them."""
    tasks = np.arange(17)
    first = np.ones(17, dtype=bool) if shared else FAMILIES % 2 == 0
    second = ~first | shared
    of_tasks = np.concatenate([tasks[first], tasks[second]])
    is_first = np.arange(len(of_tasks)) < first.sum()
    return GENERATOR.normal(size=len(of_tasks)), is_first, of_tasks


def test_the_difference_of_two_classes_is_the_regression_on_both():
    values, is_first, tasks = classes(shared=True)
    columns = np.stack([is_first, ~is_first], axis=1).astype(float)
    variance, degrees = by_definition(values, FAMILIES[tasks], columns)
    one = mean_difference(values, is_first, Units.of(tasks, families=FAMILIES[tasks])).difference
    assert one.error == pytest.approx(np.sqrt(variance))
    # Both classes have the same families, and neither more degrees than one of them alone.
    assert one.degrees == pytest.approx(by_definition(values[is_first], FAMILIES)[1])
    assert one.degrees <= degrees + 1e-9


def test_classes_of_few_families_are_compared_in_these_tasks():
    values, is_first, tasks = classes(shared=False)
    twice = np.concatenate([values, values + GENERATOR.normal(size=len(values))])
    units = Units.of(np.tile(tasks, 2), families=FAMILIES[np.tile(tasks, 2)])
    found = mean_difference(twice, np.tile(is_first, 2), units)
    assert found.estimand == Estimand.THESE_TASKS
    these = mean_difference(twice, np.tile(is_first, 2), Units.of(np.tile(tasks, 2), Estimand.THESE_TASKS))
    assert found.difference == these.difference
    assert found.difference.error is not None
