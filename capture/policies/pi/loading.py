"""Load a pi model from a checkpoint folder in whichever format it is."""

from __future__ import annotations

from pathlib import Path

import torch

from capture.policies.pi.checkpoint import CheckpointFormat, UnsupportedCheckpoint, detect_format, load_openpi_torch
from capture.policies.pi.config import PiConfig
from capture.policies.pi.model import PiModel
from capture.policies.pi.orbax import load_openpi_jax


def load_pi_model(
    folder: str | Path,
    *,
    config: PiConfig | None = None,
    dtype: torch.dtype = torch.float32,
    device: str | torch.device = "cpu",
) -> tuple[PiModel, CheckpointFormat]:
    """Return the model and the format it was found in; `config` overrides what the checkpoint says or implies."""
    found = detect_format(folder)
    if found == "openpi_torch":
        return load_openpi_torch(folder, config=config, dtype=dtype, device=device), found
    if found == "openpi_jax":
        return load_openpi_jax(folder, config=config, dtype=dtype, device=device), found
    raise UnsupportedCheckpoint(
        f"'{folder}' is a checkpoint in LeRobot's format, which cannot be loaded yet; supported are openpi's PyTorch "
        "format (config.json and model.safetensors) and openpi's JAX format (params/_METADATA)."
    )
