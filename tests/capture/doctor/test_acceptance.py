"""Which published rate a checkpoint is held against, and when it is accepted; nothing is simulated."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from vla_attention.capture.doctor.acceptance import (
    at_most,
    exact_interval,
    find_published_rate,
    judge,
)
from vla_attention.capture.policies.families import default_family
from vla_attention.capture.policies.family import PublishedRate


def test_the_rate_of_the_policy_that_comes_along_is_the_measured_one():
    """docs/cubes.md has its table: the twelve tasks, two with sides, three with a fourth cube."""
    rate = find_published_rate("pi05_cubes", "cubes", default_family())
    assert (rate.solved, rate.episodes) == (598 + 48 + 46 + 150, 600 + 50 + 50 + 150)


def test_a_policy_is_accepted_where_the_intervals_overlap():
    published = PublishedRate("a", "cubes", 842, 850, "docs/cubes.md")
    verdicts = [judge(solved, 10, published) for solved in range(11)]
    low = stats.binomtest(842, 850).proportion_ci(method="exact").low
    for solved, verdict in enumerate(verdicts):
        assert verdict.accepted is (stats.binomtest(solved, 10).proportion_ci(method="exact").high >= low), solved
    assert [verdict.accepted for verdict in verdicts] == [False] * 9 + [True] * 2
    # A policy as good as published is refused in less than one of two hundred runs.
    assert stats.binom.cdf(8, 10, 842 / 850) < 0.005


@given(count=st.integers(1, 600), share=st.floats(0, 1), rate=st.floats(0, 1))
def test_the_probability_of_few_successes_is_the_binomial_one(count, share, rate):
    successes = round(share * count)
    assert at_most(successes, count, rate) == pytest.approx(stats.binom.cdf(successes, count, rate), abs=1e-9)


@given(count=st.integers(1, 600), share=st.floats(0, 1))
def test_intervals_are_those_of_clopper_and_pearson(count, share):
    successes = round(share * count)
    expected = stats.binomtest(successes, count).proportion_ci(0.95, method="exact")
    assert exact_interval(successes, count) == pytest.approx((expected.low, expected.high), abs=1e-9)
