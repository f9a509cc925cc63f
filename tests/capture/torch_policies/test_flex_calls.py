"""Calls through flex_attention: score and mask functions, groups, changes."""

from __future__ import annotations

import pytest
import torch
from torch.nn.attention.flex_attention import create_block_mask, flex_attention

from tests.kit.attention_modules import Policy, Seen, reference_rows
from vla_attention.capture.torch_policies.watch import seen_by_python, watch_attention

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
def test_rows_and_results(kv_heads, scored, masked, compiled, dtype):
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
        torch.testing.assert_close(call.rows([4, 1], [1]), rows[[1]][:, :, [4, 1]])


def test_a_change_takes_keys_away():
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
