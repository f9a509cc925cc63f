"""The forward pass of a pi0.5 with gradients, by the blocks of `PiModel`."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.nn.attention import SDPBackend, sdpa_kernel

from examples.cubes_policy.batches import Batch
from examples.cubes_policy.network import CAMERAS
from vla_attention.capture.policies.pi.flow_time import embed_times
from vla_attention.capture.policies.pi.gemma import AttentionCalls, KeysValues, Rotation
from vla_attention.capture.policies.pi.model import PiModel


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
    with sdpa_kernel(SDPBackend.MATH):  # on a processor, the fused attention has a slow gradient
        projected = model.project_pictures(torch.cat([batch.images[camera] for camera in CAMERAS]))
    x = model.embed_projected(torch.unflatten(projected, 0, (len(CAMERAS), -1)).unbind(0), batch.tokens)
    valid = F.pad(batch.token_mask, (x.shape[1] - batch.token_mask.shape[1], 0), value=True)
    rotation = Rotation.at(valid.cumsum(dim=1) - 1, model.config.paligemma.head_dim)
    cache = []
    *earlier, last = model.paligemma_with_expert.paligemma.model.language_model.blocks
    for block in earlier:
        x, keys_values = block(x, valid[:, None], rotation, calls=AttentionCalls())
        cache.append(keys_values)
    cache.append(last.keys_values(x, rotation))
    return EncodedPrefix(tuple(cache), valid, x)


def velocities(model: PiModel, prefix: EncodedPrefix, noisy: Tensor, times: Tensor) -> Tensor:
    """Return the model's velocity (batch, pair, horizon, action dim) of noisy actions at times (batch, pair).

    The pairs of a sample share its prefix.
    """
    _, pairs, horizon, _ = noisy.shape
    config, expert = model.config, model.paligemma_with_expert.gemma_expert.model
    waves = embed_times(times.flatten().numpy(), config.action_expert.width, config.time_convention)
    condition = F.silu(model.time_mlp_out(F.silu(model.time_mlp_in(waves))))
    valid = prefix.valid.repeat_interleave(pairs, dim=0)
    rotation = Rotation.at(valid.sum(dim=1, keepdim=True) + torch.arange(horizon), config.action_expert.head_dim)
    mask = F.pad(valid, (0, horizon), value=True)[:, None]
    hidden = model.action_in_proj(noisy.flatten(0, 1))
    for block, cached in zip(expert.blocks, prefix.cache, strict=True):
        before = KeysValues(*(part.repeat_interleave(pairs, dim=0) for part in (cached.keys, cached.values)))
        hidden, _ = block(hidden, mask, rotation, before=before, condition=condition, calls=AttentionCalls())
    normed, _ = expert.norm(hidden, condition)
    velocity: Tensor = model.action_out_proj(normed).float()
    return velocity.reshape(noisy.shape)
