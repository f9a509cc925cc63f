"""transformers' attention interface: every implementation that runs here computes attention in a way that is seen."""

from __future__ import annotations

from typing import Any

import pytest

pytest.importorskip("transformers", reason="run by make test-policies")

import torch
from transformers import AttentionInterface, Gemma3ForCausalLM, Gemma3TextConfig, LlamaConfig, LlamaForCausalLM

from tests.kit.attention_modules import Seen
from vla_attention.capture.torch_policies.unseen_attention import UnseenAttention
from vla_attention.capture.torch_policies.watch import seen_by_python, watch_attention

SIZES: dict[str, Any] = {
    "hidden_size": 32, "intermediate_size": 48, "num_hidden_layers": 3, "num_attention_heads": 4, "vocab_size": 50,
    "num_key_value_heads": 2, "head_dim": 8, "bos_token_id": 1, "eos_token_id": None, "pad_token_id": 0,
}  # fmt: skip
KINDS = {"sdpa": "sdpa", "eager": "softmax", "flex_attention": "flex"}
#: Two prompts, the second with padding on the left.
IDS = torch.tensor([[1, 5, 9, 12, 7], [0, 0, 1, 6, 8]])
MASK = (IDS > 0).long()


def llama(attention: str, **changes: Any) -> Any:
    torch.manual_seed(0)
    return (
        LlamaForCausalLM(LlamaConfig(**{**SIZES, **changes}, attn_implementation=attention))
        .eval()
        .requires_grad_(False)
    )


def gemma3(attention: str) -> Any:
    torch.manual_seed(0)
    config = Gemma3TextConfig(**SIZES, sliding_window=3, attn_implementation=attention, query_pre_attn_scalar=8)
    return Gemma3ForCausalLM(config).eval().requires_grad_(False)


@pytest.mark.parametrize("model", [llama, gemma3])
@pytest.mark.parametrize("attention", KINDS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_generation_is_seen_and_stays_as_it_is(model, attention, dtype):
    policy = model(attention).to(dtype)

    def call():
        return policy.generate(IDS, attention_mask=MASK, max_new_tokens=4, do_sample=False)

    with seen_by_python():
        expected = call()
        logits = policy(IDS, attention_mask=MASK).logits
    seen = Seen()
    with watch_attention(policy, seen):
        result = call()
        watched = policy(IDS, attention_mask=MASK).logits
    assert torch.equal(result, expected)
    assert torch.equal(watched, logits)
    assert {shape.kind for shape in seen.shapes} == {KINDS[attention]}
    # Four passes of generation (the prompt, then token after token) and one of the prompt alone.
    assert [shape.module for shape in seen.shapes] == [f"model.layers.{layer}.self_attn" for layer in range(3)] * 5
    assert [shape.queries for shape in seen.shapes[::3]] == [5, 1, 1, 1, 5]
    assert max(seen.errors) < (2e-6 if dtype is torch.float32 else 2e-2)
    for shape, rows, allowed in zip(seen.shapes, seen.rows, seen.allowed, strict=True):
        assert (shape.batch, shape.heads) == (2, 4)
        if shape.queries == 1:
            assert (rows[~allowed.expand(rows.shape)] == 0).all()
            torch.testing.assert_close(rows.sum(-1), torch.ones(rows.shape[:-1]), rtol=0, atol=2e-6)
            # Gemma's layers see a window of three keys, which the padding has left.
            if model is llama:
                assert (rows[1, :, :, :2] == 0).all()


@pytest.mark.parametrize("kv_heads", [1, 2, 4])
def test_implementations_agree_on_the_rows(kv_heads):
    """At one query, transformers 5 packs the heads of a group into the query axis of the kernel: taken apart again."""
    found = {}
    for attention in KINDS:
        seen, policy = Seen(), llama(attention, num_key_value_heads=kv_heads)
        with watch_attention(policy, seen):
            policy.generate(IDS, attention_mask=MASK, max_new_tokens=3, do_sample=False)
        found[attention] = [
            rows if shape.queries == 1 else rows[:1] for shape, rows in zip(seen.shapes, seen.rows, strict=True)
        ]
    for attention in ("eager", "flex_attention"):
        torch.testing.assert_close(found[attention], found["sdpa"], rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("attention", KINDS)
def test_a_change_reaches_every_implementation(attention):
    knocked = torch.zeros(5)
    knocked[0] = float("-inf")
    policy, last = llama(attention), "model.layers.2.self_attn"
    change = lambda shape: torch.cat([torch.zeros(1, 5), knocked.expand(4, 5)]) if shape.module == last else None  # noqa: E731
    first, second = Seen(), Seen(changes=change)
    for seen in (first, second):
        with watch_attention(policy, seen):
            policy(IDS[:1])
    left = first.rows[2].clone()
    left[:, :, 1:, 0] = 0
    torch.testing.assert_close(second.rows[2], left / left.sum(-1, keepdim=True), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("attention", KINDS)
def test_a_change_of_one_head_while_decoding(attention):
    """A key is taken from head 3 at every decoding step, from no other head."""
    knocked = torch.zeros(4, 1, 1)
    knocked[3] = float("-inf")

    def change(shape):
        if shape.queries > 1:
            return None
        return torch.cat([torch.zeros(4, 1, shape.keys - 1), knocked], dim=-1)

    policy, seen = llama(attention), Seen(changes=change)
    with watch_attention(policy, seen):
        policy.generate(IDS, attention_mask=MASK, max_new_tokens=3, do_sample=False)
    decoding = [rows for shape, rows in zip(seen.shapes, seen.rows, strict=True) if shape.queries == 1]
    assert len(decoding) == 2 * 3
    for rows in decoding:
        assert (rows[:, 3, :, -1] == 0).all()
        assert (rows[:, :3, :, -1] > 0).all()
    assert max(seen.errors) < 2e-6


def test_flash_attention_is_refused_by_name():
    policy = llama("sdpa")
    policy.config._attn_implementation_internal = "flash_attention_2"
    with pytest.raises(UnseenAttention, match=r"flash_attention_2.*attn_implementation='sdpa'"):  # noqa: SIM117
        with watch_attention(policy, Seen()):
            pass


def test_a_function_of_its_own_that_calls_none_of_them_is_not_seen():
    """What the interface runs is seen because of what it calls."""

    def values_only(module, query, key, value, attention_mask, **options):
        return value.repeat_interleave(2, 1).transpose(1, 2).contiguous(), None

    AttentionInterface.register("values_only", values_only)
    policy, seen = llama("sdpa"), Seen()
    policy.set_attn_implementation("values_only")
    with torch.no_grad(), watch_attention(policy, seen):
        policy(IDS[:1], use_cache=False)
    assert not seen.shapes
