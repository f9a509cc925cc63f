"""Entropy, top-k mass, sinks' counts, dispersion and depth on arrays, against scipy and plain loops."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from tests.kit.examples import examples
from vla_attention.analyze.heads.depth import depth_centre
from vla_attention.analyze.heads.entropy import effective_keys, entropies, top_mass
from vla_attention.analyze.heads.head_measures import dispersion
from vla_attention.analyze.heads.row_metrics import RowOptions
from vla_attention.analyze.measures.masses import finite_mean
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


@given(drawn=rows_and_weights())
def test_entropy_is_scipys_and_of_fractions_of_keys_its_divergence_from_the_weights(drawn):
    rows, weights = drawn
    given = entropies(rows, weights)
    assert given.shape == (*rows.shape[:2], weights.shape[2])
    for replan, head, group in np.ndindex(given.shape):
        part = weights[min(replan, len(weights) - 1), :, group].astype(np.float64)
        taken = rows[replan, head] * part
        value = given[replan, head, group]
        if taken.sum() == 0:
            assert np.isnan(value)
            continue
        expected = np.log(part.sum()) - stats.entropy(taken, part)
        assert value == pytest.approx(expected, abs=2e-4)
        if set(np.unique(part)) <= {0.0, 1.0}:
            assert value == pytest.approx(stats.entropy(rows[replan, head][part == 1]), abs=2e-4)
            assert value >= 0
        assert effective_keys(value) <= part.sum() * 1.001


@given(seed=st.integers(0, 2**16), parts=st.integers(2, 5))
def test_a_key_cut_into_parts_counts_as_the_sum_of_its_parts(seed, parts):
    """Attention that is the same all over a patch has an entropy that does not depend on how the patch is cut up."""
    row = np.random.default_rng(seed).dirichlet(np.ones(6)).astype(np.float32)
    whole = entropies(row[None], np.ones((1, 6, 1), np.float32))
    cut = np.repeat(row, parts)[None]  # the same density of attention per whole key
    pieces = entropies(cut, np.full((1, 6 * parts, 1), 1.0 / parts, np.float32))
    assert pieces[0] == pytest.approx(whole[0], abs=1e-4)


@given(keys=st.integers(1, 2000))
def test_uniform_attention_has_as_many_effective_keys_as_keys_and_one_spike_has_one(keys):
    ones = np.ones((1, keys, 1), np.float32)
    uniform = np.full((1, keys), 1.0 / keys, np.float32)
    assert effective_keys(entropies(uniform, ones))[0, 0] == pytest.approx(keys, rel=1e-3)
    spike = np.zeros((1, keys), np.float32)
    spike[0, keys // 2] = 1.0
    assert effective_keys(entropies(spike, ones))[0, 0] == pytest.approx(1.0, abs=1e-5)


@given(drawn=rows_and_weights(), counts=st.lists(st.integers(1, 60), min_size=1, max_size=4, unique=True))
def test_top_mass_is_the_share_of_the_largest_valid_keys(drawn, counts):
    rows, weights = drawn
    valid = weights[:, :, 0] > 0
    given = top_mass(rows, valid, counts)
    for replan, head in np.ndindex(rows.shape[:2]):
        seen = rows[replan, head][valid[min(replan, len(valid) - 1)]].astype(np.float64)
        for i, count in enumerate(counts):
            if seen.sum() == 0:
                assert np.isnan(given[replan, head, i])
            else:
                expected = sum(sorted(seen, reverse=True)[:count]) / seen.sum()
                assert given[replan, head, i] == pytest.approx(expected, rel=1e-5)


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


@given(
    values=st.lists(st.floats(-5, 5, width=16) | st.sampled_from([np.nan, np.inf, -np.inf]), min_size=1, max_size=12)
)
def test_dispersion_is_that_of_numpy_over_finite_heads(values):
    array = np.array([values, values[::-1]])
    std, variation = dispersion(array)
    finite = array[0][np.isfinite(array[0])]
    assert std.shape == (2,)
    if len(finite) < 2:
        assert np.isnan(std).all()
        assert np.isnan(variation).all()
        return
    assert std == pytest.approx(np.full(2, finite.std()), abs=1e-9)
    if abs(finite.mean()) > 1e-6:
        assert variation[0] == pytest.approx(stats.variation(finite), rel=1e-6, abs=1e-9)
    assert finite_mean(array, axis=1) == pytest.approx(np.full(2, finite.mean()), abs=1e-9)


@given(seed=st.integers(0, 2**16), layers=st.integers(1, 18))
@settings(max_examples=examples(50))
def test_depth_is_a_weighted_mean_of_blocks(seed, layers):
    generator = np.random.default_rng(seed)
    blocks = np.sort(generator.choice(28, layers, replace=False))
    amounts = generator.random((3, layers))
    centre = depth_centre(amounts, blocks)
    for row, value in zip(amounts, centre, strict=True):
        assert value == pytest.approx(np.average(blocks, weights=row))
    assert depth_centre(np.ones(layers), blocks) == pytest.approx(blocks.mean())
    assert np.isnan(depth_centre(np.zeros(layers), blocks))


@pytest.mark.parametrize(
    "wrong", [{"factor": 0.5}, {"factor": float("inf")}, {"share": 0.0}, {"share": 1.1}, {"mass": 0.0}, {"heads": 2.0}]
)
def test_a_useless_sink_rule_is_refused(wrong):
    with pytest.raises(BadArgument, match="sink"):
        SinkRule(**wrong)


@pytest.mark.parametrize("top", [(), (0,), (1, 1), (-3, 2)])
def test_numbers_of_largest_keys_are_checked(top):
    with pytest.raises(BadArgument, match="whole numbers from 1"):
        RowOptions(top=top)
