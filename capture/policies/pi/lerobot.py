"""Load LeRobot's pi0 and pi0.5 checkpoints: config.json, model.safetensors, and the saved pipelines.

LeRobot computes times and their waves in float64 and steps time as 1 + step · dt; its policies do so here too.
In bfloat16 its image encoder stays in float32.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import torch

from vla_attention.capture.policies.checkpoints import CheckpointMismatch
from vla_attention.capture.policies.pi.config import PiConfig
from vla_attention.capture.policies.pi.formats import detect_format
from vla_attention.capture.policies.pi.lerobot_config import LerobotConfig, read_lerobot_config
from vla_attention.capture.policies.pi.lerobot_pipeline import read_lerobot_pipeline
from vla_attention.capture.policies.pi.lerobot_processing import LerobotProcessing, slots
from vla_attention.capture.policies.pi.model import PiModel
from vla_attention.capture.policies.pi.openpi_torch import TensorFile, open_tensors
from vla_attention.capture.policies.pi.sizes import infer_config, is_pi05
from vla_attention.capture.policies.precision import DTYPES
from vla_attention.capture.policies.robot import Robot


def load_lerobot_weights(
    folder: str | Path,
    *,
    config: PiConfig | None = None,
    dtype: torch.dtype | None = None,
    device: str | torch.device = "cpu",
) -> PiModel:
    """Load the weights of a LeRobot checkpoint; `config` replaces the sizes of config.json and the tensors.

    Without `dtype` the model has the precision of config.json. Unsupported features are refused in either case.
    """
    folder = Path(folder)
    detect_format(folder, "lerobot")
    stated = read_lerobot_config(folder)
    with open_tensors(folder) as tensors:
        if config is None:
            config = model_config(stated, tensors, {}, None)
        return tensors.build(config, dtype=dtype or DTYPES[stated.dtype], device=device)


def load_lerobot(
    folder: str | Path,
    *,
    sizes: PiConfig | None = None,
    dtype: torch.dtype | None = None,
    device: str | torch.device = "cpu",
    robot: Robot | None = None,
) -> tuple[PiModel, LerobotProcessing]:
    """Load a LeRobot checkpoint: the model, and the processing of images, prompts, states and actions.

    sizes: widths and heads, which config.json does not state because it is for full-size models. Only the sizes of
    the transformers and of the image encoder are taken from it. robot: of a data set; None: the arm of the simulators.
    """
    folder = Path(folder)
    detect_format(folder, "lerobot")
    stated = read_lerobot_config(folder)
    pipeline = read_lerobot_pipeline(folder, stated)
    processing = LerobotProcessing(stated, pipeline, robot)
    with open_tensors(folder) as tensors:
        config = model_config(stated, tensors, pipeline.rename, sizes, robot)
        model = tensors.build(config, dtype=dtype or DTYPES[stated.dtype], device=device)
    return model, processing


def model_config(
    stated: LerobotConfig,
    tensors: TensorFile,
    rename: dict[str, str],
    sizes: PiConfig | None,
    robot: Robot | None = None,
) -> PiConfig:
    """Return the model's configuration: sizes from the tensors, everything else from config.json."""
    shapes = tensors.shapes
    if is_pi05(shapes) != stated.pi05:
        names = {True: "pi05", False: "pi0"}
        raise CheckpointMismatch(
            f"The checkpoint's config.json says type '{names[stated.pi05]}', but its tensors are those of "
            f"{names[not stated.pi05]}."
        )
    base = sizes or infer_config(shapes, stated.raw, action_horizon="chunk_size", action_dim="max_action_dim")
    if base.siglip.image_size != stated.image_size:
        raise CheckpointMismatch(
            f"The checkpoint's config.json says image_resolution {stated.image_size}, but its tensors take images of "
            f"{base.siglip.image_size} pixels."
        )
    return dataclasses.replace(
        base,
        pi05=stated.pi05,
        action_horizon=stated.chunk_size,
        action_dim=stated.max_action_dim,
        max_token_len=stated.tokenizer_max_length,
        num_denoise_steps=stated.num_inference_steps,
        discrete_state_input=stated.pi05,
        cameras=tuple(slots(stated, rename, robot)),
        time_convention="stepped",
        min_period=stated.min_period,
        max_period=stated.max_period,
        float32_vision=True,
    )
