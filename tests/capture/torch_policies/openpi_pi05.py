"""A stand-in for openpi's PyTorch pi0.5: the modules of a `PiModel`, with the expert's layers in openpi's own code.

Written after openpi's `transformers_replace/models/gemma/modeling_gemma.py`, which needs transformers 4.53: eager
attention over all keys at once, norms that return a gate, and `_gated_residual`. Prefix and flow are this project's.
"""

from __future__ import annotations

from types import SimpleNamespace

import torch
from torch import Tensor, nn

from vla_attention.capture.policies.pi.config import PiConfig
from vla_attention.capture.policies.pi.gemma import GemmaAttention, GemmaBlock, KeysValues, Rotation
from vla_attention.capture.policies.pi.model import PiModel


def gated_residual(x: Tensor, y: Tensor, gate: Tensor | None) -> Tensor:
    return x + y if gate is None else x + y * gate


class Attention(GemmaAttention):
    def forward(self, hidden: Tensor, mask: Tensor, rotation: Rotation, before: KeysValues) -> Tensor:
        shape = (*hidden.shape[:-1], -1, self.head_dim)
        query, key, value = (
            project(hidden).view(shape).transpose(1, 2) for project in (self.q_proj, self.k_proj, self.v_proj)
        )
        query, key = rotation.apply(query), torch.cat([before.keys, rotation.apply(key)], dim=2)
        value = torch.cat([before.values, value], dim=2)
        groups = query.shape[1] // key.shape[1]
        key, value = key.repeat_interleave(groups, dim=1), value.repeat_interleave(groups, dim=1)
        logits = torch.matmul(query, key.transpose(2, 3)) * self.scale
        logits = logits + torch.where(mask[:, None], 0.0, -2.3819763e38)
        rows = nn.functional.softmax(logits, dim=-1, dtype=torch.float32).to(query.dtype)
        mixed = torch.matmul(rows, value).transpose(1, 2).contiguous()
        return self.o_proj(mixed.reshape(*hidden.shape[:-1], -1).contiguous())


class Layer(GemmaBlock):
    def forward(self, x, mask, rotation, *, before=None, condition=None, calls=None):
        residual = x
        hidden, gate = self.input_layernorm(x, condition)
        hidden = self.self_attn(hidden, mask, rotation, before)
        hidden = gated_residual(residual, hidden, gate)
        residual = hidden
        hidden, gate = self.post_attention_layernorm(hidden, condition)
        hidden = gated_residual(residual, self.mlp(hidden), gate)
        return hidden, None


class PI05Pytorch(PiModel):
    """`va.layouts.pi0_pytorch` takes it for openpi's class."""

    def __init__(self, config: PiConfig) -> None:
        super().__init__(config)
        networks = self.paligemma_with_expert
        vision = SimpleNamespace(image_size=config.siglip.image_size, patch_size=config.siglip.patch_size)
        networks.paligemma.config = SimpleNamespace(vision_config=vision)
        expert = config.action_expert
        networks.gemma_expert.config = SimpleNamespace(
            num_hidden_layers=expert.depth, num_attention_heads=expert.num_heads
        )
        for layer in networks.gemma_expert.model.layers:
            layer.__class__, layer.self_attn.__class__ = Layer, Attention
