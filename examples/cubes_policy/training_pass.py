"""The forward pass of a pi0.5 with gradients: the modules of `PiModel`, with arithmetic that is cheap in bfloat16.

Inference computes logits and softmax in float32, because their rows are recorded; training has nothing to record.
Attention is the larger part of a step, and half of its time would be conversions between the two precisions.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from examples.cubes_policy.batches import Batch
from examples.cubes_policy.network import CAMERAS
from vla_attention.capture.policies.pi.flow_time import embed_times
from vla_attention.capture.policies.pi.gemma import RMS_NORM_EPS, GemmaBlock, KeysValues, Rotation, add_branch
from vla_attention.capture.policies.pi.model import PiModel
from vla_attention.capture.policies.pi.siglip import SiglipBlock, VisionTower
from vla_attention.capture.recording.attention import join_heads, split_heads

#: Added to the logits of keys that nothing may see. Their probability is 0 in both precisions.
_HIDDEN = -1e9


@dataclass(frozen=True)
class EncodedPrefix:
    """The prefix pass with gradients.

    cache: per block, keys and values (batch, 1, prefix key, dim). valid: (batch, prefix key) bool. last: (batch, prefix
    key, width), what enters the last block.
    """

    cache: tuple[KeysValues, ...]
    valid: Tensor
    last: Tensor


def encode(model: PiModel, batch: Batch) -> EncodedPrefix:
    """Run images and text through the vision-language model, as `PiModel.encode_prefix` does."""
    inner = model.paligemma_with_expert.paligemma.model
    encoded = _see(inner.vision_tower, torch.cat([batch.images[camera] for camera in CAMERAS]))
    projected = torch.unflatten(inner.multi_modal_projector(encoded).float(), 0, (len(CAMERAS), -1))
    x = torch.cat([*projected.unbind(0), inner.language_model.embed(batch.tokens)], dim=1)
    valid = F.pad(batch.token_mask, (x.shape[1] - batch.token_mask.shape[1], 0), value=True)
    rotation = Rotation.at(valid.cumsum(dim=1) - 1, model.config.paligemma.head_dim)
    bias = _bias(valid)
    cache = []
    *earlier, last = inner.language_model.blocks
    for block in earlier:
        normed = _plain_norm(x, block.input_layernorm)
        own = block.self_attn.keys_values(normed, rotation)
        query = _query(block, normed, rotation)
        mixed = _mix(_rows([_logits(query, own.keys, bias)]), own.values)
        x = x + block.self_attn.o_proj(_joined(mixed, query))
        x = x + block.mlp(_plain_norm(x, block.post_attention_layernorm))
        cache.append(own)
    cache.append(last.self_attn.keys_values(_plain_norm(x, last.input_layernorm), rotation))
    return EncodedPrefix(tuple(cache), valid, x)


def velocities(model: PiModel, prefix: EncodedPrefix, noisy: Tensor, times: Tensor) -> Tensor:
    """Return the model's velocity (batch, pair, horizon, action dim) of noisy actions at times (batch, pair).

    The pairs of a sample share its prefix: their queries are queries of the same keys, which are not copied.
    """
    batch, pairs, horizon, dim = noisy.shape
    config = model.config
    expert = model.paligemma_with_expert.gemma_expert.model
    waves = embed_times(times.flatten().numpy(), config.action_expert.width, config.time_convention)
    hidden = model.action_in_proj(noisy.reshape(batch * pairs, horizon, dim))
    condition = F.silu(model.time_mlp_out(F.silu(model.time_mlp_in(waves))))
    positions = prefix.valid.sum(dim=1, keepdim=True) + torch.arange(horizon)
    rotation = Rotation.at(positions.repeat_interleave(pairs, dim=0), config.action_expert.head_dim)
    bias = _bias(prefix.valid)
    for block, cached in zip(expert.blocks, prefix.cache, strict=True):
        normed, gate = block.input_layernorm(hidden, condition)
        normed = _compact(normed)
        own = block.self_attn.keys_values(normed, rotation)
        query = _query(block, normed, rotation)
        shared = query.reshape(batch, pairs * query.shape[1], horizon, -1)
        among = _logits(query, own.keys, None)
        rows = _rows([_logits(shared, cached.keys, bias), among.reshape(batch, -1, horizon)])
        seen, own_rows = torch.split(rows, [cached.keys.shape[2], horizon], dim=-1)
        mixed = _mix(seen, cached.values).view(batch * pairs, -1, query.shape[-1])
        mixed = mixed + _mix(own_rows.reshape(batch * pairs, -1, horizon), own.values)
        hidden = add_branch(hidden, block.self_attn.o_proj(_joined(mixed, query)), gate)
        normed, gate = block.post_attention_layernorm(hidden, condition)
        hidden = add_branch(hidden, block.mlp(_compact(normed)), gate)
    normed, _ = expert.norm(hidden, condition)
    velocity: Tensor = model.action_out_proj(normed).float()
    return velocity.reshape(batch, pairs, horizon, dim)


def _see(tower: VisionTower, images: Tensor) -> Tensor:
    """Run the image encoder on images (image, 3, height, width)."""
    vision = tower.vision_model
    x = vision.embeddings(images)
    for block in vision.encoder.layers:
        assert isinstance(block, SiglipBlock)
        attention = block.self_attn
        normed = _compact(block.layer_norm1(x))
        query, keys, values = (
            split_heads(layer(normed), attention.head_dim)
            for layer in (attention.q_proj, attention.k_proj, attention.v_proj)
        )
        query = query * attention.scale
        merged = [part.reshape(-1, 1, *part.shape[2:]) for part in (query, keys, values)]  # every head has its own keys
        mixed = _mix(_rows([_logits(merged[0], merged[1], None)]), merged[2])
        x = x + attention.out_proj(_joined(mixed, query))
        x = x + block.mlp(_compact(block.layer_norm2(x)))
    seen: Tensor = vision.post_layernorm(x)
    return seen


def _compact(x: Tensor) -> Tensor:
    """Return x in the precision of matrix products, so that it is not converted again for each of them."""
    return x.to(torch.get_autocast_dtype("cpu")) if torch.is_autocast_enabled("cpu") else x


class _RmsNorm(torch.autograd.Function):
    """x / sqrt(mean(x²) + eps) · (1 + weight) over the last axis of (batch, token, width), with a short gradient."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor) -> Tensor:
        norm = torch.linalg.vector_norm(x, dim=-1, keepdim=True)
        scale = torch.rsqrt(norm.square() / x.shape[-1] + RMS_NORM_EPS)
        ctx.save_for_backward(x, scale, weight)
        return _compact((x * scale).mul_(1.0 + weight))

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor]:
        x, scale, weight = ctx.saved_tensors
        gradient = gradient.to(x.dtype)
        normed = x * scale
        product = gradient * normed
        for_weight = product.sum(dim=(0, 1))
        along = torch.matmul(product, (1.0 + weight)[:, None]) / x.shape[-1]
        for_x = gradient.mul(1.0 + weight).addcmul_(normed, along, value=-1.0).mul_(scale)
        return for_x, for_weight


