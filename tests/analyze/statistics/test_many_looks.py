"""Adjusted p-values and leaders: against scipy, and on samples in which nothing leads."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from vla_attention.analyze.statistics.intervals import Estimand
from vla_attention.analyze.statistics.many_looks import adjusted_p_values, leader
from vla_attention.analyze.statistics.units import Units


@given(st.lists(st.floats(0, 1), max_size=20))
def test_adjusted_p_values_are_those_of_scipy(p_values):
    expected = stats.false_discovery_control(p_values, method="bh") if p_values else []
    assert adjusted_p_values(p_values) == pytest.approx(list(expected))


def test_a_missing_p_value_is_not_a_look():
    assert adjusted_p_values([0.01, None, 0.04]) == [pytest.approx(0.02), None, pytest.approx(0.04)]
    assert adjusted_p_values([None]) == [None]


@pytest.mark.parametrize("num_items", [2, 8])
@pytest.mark.parametrize("num_tasks", [1, 6])
def test_where_all_items_are_alike_a_leader_is_seldom_named(num_items, num_tasks):
    generator = np.random.default_rng(num_items + num_tasks)
    tasks = np.arange(30) % num_tasks
    named = 0
    for _ in range(400):
        values = generator.normal(1.0, 0.3, (30, num_items)) + generator.normal(0, 1, (30, 1))
        named += leader(values, Units.of(tasks)).is_named()
    # Two items alike reach the level, more stay below it; three standard errors of 400 samples are 3.3 %.
    assert named / 400 <= 0.05 + 0.033 * (num_items == 2)


@pytest.mark.parametrize("estimand", Estimand)
def test_a_planted_leader_is_named_and_two_equal_leaders_are_not(estimand):
    generator = np.random.default_rng(0)
    tasks = np.arange(40) // 8
    values = generator.normal(1.0, 0.3, (40, 5))
    values[:, 3] += 0.8
    found = leader(values, Units.of(tasks, estimand))
    assert found.item == 3
    assert found.num_items == 5
    assert found.is_named(10)
    values[:, 1] = values[:, 3] + generator.normal(0, 0.3, 40)
    assert not leader(values, Units.of(tasks, estimand)).is_named()
