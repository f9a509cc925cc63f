"""Weights of the diffusion transformer: selecting them from a checkpoint, the sizes that they imply, strict loading."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from vla_attention.capture.policies.checkpoints import (
    MAX_BLOCKS,
    MAX_SIZE,
    CheckpointMismatch,
    UnreadableCheckpoint,
    check_size,
)
from vla_attention.capture.policies.cosmos.config import DitConfig
from vla_attention.capture.policies.cosmos.dit import Dit
from vla_attention.capture.policies.weights import Shapes, check_floats, check_shapes, fill, make_empty, shapes_of
from vla_attention.schemas.errors import listing

PREFIX = "net."
#: Prefix of training counters, which are no weights.
COUNTER_PREFIX = "accum_"
#: Suffix of Transformer Engine's extra state, which is no weight; some checkpoints are written without it.
EXTRA_STATE = "_extra_state"
#: Part of a name that activation checkpointing adds.
_WRAPPED = "_checkpoint_wrapped_module."
_ROTARY_PREFIX = "pos_embedder."


def dit_tensors(stored: Mapping[str, Any]) -> dict[str, Tensor]:
    """Return the weights of a stored state, by their names in the model.

    The prefix `net.` and the part that activation checkpointing adds are removed from the names. Counters, extra state
    and the averaged copy (`net_ema.`) are left out. Other entries stay, so that strict loading reports unknown ones.
    """
    weights: dict[str, Tensor] = {}
    for name, value in stored.items():
        if name.startswith("net_ema."):
            continue
        plain = name.removeprefix(PREFIX).replace(_WRAPPED, "")
        if plain.startswith(COUNTER_PREFIX) or plain.endswith(EXTRA_STATE):
            continue
        if not isinstance(value, Tensor):
            raise UnreadableCheckpoint(f"'{name}' of the checkpoint is no tensor, but {type(value).__name__}.")
        weights[plain] = value
    check_floats({name: str(tensor.dtype) for name, tensor in weights.items()}, "the checkpoint")
    return weights


def infer_dit_config(weights: Mapping[str, Tensor], base: DitConfig) -> DitConfig:
    """Return the sizes of the weights. Rotary factors and patch size, which no weight states, are those of `base`."""

    def size(name: str, axis: int, least: int = 1) -> int:
        if name not in weights:
            raise CheckpointMismatch(
                f"The checkpoint has no '{name}', so it is no Cosmos transformer; it has {listing(sorted(weights), 4)}."
            )
        shape = tuple(weights[name].shape)
        if len(shape) <= axis:
            raise CheckpointMismatch(f"The checkpoint's '{name}' has shape {shape}, from which a size cannot be read.")
        return check_size(f"Axis {axis} of the checkpoint's '{name}'", shape[axis], MAX_SIZE, least=least)

    patch = base.patch_size**2
    embedder = "x_embedder.proj.1.weight"
    width, features = size(embedder, 0), size(embedder, 1, least=3 * patch)
    blocks = {name.split(".")[1] for name in weights if name.startswith("blocks.")}
    head_dim = size("blocks.0.self_attn.q_norm.weight", 0)
    return replace(
        base,
        width=width,
        # Their numbers are compared with the model's when all names are.
        num_blocks=check_size("The number of blocks of the checkpoint", len(blocks), MAX_BLOCKS),
        num_heads=max(1, width // head_dim),
        mlp_dim=size("blocks.0.mlp.layer1.weight", 0),
        text_dim=size("blocks.0.cross_attn.k_proj.weight", 1),
        adaln_dim=size("blocks.0.adaln_modulation_mlp.1.weight", 0),
        in_channels=features // patch - 2,
        out_channels=size("final_layer.linear.weight", 0, least=patch) // patch,
        max_positions=size("pos_embedder.seq", 0),
    )


def expected_shapes(config: DitConfig) -> Shapes:
    """Return name -> shape of every tensor of `Dit(config)`, rotary buffers too, without allocating any."""
    return shapes_of(make_empty(lambda: Dit(config)).state_dict())


def build_dit(
    config: DitConfig,
    weights: Mapping[str, Tensor],
    *,
    dtype: torch.dtype = torch.float32,
    device: str | torch.device = "cpu",
) -> Dit:
    """Build the transformer from tensors by model name, strictly.

    The rotary buffers are rounded to `dtype`, as in the reference, but stay float32: frequencies are computed in
    float32.
    """
    check_shapes(shapes_of(weights), expected_shapes(config), "the Cosmos transformer")
    filled = {}
    for name, tensor in weights.items():
        cast = tensor.to(device=device, dtype=dtype)
        filled[name] = cast.float() if name.startswith(_ROTARY_PREFIX) else cast
    return fill(make_empty(lambda: Dit(config)), filled).eval()
