"""Load pi0 and pi0.5 weights from safetensors: openpi's PyTorch format, whose files LeRobot's format has too."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from vla_attention.capture.policies.checkpoints import UnsupportedCheckpoint, read_json_object
from vla_attention.capture.policies.pi.config import PiConfig
from vla_attention.capture.policies.pi.formats import WEIGHTS, WEIGHTS_INDEX, detect_format
from vla_attention.capture.policies.pi.model import PiModel, build_model, expected_shapes
from vla_attention.capture.policies.pi.sizes import OTHER_SIZES, PALIGEMMA, TABLE, is_pi05, stated_config
from vla_attention.capture.policies.safetensors_file import (
    SafetensorsFile,
    open_indexed_safetensors,
    open_safetensors,
)
from vla_attention.capture.policies.weights import Shapes, check_shapes

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


@dataclass(frozen=True)
class TensorFile:
    """Open weights: shapes of its tensors by model name, and a way to read one of them."""

    names: dict[str, str]
    shapes: Shapes
    stored: SafetensorsFile

    def read(self, name: str) -> Tensor:
        """Read one tensor by its name in the model."""
        return self.stored.read(self.names[name])

    def build(self, config: PiConfig, *, dtype: torch.dtype, device: str | torch.device) -> PiModel:
        """Build the model strictly; `CheckpointMismatch` lists missing, extra and misshapen tensors."""
        check_shapes(self.shapes, expected_shapes(config), hint=f" {OTHER_SIZES}.")
        self.stored.check_floats(self.names.values())
        return build_model(config, self.names, self.read, dtype=dtype, device=device)


@contextmanager
def open_tensors(folder: Path) -> Iterator[TensorFile]:
    """Open a checkpoint's model.safetensors, or the several files of its index.

    Raises:
        UnreadableCheckpoint: a file is damaged; also later while reading.
        UnsupportedCheckpoint: the matrices of an adapter are not merged into the weights.
    """
    index = folder / WEIGHTS_INDEX
    several = index.is_file() and not (folder / WEIGHTS).is_file()
    with open_indexed_safetensors(index) if several else open_safetensors(folder / WEIGHTS) as stored:
        if any(".lora_" in name for name in stored.names()):
            raise UnsupportedCheckpoint(
                f"'{stored.path}' has the matrices of an adapter (LoRA) beside the weights; merge them with peft's "
                "merge_and_unload(), save the policy again, and give that folder."
            )
        names = model_names(stored.names())
        yield TensorFile(names, {name: stored.shape(raw) for name, raw in names.items()}, stored)


def load_openpi_torch(
    folder: str | Path,
    *,
    config: PiConfig | None = None,
    dtype: torch.dtype = torch.float32,
    device: str | torch.device = "cpu",
) -> PiModel:
    """Load a checkpoint in openpi's PyTorch format.

    Its config.json names the sizes; `config` overrides them. Some facts are in no checkpoint: the number of text slots,
    the number of denoise steps, and whether the prompt contains the state.

    Raises `CheckpointNotFound`, `UnsupportedCheckpoint`, `UnreadableCheckpoint` or `CheckpointMismatch`.
    """
    folder = Path(folder)
    detect_format(folder, "openpi_torch")
    with open_tensors(folder) as tensors:
        if config is None:
            config = stated_config(read_json_object(folder / "config.json"), pi05=is_pi05(tensors.shapes))
        return tensors.build(config, dtype=dtype, device=device)
