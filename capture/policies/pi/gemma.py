"""Gemma transformer of the pi models: norms (plain and adaptive), rotary positions, blocks with a joint key axis.

The vision-language model and the action expert are two instances of `GemmaModel` that read the same keys: a block
returns its own keys and values, and takes the earlier ones as an argument. Module names are those of openpi's PyTorch
checkpoints. Architecture: Gemma Team 2024; adaptive norm: Peebles & Xie 2023 (adaLN) with an RMS norm.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from vla_attention.capture.policies.pi.config import GemmaConfig
from vla_attention.capture.recording.attention import (
    LogitChange,
    PieceSink,
    RowSink,
    UpdateSink,
    attend,
    attend_unseen,
    join_heads,
    split_heads,
)
from vla_attention.capture.recording.contributions import Projection

RMS_NORM_EPS = 1e-6
ROPE_THETA = 10_000.0


@dataclass(frozen=True)
class KeysValues:
    """Keys and values of one block, each (batch, kv_head, key, dim); keys are already rotated."""

    keys: Tensor
    values: Tensor

    def then(self, later: KeysValues) -> KeysValues:
        """Return these keys followed by `later` ones."""
        return KeysValues(torch.cat([self.keys, later.keys], 2), torch.cat([self.values, later.values], 2))

    def spread(self, positions: Tensor, length: int) -> KeysValues:
        """Return `length` keys with these at `positions` (key,) and zeros elsewhere, for masked keys."""

        def place(x: Tensor) -> Tensor:
            return x.new_zeros(*x.shape[:2], length, x.shape[3]).index_copy(2, positions, x)

        return KeysValues(place(self.keys), place(self.values))


@dataclass(frozen=True)
class Rotation:
    """Cosines and sines of the rotary position embedding, each (batch, 1, token, dim / 2) float32."""

    cos: Tensor
    sin: Tensor

    @classmethod
    def at(cls, positions: Tensor, head_dim: int) -> Rotation:
        """Compute the rotation for integer positions (batch, token): angle = position · theta^(-2i/dim)."""
        exponent = torch.arange(head_dim // 2, dtype=torch.float32, device=positions.device) * (2.0 / head_dim)
        angle = positions[:, None, :, None].float() / (ROPE_THETA**exponent)
        return cls(torch.cos(angle), torch.sin(angle))

    def apply(self, x: Tensor) -> Tensor:
        """Rotate (batch, head, token, dim), first half paired with second half, in float32 (Su et al. 2021)."""
        first, second = x.float().chunk(2, dim=-1)
        rotated = torch.cat([first * self.cos - second * self.sin, second * self.cos + first * self.sin], dim=-1)
        return rotated.to(x.dtype)


def rms_normalise(x: Tensor) -> Tensor:
    """Return x / sqrt(mean(x²) + eps) over the last axis, in float32 (Zhang & Sennrich 2019)."""
    x = x.float()
    return x * torch.rsqrt(x.square().mean(dim=-1, keepdim=True) + RMS_NORM_EPS)


class RMSNorm(nn.Module):
    """RMS norm whose weight is an offset from 1. It has no gate: `forward` returns (normed, None)."""

    def __init__(self, width: int):
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(width))

    def forward(self, x: Tensor, condition: Tensor | None) -> tuple[Tensor, Tensor | None]:
        """Map (batch, token, width) to the same shape; the condition is not used."""
        return (rms_normalise(x) * (1.0 + self.weight.float())).to(x.dtype), None


class AdaptiveRMSNorm(nn.Module):
    """RMS norm with scale, shift and gate from the condition: rms(x)·(1 + scale) + shift, of pi0.5's expert."""

    def __init__(self, width: int, condition_width: int):
        super().__init__()
        self.dense = nn.Linear(condition_width, 3 * width)

    def forward(self, x: Tensor, condition: Tensor | None) -> tuple[Tensor, Tensor | None]:
        """Map x (batch, token, width), condition (batch, its width), to the normed x and the gate (batch, 1, width)."""
        if condition is None:
            raise ValueError("an adaptive norm needs the condition")
        scale, shift, gate = self.dense(condition.to(self.dense.weight.dtype))[:, None].chunk(3, dim=-1)
        return (rms_normalise(x) * (1.0 + scale) + shift).to(x.dtype), gate.to(x.dtype)


def gated(branch: Tensor, gate: Tensor | None) -> Tensor:
    """Return branch · gate; None is a gate of 1."""
    return branch if gate is None else branch * gate


def add_branch(x: Tensor, branch: Tensor, gate: Tensor | None) -> Tensor:
    """Return x + branch · gate; None is a gate of 1."""
    return x + gated(branch, gate)


@dataclass(frozen=True)
class AttentionCalls:
    """What is called during the attention of a block whose rows may be recorded, and the pieces of its value product.

    A block that gets None instead uses torch's fused attention: nothing of it is ever recorded or changed.
    """

    change: LogitChange | None = None
    rows_to: RowSink | None = None
    pieces: Sequence[slice] | None = None
    pieces_to: PieceSink | None = None
    update_to: UpdateSink | None = None


