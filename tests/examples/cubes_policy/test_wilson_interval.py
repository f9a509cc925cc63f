"""Wilson's interval against the published table and scipy."""

from __future__ import annotations

import pytest
from scipy import stats

from examples.cubes_policy.evaluate import wilson_interval


def test_the_interval_is_the_published_one() -> None:
    # Newcombe 1998, table I: 81 of 263 and 0 of 20, to four digits.
    assert wilson_interval(81, 263) == pytest.approx((0.2553, 0.3662), abs=1e-4)
    assert wilson_interval(0, 20) == pytest.approx((0.0, 0.1611), abs=1e-4)


@pytest.mark.parametrize(("successes", "count"), [(0, 1), (1, 1), (3, 7), (598, 600), (600, 600)])
def test_the_interval_is_that_of_scipy(successes, count) -> None:
    expected = stats.binomtest(successes, count).proportion_ci(0.95, method="wilson")
    assert wilson_interval(successes, count) == pytest.approx((expected.low, expected.high), abs=1e-6)
