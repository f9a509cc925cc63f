"""Untrained Cosmos policies with seeded random weights, which run on any machine.

They solve no task. `untrained` has the published policy's depth, latent frames and sampler at a quarter of its picture
area, so that the same layer and frame
numbers exist; `untrained-tiny` is for tests. Weights are scaled such that attention has structure:
rows are neither uniform nor on one key, and depend on pictures, words, noise and time.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from vla_attention.capture.policies.cosmos.config import CosmosConfig, DitConfig, SamplerConfig, VaeConfig
from vla_attention.capture.policies.cosmos.dit_weights import build_dit, expected_shapes
from vla_attention.capture.policies.cosmos.model import CosmosModel
from vla_attention.capture.policies.cosmos.policy import ACTION_FRAME, CosmosPolicy
from vla_attention.capture.policies.cosmos.preprocess import Ranges
from vla_attention.capture.policies.cosmos.text import PieceTokenizer, SeededText
from vla_attention.capture.policies.cosmos.vae import build_encoder, expected_vae_shapes
from vla_attention.capture.policies.identity import PolicySource
from vla_attention.capture.policies.sentencepiece_model import EMBEDDED_TOKENIZER
from vla_attention.capture.policies.weights import random_tensor

EMBEDDED_CONFIG = CosmosConfig(
    dit=DitConfig(width=96, num_blocks=28, num_heads=4, mlp_dim=192, text_dim=48, adaln_dim=16),
    vae=VaeConfig(base_dim=4),
    image_size=112,
)

#: For tests, runs in milliseconds: 16 tokens per frame, three blocks.
DUMMY_CONFIG = CosmosConfig(
    dit=DitConfig(width=48, num_blocks=3, num_heads=2, mlp_dim=96, text_dim=24, adaln_dim=8),
    vae=VaeConfig(base_dim=4),
    sampler=SamplerConfig(num_steps=3),
    image_size=64,
    text_length=64,
)

#: Made-up ranges of LIBERO's actions and proprioception (not statistics of any data set).
BUILTIN_RANGES = Ranges(
    actions_min=[-0.6, -0.6, -0.6, -0.12, -0.15, -0.15, -1.0],
    actions_max=[0.6, 0.6, 0.6, 0.12, 0.15, 0.15, 1.0],
    proprio_min=[0.0, -0.04, -0.4, -0.35, 0.0, -1.0, -1.0, -1.0, -1.0],
    proprio_max=[0.04, 0.0, 0.2, 0.35, 1.3, 1.0, 1.0, 1.0, 1.0],
)

#: Standard deviation σ of the logits of the first and the last block. Attention then spreads over about exp(-σ²/2) of
#: the keys.
_FLATTEST, _SHARPEST = 1.5, 4.0


def random_dit_weights(config: DitConfig, seed: int) -> dict[str, Tensor]:
    """Return float32 weights of a `Dit(config)` by model name, drawn from `seed` alone."""
    weights = {}
    for name, shape in expected_shapes(config).items():
        if name.startswith("pos_embedder."):
            weights[name] = _rotary_buffer(name, shape[0], config)
        else:
            weights[name] = torch.from_numpy(_scaled(name, random_tensor(seed, name, shape), config))
    return weights


def _rotary_buffer(name: str, length: int, config: DitConfig) -> Tensor:
    """The exponents of the rotary positions, rounded to bfloat16 like those of published checkpoints."""
    if name.endswith("seq"):
        return torch.arange(length, dtype=torch.float32)
    dim = config.spatial_rotary_dim if "spatial" in name else config.temporal_rotary_dim
    return (torch.arange(0, dim, 2, dtype=torch.float32) / dim).bfloat16().float()


def _scaled(name: str, normal: np.ndarray, config: DitConfig) -> np.ndarray:
    if name.endswith("q_norm.weight"):
        share = int(name.split(".")[1]) / max(1, config.num_blocks - 1)
        sharpness = _FLATTEST * (_SHARPEST / _FLATTEST) ** share
        return np.full_like(normal, sharpness) * (1 + np.float32(0.1) * normal)
    if "norm" in name:
        return 1 + np.float32(0.1) * normal
    weight = normal * np.float32(normal.shape[-1] ** -0.5)
    if "adaln_modulation" in name or name == "t_embedder.1.linear_2.weight":
        # Shift, scale, gate: a large shift is the same for all tokens of a frame and would make their keys alike.
        if not name.endswith(".1.weight"):
            for third, factor in enumerate((0.2, 0.4, 0.8)):
                weight[third * config.width : (third + 1) * config.width] *= np.float32(factor)
        return weight
    if name == "x_embedder.proj.1.weight":
        return weight * np.float32(2.0)
    return weight


def random_vae_weights(config: VaeConfig, seed: int) -> dict[str, Tensor]:
    """Return float32 weights of a whole VAE by its published names, drawn from `seed` alone."""
    weights = {}
    for name, shape in expected_vae_shapes(config).items():
        normal = random_tensor(seed, name, shape)
        if name.endswith("gamma"):
            scaled = np.ones_like(normal)
        elif name.endswith("bias"):
            scaled = normal * np.float32(0.02)
        else:
            scaled = normal * np.float32(1.4 * int(np.prod(shape[1:])) ** -0.5)
        weights[name] = torch.from_numpy(scaled)
    return weights


def build_random_model(config: CosmosConfig, seed: int, device: str | torch.device = "cpu") -> CosmosModel:
    """Build a model with random weights."""
    dit = build_dit(config.dit, random_dit_weights(config.dit, seed), device=device)
    encoder = build_encoder(config.vae, random_vae_weights(config.vae, seed), device=device)
    return CosmosModel(config, dit, encoder)


def random_policy(
    name: str,
    config: CosmosConfig,
    seed: int = 0,
    device: str | torch.device = "cpu",
    *,
    open_loop_steps: int | None = None,
    query_frame: str = ACTION_FRAME,
) -> CosmosPolicy:
    """Build an untrained policy of any size; the seed draws its weights."""
    text = SeededText(PieceTokenizer(EMBEDDED_TOKENIZER), config.text_length, config.dit.text_dim, seed)
    return CosmosPolicy(
        build_random_model(config, seed, device),
        text,
        BUILTIN_RANGES,
        PolicySource(name=name, checkpoint=f"random weights, seed {seed}", checkpoint_format="seeded", untrained=True),
        open_loop_steps=config.chunk_size if open_loop_steps is None else open_loop_steps,
        query_frame=query_frame,
    )
