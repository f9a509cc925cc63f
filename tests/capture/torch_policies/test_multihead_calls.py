"""Calls of nn.MultiheadAttention: rows against its own weights and a loop, per-head outputs, changes."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn

from tests.kit.attention_modules import Seen
from tests.kit.examples import examples
from vla_attention.capture.torch_policies.watch import seen_by_python, watch_attention


class Block(nn.Module):
    def __init__(self, **options) -> None:
        super().__init__()
        self.attention = nn.MultiheadAttention(16, 4, **options)

    def forward(self, hidden, memory, **masks):
        return self.attention(hidden, memory, memory, **masks)[0]


@given(data=st.data())
@settings(max_examples=examples(30))
def test_rows_and_results(data):
    torch.manual_seed(data.draw(st.integers(0, 999)))
    batch_first, dtype = data.draw(st.booleans()), data.draw(st.sampled_from([torch.float32, torch.bfloat16]))
    options = data.draw(st.sampled_from([{}, {"kdim": 12, "vdim": 12}, {"bias": False}, {"add_zero_attn": True}]))
    batch, queries, keys = data.draw(st.integers(1, 3)), data.draw(st.integers(1, 4)), data.draw(st.integers(2, 6))
    policy = Block(batch_first=batch_first, **options).to(dtype).eval()
    hidden, memory = (
        torch.randn(batch, queries, 16, dtype=dtype),
        torch.randn(batch, keys, options.get("kdim", 16), dtype=dtype),
    )
    mask = data.draw(st.sampled_from(["none", "bool", "additive", "per head", "padding"]))
    gone = torch.rand(batch, 4, queries, keys) < 0.4
    gone[..., 0] = False
    gone = {"none": gone & False, "bool": gone[:1, :1], "additive": gone[:1, :1], "per head": gone}.get(
        mask, gone[:, :1, :1]
    )
    masks = {"need_weights": data.draw(st.booleans())}
    if mask == "bool":
        masks["attn_mask"] = gone[0, 0]
    elif mask == "additive":
        masks["attn_mask"] = torch.zeros(queries, keys, dtype=dtype).masked_fill(gone[0, 0], float("-inf"))
    elif mask == "per head":
        masks["attn_mask"] = gone.flatten(0, 1)
    elif mask == "padding":
        masks["key_padding_mask"] = gone[:, 0, 0]
    if not batch_first:
        hidden, memory = hidden.transpose(0, 1), memory.transpose(0, 1)
    with seen_by_python():
        expected = policy(hidden, memory, **masks)
    seen = Seen()
    with watch_attention(policy, seen):
        result = policy(hidden, memory, **masks)
    assert torch.equal(result, expected)
    shape, call, rows = seen.shapes[0], seen.calls[0], seen.rows[0]
    # Before the weights change their dtype below.
    output = call.output.transpose(1, 2).flatten(2)
    extra = int("add_zero_attn" in options)
    assert (shape.module, shape.kind) == ("attention", "multihead")
    assert (shape.batch, shape.heads, shape.queries, shape.keys) == (batch, 4, queries, keys + extra)
    assert rows.dtype is torch.float32
    assert seen.errors[0] < (3e-6 if dtype is torch.float32 else 3e-2)
    # Its own weights, asked for by the public option.
    masks["need_weights"] = True
    if mask == "additive":
        masks["attn_mask"] = masks["attn_mask"].float()
    weights = policy.float().attention(
        hidden.float(), memory.float(), memory.float(), average_attn_weights=False, **masks
    )[1]
    # Of bfloat16, rows are of the queries and keys as the call projected and rounded them.
    torch.testing.assert_close(rows, weights, rtol=1e-4, atol=1e-5 if dtype is torch.float32 else 2e-2)
    torch.testing.assert_close(rows.sum(-1), torch.ones(rows.shape[:-1]))
    allowed = seen.allowed[0][..., :keys].expand(batch, 4, queries, keys)
    assert torch.equal(allowed, ~gone.expand(batch, 4, queries, keys))
    assert (rows[..., :keys][gone.expand(batch, 4, queries, keys)] == 0).all()
    # The output per head, projected, is what the module returned.
    projected = policy.attention.out_proj(output.float())
    returned = (result if batch_first else result.transpose(0, 1)).float()
    torch.testing.assert_close(
        projected,
        returned,
        rtol=1e-4 if dtype is torch.float32 else 2e-2,
        atol=1e-6 if dtype is torch.float32 else 2e-2,
    )


@pytest.mark.parametrize("options", [{}, {"add_zero_attn": True}, {"add_bias_kv": True}], ids=str)
@pytest.mark.parametrize("mask", ["none", "bool", "padding", "causal"])
def test_a_change_takes_keys_away(mask, options):
    torch.manual_seed(0)
    policy = Block(batch_first=True, **options).eval()
    hidden, memory = torch.randn(2, 5, 16), torch.randn(2, 5, 16)
    masks = {
        "none": {}, "bool": {"attn_mask": torch.ones(5, 5).triu(3).bool()},
        "padding": {"key_padding_mask": torch.tensor([[False] * 4 + [True]] * 2)},
        "causal": {"attn_mask": torch.ones(5, 5).triu(1).bool(), "is_causal": True, "need_weights": False},
    }[mask]  # fmt: skip
    knocked = torch.zeros(4, 1, 5 + bool(options))
    knocked[2, :, 1] = float("-inf")
    first, second = Seen(), Seen(changes=lambda shape: knocked)
    for seen in (first, second):
        with watch_attention(policy, seen):
            policy(hidden, memory, **masks)
    left = first.rows[0].clone()
    left[:, 2, :, 1] = 0
    torch.testing.assert_close(second.rows[0], left / left.sum(-1, keepdim=True), rtol=1e-5, atol=1e-6)
    assert second.errors[0] < 2e-6
    assert torch.equal(first.allowed[0], second.allowed[0])


def test_the_fast_path_is_off_inside_and_as_before_afterwards():
    """An encoder layer in eval mode calls nothing that can be seen on the fast path, which torch takes in no mode."""
    torch.manual_seed(0)
    policy = nn.TransformerEncoder(nn.TransformerEncoderLayer(16, 4, batch_first=True), 2).eval()
    hidden = torch.randn(2, 5, 16)
    for before in (True, False):
        torch.backends.mha.set_fastpath_enabled(before)
        try:
            seen = Seen()
            with torch.no_grad(), watch_attention(policy, seen):
                policy(hidden)
            assert [shape.module for shape in seen.shapes] == ["layers.0.self_attn", "layers.1.self_attn"]
            assert torch.backends.mha.get_fastpath_enabled() is before
        finally:
            torch.backends.mha.set_fastpath_enabled(True)
