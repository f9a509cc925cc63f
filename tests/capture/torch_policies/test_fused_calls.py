"""Calls through the kernels of torch: rows against a loop in float64, P·V, and unchanged results."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.nn.attention.flex_attention import create_block_mask, flex_attention
from torch.nn.functional import scaled_dot_product_attention as sdpa

from tests.kit.attention_modules import Policy, Seen, first_and_narrow, reference_rows
from tests.kit.examples import examples
from vla_attention.capture.torch_policies.watch import seen_by_python, watch_attention

TOLERANCE = {torch.float32: 2e-6, torch.bfloat16: 2e-2}


@st.composite
def cases(draw):
    queries, keys = draw(st.integers(1, 6)), draw(st.integers(1, 9))
    batch, kv_heads, group = draw(st.integers(1, 3)), draw(st.integers(1, 3)), draw(st.integers(1, 3))
    return {
        "queries": queries, "keys": keys, "batch": batch, "kv_heads": kv_heads, "heads": kv_heads * group,
        "mask": draw(st.sampled_from([None, "bool", "additive", "lowest", "2d", "3d", "causal"])),
        "dtype": draw(st.sampled_from([torch.float32, torch.bfloat16])),
        "scale": draw(st.sampled_from([None, 0.3])), "seed": draw(st.integers(0, 999)),
    }  # fmt: skip


def mask_of(case, generator):
    full = (case["batch"], 1, case["queries"], case["keys"])
    keep = torch.rand(full, generator=generator) < 0.6
    if case["mask"] == "bool":
        return keep, torch.where(keep, 0.0, float("-inf"))
    if case["mask"] == "additive":
        bias = torch.randn(full, generator=generator).to(case["dtype"])
        return bias.masked_fill(~keep, float("-inf")), bias.float().masked_fill(~keep, float("-inf"))
    if case["mask"] == "lowest":
        keep[..., 0] = True
        lowest = torch.zeros(full, dtype=case["dtype"]).masked_fill(~keep, torch.finfo(case["dtype"]).min)
        return lowest, lowest.float()
    if case["mask"] == "2d":
        return keep[0, 0], torch.where(keep[0, 0], 0.0, float("-inf"))
    if case["mask"] == "3d":
        return keep[0], torch.where(keep[0], 0.0, float("-inf"))
    if case["mask"] == "causal":
        return None, torch.where(torch.ones(full[2:]).tril().bool(), 0.0, float("-inf"))
    return None, None


@given(case=cases())
@settings(max_examples=examples(40))
def test_rows_and_results(case):
    generator = torch.Generator().manual_seed(case["seed"])
    torch.manual_seed(case["seed"])
    mask, logits = mask_of(case, generator)
    taken = []

    def attend(query, key, value, mask):
        taken.append((query.detach(), key.detach()))
        gqa = case["heads"] != case["kv_heads"]
        causal = case["mask"] == "causal"
        return sdpa(query, key, value, mask, is_causal=causal, scale=case["scale"], enable_gqa=gqa)

    policy = Policy(attend, heads=case["heads"], kv_heads=case["kv_heads"]).to(case["dtype"]).eval()
    width = policy.head.in_features
    hidden = torch.randn(case["batch"], case["queries"], width, generator=generator).to(case["dtype"])
    memory = torch.randn(case["batch"], case["keys"], width, generator=generator).to(case["dtype"])
    expected = policy(hidden, memory, mask)
    asked = Seen()
    with watch_attention(policy, asked):
        policy(hidden, memory, mask)
    assert asked.asked == asked.shapes
    for seen, result in first_and_narrow(policy, lambda: policy(hidden, memory, mask)):
        assert torch.equal(result, expected)
        assert [shape.module for shape in seen.shapes] == ["layers.0", "layers.1"]
        assert [shape.number for shape in seen.shapes] == [0, 1]
        assert max(seen.errors) < TOLERANCE[case["dtype"]]
        for (query, key), rows, allowed, shape in zip(taken[-2:], seen.rows, seen.allowed, seen.shapes, strict=True):
            assert (shape.batch, shape.heads, shape.kv_heads) == (case["batch"], case["heads"], case["kv_heads"])
            assert (shape.queries, shape.keys) == (case["queries"], case["keys"])
            assert rows.dtype is torch.float32
            reference = reference_rows(query, key, logits, case["scale"])
            torch.testing.assert_close(rows.double(), reference, rtol=1e-4, atol=2e-6)
            if logits is not None:
                keep = (logits > -5000).expand(case["batch"], 1, case["queries"], case["keys"])
                assert torch.equal(allowed, keep.expand(allowed.shape))
                assert (rows[~keep.expand(rows.shape)] == 0).all()
            else:
                assert allowed.all()


def test_rows_of_some_queries_and_batch_rows():
    torch.manual_seed(0)
    policy = Policy(lambda q, k, v, mask: sdpa(q, k, v, mask)).eval()
    hidden, memory = torch.randn(3, 5, 32), torch.randn(3, 7, 32)
    mask = torch.randn(3, 4, 5, 7)
    seen = Seen()
    with watch_attention(policy, seen):
        policy(hidden, memory, mask)
    call, rows = seen.calls[1], seen.rows[1]
    for queries in (slice(1, 4), slice(-2, None), slice(None, None, 2)):
        for batch in (slice(1, 2), slice(None)):
            some = call.rows(queries, batch)
            torch.testing.assert_close(some, rows[batch, :, queries], rtol=1e-6, atol=1e-7)
        assert call.product_error(some, queries) < 2e-6
        assert torch.equal(
            call.allowed(queries), torch.ones(3, call.allowed().shape[1], len(some[0, 0]), 7, dtype=torch.bool)
        )


@pytest.mark.parametrize("mask", [None, "bool", "additive", "causal"])
@pytest.mark.parametrize("kv_heads", [1, 2, 4])
def test_a_change_takes_keys_away(mask, kv_heads):
    torch.manual_seed(1)
    causal = mask == "causal"
    policy = Policy(
        lambda q, k, v, m: sdpa(q, k, v, m, is_causal=causal, enable_gqa=kv_heads < 4), kv_heads=kv_heads
    ).eval()  # fmt: skip
    hidden, memory = torch.randn(2, 5, 32), torch.randn(2, 7, 32)
    given = None
    if mask == "bool":
        given = torch.rand(2, 1, 5, 7) < 0.8
        given[..., 0] = True
    elif mask == "additive":
        given = torch.randn(2, 4, 5, 7)
    knocked = torch.zeros(7)
    knocked[3] = float("-inf")
    first, second = Seen(), Seen(changes=lambda shape: knocked if shape.module == "layers.1" else None)
    with watch_attention(policy, first):
        policy(hidden, memory, given)
    with watch_attention(policy, second):
        policy(hidden, memory, given)
    assert torch.equal(first.rows[0], second.rows[0])
    left = first.rows[1].clone()
    left[..., 3] = 0
    torch.testing.assert_close(second.rows[1], left / left.sum(-1, keepdim=True), rtol=1e-5, atol=1e-6)
    assert max(second.errors) < 2e-6
    assert torch.equal(first.allowed[1], second.allowed[1])


def test_folded_heads_are_taken_apart():
    """(batch · head, query, dim), as some code calls the kernel; the module tells how many heads there are."""

    def attend(query, key, value, mask):
        folded = [tensor.flatten(0, 1) for tensor in (query, key, value)]
        return sdpa(*folded).unflatten(0, query.shape[:2])

    torch.manual_seed(2)
    policy = Policy(attend).eval()
    plain = Policy(lambda q, k, v, mask: sdpa(q, k, v)).eval()
    plain.load_state_dict(policy.state_dict())
    hidden, memory = torch.randn(3, 5, 32), torch.randn(3, 7, 32)
    folded, unfolded = Seen(), Seen()
    with watch_attention(policy, folded):
        policy(hidden, memory)
    with watch_attention(plain, unfolded):
        plain(hidden, memory)
    assert [(s.batch, s.heads) for s in folded.shapes] == [(3, 4)] * 2
    torch.testing.assert_close(folded.rows, unfolded.rows)


@pytest.mark.parametrize("per_head_mask", [False, True])
def test_heads_that_are_packed_into_the_query_axis(per_head_mask):
    """What transformers 5 does with the one query of a decoding step; tests/policies runs the real code."""

    def packing(query, key, value, mask):
        batch, heads, _, dim = query.shape
        mask = mask.reshape(batch, 2, 2, -1) if per_head_mask else mask
        return sdpa(query.reshape(batch, 2, heads // 2, dim), key, value, mask).reshape(batch, heads, 1, dim)

    torch.manual_seed(0)
    packed = Policy(packing, heads=4, kv_heads=2).eval().requires_grad_(False)
    plain = Policy(lambda q, k, v, mask: sdpa(q, k, v, mask, enable_gqa=True), heads=4, kv_heads=2).eval()
    plain.load_state_dict(packed.state_dict())
    for layer in packed.layers:
        layer.num_key_value_groups, layer.config = 2, SimpleNamespace(num_attention_heads=4)
    hidden, memory = torch.randn(3, 1, 32), torch.randn(3, 7, 32)
    mask = torch.randn(3, 4 if per_head_mask else 1, 1, 7)
    knocked = torch.zeros(4, 1, 7)
    knocked[1, :, 3] = float("-inf")
    for changes in (lambda shape: None, lambda shape: knocked):
        first, second = Seen(changes=changes), Seen(changes=changes)
        for policy, seen in ((packed, first), (plain, second)):
            with watch_attention(policy, seen):
                policy(hidden, memory, mask)
        assert first.shapes == second.shapes
        torch.testing.assert_close(first.rows, second.rows)
        assert max(first.errors) < 2e-6


pytestmark = pytest.mark.filterwarnings(
    "ignore:flex_attention called without torch.compile", "ignore:`torch.jit.script_method` is deprecated"
)


def window(batch, head, query, key):
    return (query >= key - 3) & (key - query < 4) & (batch + key != 1)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("kv_heads", [1, 2, 4])
@pytest.mark.parametrize("scored", [False, True])
def test_rows_and_results_of_flex_attention(kv_heads, scored, masked, compiled, dtype):
    torch.manual_seed(0)
    bias, taken = torch.randn(4), []
    block_mask = create_block_mask(window, 2, None, 5, 7, device="cpu") if masked else None

    def score(value, batch, head, query, key):
        return value + bias[head] * (query - key)

    function = torch.compile(flex_attention) if compiled else flex_attention

    def attend(query, key, value, mask):
        taken.append((query.detach(), key.detach()))
        options = {"score_mod": score if scored else None, "block_mask": block_mask}
        return function(query, key, value, enable_gqa=kv_heads < 4, **options)

    policy = Policy(attend, heads=4, kv_heads=kv_heads).to(dtype).eval().requires_grad_(False)
    hidden, memory = torch.randn(2, 5, 32, dtype=dtype), torch.randn(2, 7, 32, dtype=dtype)
    with seen_by_python():
        expected = policy(hidden, memory)
    taken.clear()
    seen = Seen()
    with watch_attention(policy, seen):
        result = policy(hidden, memory)
    assert torch.equal(result, expected)
    assert [(shape.module, shape.kind) for shape in seen.shapes] == [("layers.0", "flex"), ("layers.1", "flex")]
    assert max(seen.errors) < (2e-6 if dtype is torch.float32 else 2e-2)
    b, h, q, k = torch.meshgrid(*(torch.arange(n) for n in (2, 4, 5, 7)), indexing="ij")
    keep = window(b, h, q, k) if masked else torch.ones(2, 4, 5, 7, dtype=torch.bool)
    logits = (bias[h] * (q - k) if scored else torch.zeros(2, 4, 5, 7)).masked_fill(~keep, float("-inf"))
    for (query, key), rows, allowed, call in zip(taken, seen.rows, seen.allowed, seen.calls, strict=True):
        torch.testing.assert_close(rows.double(), reference_rows(query, key, logits), rtol=1e-4, atol=2e-6)
        assert torch.equal(allowed, keep)
        torch.testing.assert_close(call.rows(slice(1, 5, 3), slice(1, 2)), rows[1:2, :, 1:5:3])


def test_a_change_takes_keys_away_from_flex_attention():
    torch.manual_seed(1)
    block_mask = create_block_mask(window, 2, None, 5, 7, device="cpu")
    policy = Policy(lambda q, k, v, m: flex_attention(q, k, v, block_mask=block_mask)).eval().requires_grad_(False)
    hidden, memory = torch.randn(2, 5, 32), torch.randn(2, 7, 32)
    knocked = torch.zeros(4, 1, 7)
    knocked[1, :, 3] = float("-inf")
    first, second = Seen(), Seen(changes=lambda shape: knocked if shape.module == "layers.1" else None)
    for seen in (first, second):
        with watch_attention(policy, seen):
            policy(hidden, memory)
    left = first.rows[1].clone()
    left[:, 1, :, 3] = 0
    torch.testing.assert_close(second.rows[1], left / left.sum(-1, keepdim=True), rtol=1e-5, atol=1e-6)
    assert max(second.errors) < 2e-6
    assert torch.equal(first.allowed[1], second.allowed[1])


@pytest.mark.filterwarnings("ignore:flex_attention called without torch.compile")
@pytest.mark.parametrize("low", [-30.0, -100.0, float("-inf")])
def test_a_score_function_of_flex_attention_may_mask(low):
    torch.manual_seed(0)
    policy = Policy(
        lambda q, k, v, m: flex_attention(q, k, v, score_mod=lambda s, b, h, i, j: torch.where(j == 3, s + low, s))
    )
    seen = Seen()
    with watch_attention(policy.eval().requires_grad_(False), seen):
        policy(torch.randn(1, 5, 32), torch.randn(1, 7, 32))
    wanted = (torch.arange(7) != 3) | (low == -30.0)
    assert torch.equal(seen.allowed[0], wanted.expand(1, 4, 5, 7))