class GemmaAttention(nn.Module):
    """Multi-query attention without biases."""

    def __init__(self, config: GemmaConfig):
        super().__init__()
        self.head_dim = config.head_dim
        self.scale = config.head_dim**-0.5
        self.q_proj = nn.Linear(config.width, config.num_heads * config.head_dim, bias=False)
        self.k_proj = nn.Linear(config.width, config.num_kv_heads * config.head_dim, bias=False)
        self.v_proj = nn.Linear(config.width, config.num_kv_heads * config.head_dim, bias=False)
        self.o_proj = nn.Linear(config.num_heads * config.head_dim, config.width, bias=False)

    def keys_values(self, x: Tensor, rotation: Rotation) -> KeysValues:
        """Return this block's keys and values of the tokens (batch, token, width)."""
        keys, values = split_heads(self.k_proj(x), self.head_dim), split_heads(self.v_proj(x), self.head_dim)
        return KeysValues(rotation.apply(keys), values)

    def forward(
        self,
        x: Tensor,
        seen: KeysValues,
        mask: Tensor | None,
        rotation: Rotation,
        calls: AttentionCalls | None,
    ) -> Tensor:
        """Attend from the tokens (batch, token, width) to all `seen` keys, mask (batch, token or 1, key)."""
        query = rotation.apply(split_heads(self.q_proj(x), self.head_dim))
        if calls is None:
            mixed = attend_unseen(query, seen.keys, seen.values, mask, self.scale)
        else:
            mixed = attend(
                query,
                seen.keys,
                seen.values,
                mask,
                self.scale,
                change=calls.change,
                rows_to=calls.rows_to,
                pieces=calls.pieces,
                pieces_to=calls.pieces_to,
            )
        update: Tensor = self.o_proj(join_heads(mixed))
        return update


class GemmaMlp(nn.Module):
    """GeGLU: down(gelu_tanh(gate(x)) · up(x)) (Shazeer 2020)."""

    def __init__(self, config: GemmaConfig):
        super().__init__()
        self.gate_proj = nn.Linear(config.width, config.mlp_dim, bias=False)
        self.up_proj = nn.Linear(config.width, config.mlp_dim, bias=False)
        self.down_proj = nn.Linear(config.mlp_dim, config.width, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        """Map (batch, token, width) to the same shape."""
        update: Tensor = self.down_proj(F.gelu(self.gate_proj(x), approximate="tanh") * self.up_proj(x))
        return update


def make_norm(width: int, condition_width: int | None) -> nn.Module:
    """Return the plain norm, or the adaptive one if there is a condition."""
    return RMSNorm(width) if condition_width is None else AdaptiveRMSNorm(width, condition_width)


class GemmaBlock(nn.Module):
    """A pre-norm block; `condition_width` makes its norms adaptive."""

    def __init__(self, config: GemmaConfig, condition_width: int | None):
        super().__init__()
        self.self_attn = GemmaAttention(config)
        self.mlp = GemmaMlp(config)
        self.input_layernorm = make_norm(config.width, condition_width)
        self.post_attention_layernorm = make_norm(config.width, condition_width)

    def keys_values(self, x: Tensor, rotation: Rotation) -> KeysValues:
        """Return the keys and values of the tokens (batch, token, width) alone, for a block with plain norms."""
        normed, _ = self.input_layernorm(x, None)
        return self.self_attn.keys_values(normed, rotation)

    def forward(
        self,
        x: Tensor,
        mask: Tensor | None,
        rotation: Rotation,
        *,
        before: KeysValues | None = None,
        condition: Tensor | None = None,
        calls: AttentionCalls | None = None,
    ) -> tuple[Tensor, KeysValues]:
        """Run the tokens x (batch, token, width) through the block.

        The keys are `before` (a cached prefix) followed by those of x; mask is (batch, token or 1, all keys) or None.
        Returns x after the block and the keys and values of x alone.
        """
        normed, gate = self.input_layernorm(x, condition)
        keys_values = self.self_attn.keys_values(normed, rotation)
        seen = keys_values if before is None else before.then(keys_values)
        update = gated(self.self_attn(normed, seen, mask, rotation, calls), gate)
        if calls is not None and calls.update_to is not None:
            factor = None if gate is None else gate[0]
            calls.update_to(seen.values, Projection(self.self_attn.o_proj.weight, factor), update)
        x = x + update
        normed, gate = self.post_attention_layernorm(x, condition)
        return add_branch(x, self.mlp(normed), gate), keys_values


class GemmaModel(nn.Module):
    """Blocks and a last norm, with a token table when `vocab_size` is given."""

    def __init__(self, config: GemmaConfig, *, vocab_size: int | None = None, condition_width: int | None = None):
        super().__init__()
        self.config = config
        if vocab_size is not None:
            self.embed_tokens = nn.Embedding(vocab_size, config.width)
        self.layers = nn.ModuleList(GemmaBlock(config, condition_width) for _ in range(config.depth))
        self.norm = make_norm(config.width, condition_width)

    @property
    def blocks(self) -> list[GemmaBlock]:
        """The layers with their own type; for mypy a ModuleList holds plain modules."""
        return [cast(GemmaBlock, layer) for layer in self.layers]

    def embed(self, tokens: Tensor) -> Tensor:
        """Look up tokens (batch, token) and scale by sqrt(width), as Gemma does with text and only with text."""
        embedded: Tensor = self.embed_tokens(tokens) * self.config.width**0.5
        return embedded
