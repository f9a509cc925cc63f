"""Real classes of transformers with a norm behind the output projection (Gemma 2 and 3) or a gate before it."""

from __future__ import annotations

from typing import Any

import pytest

pytest.importorskip("transformers", minversion="5.6", reason="run by make test-policies, in .venv-transformers")

import torch
from transformers import (
    Gemma2Config,
    Gemma2Model,
    Gemma3TextConfig,
    Gemma3TextModel,
    Qwen3NextConfig,
    Qwen3NextModel,
)

from tests.policies.policy_checks import PolicyCase, check_contributions, record
from vla_attention.capture.torch_policies.policy_layout import CallRule, PolicyLayout, RecordedSite
from vla_attention.schemas.layout import SiteLayout, Span

HEADS, BLOCKS, TOKENS, ACTIONS = 4, 2, 7, 3
SIZES: dict[str, Any] = {
    "hidden_size": 32, "intermediate_size": 48, "num_hidden_layers": BLOCKS, "num_attention_heads": HEADS,
    "vocab_size": 50, "num_key_value_heads": 2, "head_dim": 8, "pad_token_id": 0,
}  # fmt: skip
QWEN: dict[str, Any] = {
    **SIZES, "layer_types": ["full_attention"] * BLOCKS, "num_experts": 2, "num_experts_per_tok": 1,
    "moe_intermediate_size": 16, "shared_expert_intermediate_size": 16, "linear_num_value_heads": 2,
    "linear_num_key_heads": 2, "linear_key_head_dim": 8, "linear_value_head_dim": 8,
}  # fmt: skip
#: Class, configuration, the norm that reads the residual stream behind the attention.
CLASSES = {
    "Gemma 2": (Gemma2Model, Gemma2Config(**SIZES), "pre_feedforward_layernorm"),
    "Gemma 3": (
        Gemma3TextModel,
        Gemma3TextConfig(**SIZES),
        "pre_feedforward_layernorm",
    ),
    "Qwen3-Next": (
        Qwen3NextModel,
        Qwen3NextConfig(**QWEN),
        "post_attention_layernorm",
    ),
}


def layout() -> PolicyLayout:
    first = TOKENS - ACTIONS
    spans = Span("prompt", "text", 0, first), Span("actions", "action", first, TOKENS)
    roles = {"prompt": "instruction", "actions": "action"}
    return PolicyLayout(
        name="model",
        family="model",
        sites=(RecordedSite(SiteLayout("joint", spans), (-ACTIONS, None), roles),),
        rules=(CallRule(r"layers\.(?P<block>\d+)\.self_attn", "joint"),),
        num_layers=BLOCKS,
        num_heads=HEADS,
    )


@pytest.mark.parametrize(
    ("name", "attention"),
    [
        *(("Gemma 2", attention) for attention in ("eager", "flex_attention")),
        *(("Gemma 3", attention) for attention in ("sdpa", "eager", "flex_attention")),
        *(("Qwen3-Next", attention) for attention in ("sdpa", "eager")),
    ],
)
def test_contributions_are_what_the_layers_add(name, attention, tmp_path):
    kind, config, norm = CLASSES[name]
    torch.manual_seed(0)
    config._attn_implementation = attention
    policy = kind(config).eval().requires_grad_(False)
    for layer in policy.layers:
        for part in layer.modules():
            if "Norm" in type(part).__name__:
                torch.nn.init.normal_(part.weight, std=0.5)
    case = PolicyCase(policy, layout(), lambda ids: policy(ids).last_hidden_state, torch.arange(1, TOKENS + 1)[None])

    def stream(block):
        layer = policy.layers[block]
        return (layer.input_layernorm, "given"), (getattr(layer, norm), "given")

    store = record(case, tmp_path, tokenizer=None)
    check_contributions(case, store, "joint", stream)
