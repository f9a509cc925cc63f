"""The attention function against a direct computation, and the recorder: what it records and what it refuses."""

import numpy as np
import pytest
import torch

from vla_attention.capture.recording.attention import attend
from vla_attention.capture.recording.recorder import AttentionRecorder, RecordingPlan, SiteNotRecorded
from vla_attention.schemas.errors import BadArgument


def naive(query, key, value, mask, scale):
    """One query and key at a time, in float64: probabilities (batch, head, query, key) and outputs."""
    query, key, value = (x.double().numpy() for x in (query, key, value))
    batch, heads, queries, _ = query.shape
    group = heads // key.shape[1]
    rows = np.zeros((batch, heads, queries, key.shape[2]))
    out = np.zeros((batch, heads, queries, value.shape[-1]))
    for b, h, q in np.ndindex(batch, heads, queries):
        logits = np.array([scale * query[b, h, q] @ k for k in key[b, h // group]])
        allowed = np.ones(len(logits), dtype=bool) if mask is None else mask[b, q].numpy()
        weights = np.where(allowed, np.exp(logits - logits[allowed].max()), 0.0)
        rows[b, h, q] = weights / weights.sum()
        out[b, h, q] = rows[b, h, q] @ value[b, h // group]
    return rows, out


def random_inputs(batch=2, heads=4, kv_heads=2, queries=5, keys=7, dim=6, dtype=torch.float32):
    generator = torch.Generator().manual_seed(0)
    query = torch.randn(batch, heads, queries, dim, generator=generator).to(dtype)
    key = torch.randn(batch, kv_heads, keys, dim, generator=generator).to(dtype)
    value = torch.randn(batch, kv_heads, keys, dim, generator=generator).to(dtype)
    mask = torch.rand(batch, queries, keys, generator=generator) > 0.4
    mask[..., 0] = True
    return query, key, value, mask


@pytest.mark.parametrize("kv_heads", [1, 2, 4])
@pytest.mark.parametrize("masked", [False, True])
def test_matches_a_direct_computation(kv_heads, masked):
    query, key, value, mask = random_inputs(kv_heads=kv_heads)
    seen = []
    out = attend(query, key, value, mask if masked else None, 0.3, rows_to=seen.append)
    rows, expected = naive(query, key, value, mask if masked else None, 0.3)
    np.testing.assert_allclose(seen[0].numpy(), rows, atol=1e-6)
    np.testing.assert_allclose(out.numpy(), expected, atol=1e-6)
    if masked:
        assert (seen[0].numpy()[np.broadcast_to(~mask[:, None].numpy(), rows.shape)] == 0).all()


def test_one_mask_row_serves_all_queries():
    query, key, value, mask = random_inputs()
    one = mask[:, :1]
    torch.testing.assert_close(
        attend(query, key, value, one, 0.3), attend(query, key, value, one.expand(-1, 5, -1), 0.3), rtol=0, atol=0
    )


def test_a_query_without_keys_gets_a_uniform_row_not_nan():
    query, key, value, mask = random_inputs()
    mask[0, 2] = False
    seen = []
    out = attend(query, key, value, mask, 0.3, rows_to=seen.append)
    assert torch.isfinite(out).all()
    np.testing.assert_allclose(seen[0][0, :, 2].numpy(), 1 / 7, rtol=1e-6)


def test_bfloat16_inputs_give_float32_rows_of_unrounded_logits():
    query, key, value, mask = random_inputs(dtype=torch.bfloat16)
    seen = []
    out = attend(query, key, value, mask, 0.3, rows_to=seen.append)
    assert out.dtype == torch.bfloat16
    assert seen[0].dtype == torch.float32
    np.testing.assert_allclose(seen[0].numpy(), naive(query, key, value, mask, 0.3)[0], atol=1e-6)
    np.testing.assert_allclose(seen[0].sum(-1).numpy(), 1, atol=1e-6)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_recording_does_not_change_a_bit(dtype):
    query, key, value, mask = random_inputs(dtype=dtype)
    assert torch.equal(
        attend(query, key, value, mask, 0.3), attend(query, key, value, mask, 0.3, rows_to=lambda _: None)
    )


def plan(**changes):
    given = {"layers": (2, 0), "denoise_steps": (0, 3), "heads": (1, 3), "queries": "mean", "site": "joint"}
    return RecordingPlan(**{**given, **changes})


def fire(recorder, layers=range(3), steps=range(4), queries=5, keys=7, batch=1):
    """Play a model: rows that say where they come from."""
    sent = {}
    for step in steps:
        for layer in layers:
            generator = torch.Generator().manual_seed(10 * step + layer)
            rows = torch.rand(batch, 4, queries, keys, generator=generator)
            sent[layer, step] = rows.numpy()
            sink = recorder.sink(layer, step, slice(1, queries))
            assert (sink is not None) == recorder.wants(layer, step)
            if sink is not None:
                sink(rows)
                rows.zero_()  # the recorder must own what it keeps
                sent[layer, step] = torch.rand(
                    batch, 4, queries, keys, generator=torch.Generator().manual_seed(10 * step + layer)
                ).numpy()
    return sent


@pytest.mark.parametrize("queries", ["mean", "all"])
def test_recorder_keeps_the_planned_rows_in_the_planned_order(queries):
    recorder = AttentionRecorder(plan(queries=queries), num_keys=7)
    sent = fire(recorder)
    got = recorder.finish()
    expected = np.stack([[sent[layer, step][0, [1, 3], 1:] for step in (0, 3)] for layer in (2, 0)])
    if queries == "mean":
        expected = expected.mean(axis=3, keepdims=True)
    assert got.rows.dtype == got.row_sum.dtype == np.float32
    assert got.rows.shape == (2, 2, 2, 1 if queries == "mean" else 4, 7)
    np.testing.assert_allclose(got.rows, expected, rtol=1e-6)
    np.testing.assert_array_equal(got.row_sum, got.rows.astype(np.float64).sum(-1).astype(np.float32))


def test_a_call_that_never_came_is_an_error():
    recorder = AttentionRecorder(plan(), num_keys=7)
    fire(recorder, steps=range(3))
    with pytest.raises(SiteNotRecorded, match=r"'joint'.*layer 2 at denoise step 3"):
        recorder.finish()


def test_a_call_that_came_twice_is_an_error():
    recorder = AttentionRecorder(plan(), num_keys=7)
    fire(recorder)
    fire(recorder, layers=[0], steps=[3])
    with pytest.raises(SiteNotRecorded, match="layer 0 at denoise step 3 2 times"):
        recorder.finish()


def test_rows_of_another_shape_are_refused():
    with pytest.raises(ValueError, match="7 keys"):
        fire(AttentionRecorder(plan(), num_keys=7), keys=8)
    with pytest.raises(ValueError, match="batch of 1"):
        fire(AttentionRecorder(plan(), num_keys=7), batch=2)
    with pytest.raises(BadArgument, match="Head 4"):
        fire(AttentionRecorder(plan(heads=(4,)), num_keys=7))


@pytest.mark.parametrize("changes", [{"layers": (1, 1)}, {"queries": "median"}])
def test_a_plan_that_makes_no_sense_is_refused(changes):
    with pytest.raises(BadArgument, match="'joint'"):
        plan(**changes)
