"""Wilson's interval against the published table and scipy."""

from __future__ import annotations

import pytest
from scipy import stats

from examples.cubes_policy.evaluate import wilson_interval


@pytest.mark.parametrize(("successes", "count"), [(0, 1), (1, 1), (3, 7), (598, 600), (600, 600)])
def test_the_interval_is_that_of_scipy(successes, count) -> None:
    expected = stats.binomtest(successes, count).proportion_ci(0.95, method="wilson")
    assert wilson_interval(successes, count) == pytest.approx((expected.low, expected.high), abs=1e-6)