def _plain_norm(x: Tensor, norm: nn.Module) -> Tensor:
    """Return the norm of the vision-language model of float32 tokens, in the precision of matrix products."""
    normed: Tensor = _RmsNorm.apply(x, norm.weight)  # type: ignore[no-untyped-call]
    return normed


def _query(block: GemmaBlock, normed: Tensor, rotation: Rotation) -> Tensor:
    """Return the rotated and scaled queries (batch, head, token, dim)."""
    attention = block.self_attn
    query: Tensor = rotation.apply(split_heads(attention.q_proj(normed), attention.head_dim)) * attention.scale
    return query


def _bias(valid: Tensor) -> Tensor:
    """Return what is added to logits, (batch, 1, key), for valid keys (batch, key)."""
    return torch.zeros(valid.shape).masked_fill(~valid, _HIDDEN)[:, None]


def _logits(query: Tensor, keys: Tensor, bias: Tensor | None) -> Tensor:
    """Return logits (batch, head · query, key) of queries (batch, head, query, dim) and keys (batch, 1, key, dim)."""
    stacked = query.flatten(1, 2)
    with torch.autocast("cpu", enabled=False):
        if bias is None:
            return torch.bmm(stacked, keys[:, 0].to(stacked.dtype).transpose(1, 2))
        return torch.baddbmm(bias.to(stacked.dtype), stacked, keys[:, 0].to(stacked.dtype).transpose(1, 2))


def _rows(logits: list[Tensor]) -> Tensor:
    """Return softmax over the keys of all logits together, in their precision; the sums inside are float32."""
    with torch.autocast("cpu", enabled=False):
        return torch.softmax(logits[0] if len(logits) == 1 else torch.cat(logits, dim=-1), dim=-1)


def _mix(rows: Tensor, values: Tensor) -> Tensor:
    """Return rows (batch, head · query, key) times values (batch, 1, key, dim)."""
    with torch.autocast("cpu", enabled=False):
        return torch.bmm(rows, values[:, 0].to(rows.dtype))


def _joined(mixed: Tensor, query: Tensor) -> Tensor:
    """Return mixed values (batch, head · query, dim) as (batch, query, head · dim)."""
    return join_heads(mixed.reshape(query.shape))
