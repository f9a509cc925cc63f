"""The state of a torch model from JAX leaves that are in memory, for comparisons with the loader."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from vla_attention.capture.policies.pi.config import PiConfig
from vla_attention.capture.policies.pi.jax_weights import merge_lora, plan_leaves
from vla_attention.capture.policies.pi.model import expected_shapes
from vla_attention.capture.policies.weights import check_shapes, shapes_of


def from_jax_flat(leaves: Mapping[str, np.ndarray], config: PiConfig) -> dict[str, Tensor]:
    """Return the state dict (float32) of a `PiModel(config)` from a JAX checkpoint's leaves; LoRA pairs are merged.

    Raises `CheckpointMismatch` that lists every leaf that is unknown, and every tensor that is missing or does not have
    the shape of the configuration.
    """
    plans, pairs = plan_leaves(leaves)
    state: dict[str, Tensor] = {}
    for path, plan in plans.items():
        leaf = np.asarray(leaves[path], dtype=np.float32)
        if path in pairs:
            factors = (leaves[factor] for factor in pairs[path])
            leaf = np.stack([merge_lora(path, w, *ab) for w, *ab in zip(leaf, *factors, strict=True)])
        state |= {name: torch.from_numpy(np.array(array, order="C")) for name, array in plan.whole(leaf).items()}
    check_shapes(shapes_of(state), expected_shapes(config))
    return state
