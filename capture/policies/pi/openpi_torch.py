"""Load pi0 and pi0.5 weights from safetensors: openpi's PyTorch format, whose files LeRobot's format has too."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

import torch

from vla_attention.capture.policies.checkpoints import UnsupportedCheckpoint
from vla_attention.capture.policies.pi.config import PiConfig
from vla_attention.capture.policies.pi.formats import WEIGHTS, WEIGHTS_INDEX
from vla_attention.capture.policies.pi.model import PiModel, build_model, expected_shapes
from vla_attention.capture.policies.pi.sizes import OTHER_SIZES, PALIGEMMA, TABLE
from vla_attention.capture.policies.safetensors_file import (
    SafetensorsFile,
    open_indexed_safetensors,
    open_safetensors,
)
from vla_attention.capture.policies.weights import check_shapes

#: The text table is tied to the language model's output layer. safetensors keeps one name of tied tensors, this one.
TIED_TABLE = PALIGEMMA + "lm_head.weight"
#: The expert's output layer, 250 million parameters that are neither trained nor used.
JUNK = "paligemma_with_expert.gemma_expert.lm_head.weight"
#: LeRobot's policy wraps the model. Files of earlier conversions lack the prefix.
LEROBOT_PREFIX = "model."


def model_names(stored: Iterable[str]) -> dict[str, str]:
    """Return model name -> stored name of a safetensors checkpoint.

    LeRobot's prefix is removed if every name has it. The text table is `embed_tokens` if the file has it, else the
    language model's output layer, which is tied to it. The expert's output layer is left out.
    """
    names = list(stored)
    prefix = LEROBOT_PREFIX if names and all(name.startswith(LEROBOT_PREFIX) for name in names) else ""
    plain = {name.removeprefix(prefix): name for name in names}
    raw_names = {name: raw for name, raw in plain.items() if name not in (JUNK, TIED_TABLE)}
    if TIED_TABLE in plain:
        raw_names.setdefault(TABLE, plain[TIED_TABLE])
    return raw_names


@contextmanager
def open_tensors(folder: Path) -> Iterator[SafetensorsFile]:
    """Open the tensors of a checkpoint's model.safetensors, or of the several files of its index, by model name.

    Raises:
        UnreadableCheckpoint: a file is damaged; also later while reading.
        UnsupportedCheckpoint: the matrices of an adapter are not merged into the weights.
    """
    index = folder / WEIGHTS_INDEX
    several = index.is_file() and not (folder / WEIGHTS).is_file()
    with open_indexed_safetensors(index) if several else open_safetensors(folder / WEIGHTS) as stored:
        if any(".lora_" in name for name in stored.held):
            raise UnsupportedCheckpoint(
                f"'{stored.path}' has the matrices of an adapter (LoRA) beside the weights; merge them with peft's "
                "merge_and_unload(), save the policy again, and give that folder."
            )
        yield SafetensorsFile(stored.path, {name: stored.held[raw] for name, raw in model_names(stored.held).items()})


def load_safetensors(folder: Path, config: PiConfig, dtype: torch.dtype, device: str | torch.device) -> PiModel:
    """Load a checkpoint in a PyTorch format strictly; `CheckpointMismatch` lists all tensors that differ."""
    with open_tensors(folder) as tensors:
        check_shapes(tensors.shapes(), expected_shapes(config), hint=f" {OTHER_SIZES}.")
        tensors.check_floats()
        return build_model(config, tensors.held, tensors.read, dtype=dtype, device=device)
