"""Exact intervals against scipy and the published table."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from vla_attention.capture.doctor.binomial import (
    at_most,
    exact_interval,
    most_that_is_too_few,
    rate_found_in_nine_of_ten,
)


@given(count=st.integers(1, 600), share=st.floats(0, 1), rate=st.floats(0, 1))
def test_the_probability_of_few_successes_is_the_binomial_one(count, share, rate):
    successes = round(share * count)
    assert at_most(successes, count, rate) == pytest.approx(stats.binom.cdf(successes, count, rate), abs=1e-9)


@given(count=st.integers(1, 600), share=st.floats(0, 1))
def test_intervals_are_those_of_clopper_and_pearson(count, share):
    successes = round(share * count)
    expected = stats.binomtest(successes, count).proportion_ci(0.95, method="exact")
    assert exact_interval(successes, count) == pytest.approx((expected.low, expected.high), abs=1e-9)


@given(count=st.integers(1, 40), rate=st.floats(0.05, 1))
def test_too_few_is_what_lies_below(count, rate):
    too_few = most_that_is_too_few(count, rate)
    assert too_few < 0 or exact_interval(too_few, count)[1] < rate
    assert too_few + 1 == count or exact_interval(too_few + 1, count)[1] >= rate
    if too_few >= 0:
        found = rate_found_in_nine_of_ten(count, too_few)
        assert stats.binom.cdf(too_few, count, found) == pytest.approx(0.9, abs=1e-6)
        assert found < rate
    else:
        assert rate_found_in_nine_of_ten(count, too_few) == 0


@pytest.mark.parametrize(("successes", "count"), [(-1, 10), (11, 10), (0, 0)])
def test_no_number_of_successes(successes, count):
    with pytest.raises(ValueError, match="is no number of successes"):
        exact_interval(successes, count)
