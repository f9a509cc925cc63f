from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy import stats

from vla_attention.analyze.statistics.summaries import geometric_mean, summarize

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
