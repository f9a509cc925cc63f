"""The small pi0.5: its sizes, its initial weights, and the forward pass for training.

The modules are those of `PiModel`; the recipe of the initial weights is of the kind used for diffusion transformers
(Peebles & Xie 2023): what conditions the norms begins at zero, so that every block begins as a plain one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch

from examples.cubes_policy.vocabulary import NUMBERS
from vla_attention.capture.policies.pi.config import GemmaConfig, PiConfig, SiglipConfig
from vla_attention.capture.policies.pi.model import PiModel, expected_shapes, model_from_state
from vla_attention.capture.policies.weights import random_tensor

CAMERAS = ("base_0_rgb", "left_wrist_0_rgb")


def small_config(vocab_size: int) -> PiConfig:
    """Return the sizes of the small policy: about 1.5 million parameters."""
    return PiConfig(
        paligemma=GemmaConfig(width=128, depth=4, mlp_dim=256, num_heads=4, head_dim=32),
        action_expert=GemmaConfig(width=96, depth=4, mlp_dim=192, num_heads=4, head_dim=32),
        siglip=SiglipConfig(width=96, depth=2, mlp_dim=192, num_heads=4, patch_size=8, image_size=64),
        vocab_size=vocab_size,
        action_horizon=10,
        action_dim=8,
        max_token_len=32,
        discrete_state_input=True,
        cameras=CAMERAS,
    )


def initial_model(config: PiConfig, number_ids: Sequence[int], seed: int) -> PiModel:
    """Build the untrained model in float32; `number_ids` are the tokens of `NUMBERS` in their order."""
    state = {
        name: torch.from_numpy(_initial(name, random_tensor(seed, name, shape), config))
        for name, shape in expected_shapes(config).items()
    }
    table = next(name for name in state if name.endswith("embed_tokens.weight"))
    rows = sinusoids(np.array(NUMBERS, dtype=np.float64), config.paligemma.width, longest=1024.0)
    state[table][list(number_ids)] = torch.from_numpy(rows * (2.0 / config.paligemma.width) ** 0.5).float()
    return model_from_state(config, state).requires_grad_(True)


def _initial(name: str, normal: np.ndarray, config: PiConfig) -> np.ndarray:
    """Turn standard normal numbers into one tensor of the model."""
    if name.endswith("embed_tokens.weight"):
        return normal * np.float32(config.paligemma.width**-0.5)  # scaled up by sqrt(width) when looked up
    if name.endswith("position_embedding.weight"):
        return _patch_positions(config.siglip)
    if ".dense." in name:
        # Scale and shift are zero and the gate is 1 at first, whatever the time.
        initial = np.zeros_like(normal)
        if name.endswith("bias"):
            initial[2 * len(initial) // 3 :] = 1.0
        return initial
    if "norm" in name:
        return np.full_like(normal, 1.0 if "vision_tower" in name and name.endswith("weight") else 0.0)
    if name.endswith("bias"):
        return np.zeros_like(normal)
    fan_in = int(np.prod(normal.shape[1:]))
    scale = fan_in**-0.5
    if name.endswith(("o_proj.weight", "out_proj.weight", "down_proj.weight", "fc2.weight")):
        scale *= 0.5  # what blocks add to the residual stream
    return normal * np.float32(scale)


def sinusoids(values: np.ndarray, width: int, longest: float, shortest: float = 4.0) -> np.ndarray:
    """Return [sin, cos] of the values (value,) with geometric periods, (value, width) float64."""
    periods = np.geomspace(shortest, longest, width // 2)
    angles = 2.0 * math.pi * values[:, None] / periods
    return np.concatenate([np.sin(angles), np.cos(angles)], axis=1)


def _patch_positions(config: SiglipConfig) -> np.ndarray:
    """Return the initial embedding of patches (patch, width): half of it for the row, half for the column."""
    grid, half = config.grid, config.width // 2
    along = sinusoids(np.arange(grid, dtype=np.float64), half, longest=4.0 * grid, shortest=2.0)
    rows = np.repeat(along, grid, axis=0)
    columns = np.tile(along, (grid, 1))
    return np.concatenate([rows, columns], axis=1).astype(np.float32)
