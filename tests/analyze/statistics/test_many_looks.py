"""Adjusted p-values and leaders: against scipy, and on samples in which nothing leads."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from vla_attention.analyze.statistics.many_looks import adjusted_p_values


@given(st.lists(st.floats(0, 1), max_size=20))
def test_adjusted_p_values_are_those_of_scipy(p_values):
    expected = stats.false_discovery_control(p_values, method="bh") if p_values else []
    assert adjusted_p_values(p_values) == pytest.approx(list(expected))


def test_a_missing_p_value_is_not_a_look():
    assert adjusted_p_values([0.01, None, 0.04]) == [pytest.approx(0.02), None, pytest.approx(0.04)]
    assert adjusted_p_values([None]) == [None]
