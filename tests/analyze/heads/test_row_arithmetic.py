"""Sinks' counts on arrays, against a loop."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vla_attention.analyze.measures.sinks import SinkRule, key_sums
from vla_attention.schemas.errors import BadArgument


@st.composite
def rows_and_weights(draw: st.DrawFn):
    """Rows (replan, head, key) with exact zeros, of any sum; weights (replan or 1, key, group): 0, 1 and fractions."""
    generator = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    replans, heads, keys = draw(st.integers(1, 3)), draw(st.integers(1, 3)), draw(st.integers(1, 40))
    rows = np.exp(generator.normal(0, draw(st.sampled_from([0.1, 3.0])), (replans, heads, keys)))
    rows *= generator.random(rows.shape) < draw(st.sampled_from([1.0, 0.6]))
    rows /= np.maximum(rows.sum(axis=-1, keepdims=True), 1e-9)
    shape = (draw(st.sampled_from([1, replans])), keys, 4)
    weights = (generator.random(shape) < 0.6).astype(np.float32)
    weights[:, :, 2:] *= generator.random((*shape[:2], 2))
    return rows.astype(np.float32), weights.astype(np.float32)


@given(drawn=rows_and_weights(), factor=st.sampled_from([1.0, 1.5, 3.0, 10.0]))
def test_counts_of_keys_far_above_their_share_are_those_of_a_loop(drawn, factor):
    rows, weights = drawn
    valid = weights[:, :, 0] > 0
    above, held = key_sums(rows, valid, factor / np.maximum(valid.sum(axis=1), 1)[:, None, None])
    expected_above, expected_held = np.zeros(rows.shape[1:]), np.zeros(rows.shape[1:])
    for replan, head in np.ndindex(rows.shape[:2]):
        mask = valid[min(replan, len(valid) - 1)]
        total = rows[replan, head][mask].sum(dtype=np.float64)
        if total == 0:
            continue
        share = np.where(mask, rows[replan, head] / total, 0.0)
        expected_held[head] += share
        # A share that is equal to the limit but for rounding may fall on either side.
        near = np.isclose(share * mask.sum(), factor, rtol=1e-5)
        if near.any():
            return
        expected_above[head] += share > factor / mask.sum()
    np.testing.assert_array_equal(above, expected_above)
    np.testing.assert_allclose(held, expected_held, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize(
    "wrong", [{"factor": 0.5}, {"factor": float("inf")}, {"share": 0.0}, {"share": 1.1}, {"mass": 0.0}, {"heads": 2.0}]
)
def test_a_useless_sink_rule_is_refused(wrong):
    with pytest.raises(BadArgument, match="sink"):
        SinkRule(**wrong)
