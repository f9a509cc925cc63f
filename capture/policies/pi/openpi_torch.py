"""Load pi0 and pi0.5 weights from safetensors: openpi's PyTorch format, whose file LeRobot's format has too."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from vla_attention.capture.policies.checkpoints import UnreadableCheckpoint, read_json_object
from vla_attention.capture.policies.pi.config import PiConfig
from vla_attention.capture.policies.pi.formats import detect_format
from vla_attention.capture.policies.pi.model import PiModel
from vla_attention.capture.policies.pi.model_weights import build_model, expected_shapes
from vla_attention.capture.policies.pi.sizes import PALIGEMMA, TABLE, infer_config
from vla_attention.capture.policies.strict_loading import Shapes, check_shapes

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
    found = {name: raw for name, raw in plain.items() if name not in (JUNK, TIED_TABLE)}
    if TIED_TABLE in plain:
        found.setdefault(TABLE, plain[TIED_TABLE])
    return found


@dataclass(frozen=True)
class TensorFile:
    """An open model.safetensors: shapes of its tensors by model name, and a way to read one of them."""

    names: dict[str, str]
    shapes: Shapes
    stored: Any

    def read(self, name: str) -> Tensor:
        """Read one tensor by its name in the model."""
        tensor: Tensor = self.stored.get_tensor(self.names[name])
        return tensor

    def build(self, config: PiConfig, *, dtype: torch.dtype, device: str | torch.device) -> PiModel:
        """Build the model strictly; `CheckpointMismatch` lists missing, extra and misshapen tensors."""
        check_shapes(self.shapes, expected_shapes(config))
        return build_model(config, self.names, self.read, dtype=dtype, device=device)


@contextmanager
def open_tensors(folder: Path) -> Iterator[TensorFile]:
    """Open a checkpoint's model.safetensors; `UnreadableCheckpoint` for a damaged file, also later while reading."""
    path = folder / "model.safetensors"
    try:
        with safe_open(path, framework="pt") as stored:
            names = model_names(stored.keys())
            shapes = {name: tuple(stored.get_slice(raw).get_shape()) for name, raw in names.items()}
            yield TensorFile(names, shapes, stored)
    except (SafetensorError, OSError) as error:
        raise UnreadableCheckpoint(
            f"'{path}' cannot be read ({error}): the file is damaged or its copy incomplete."
        ) from error


def load_openpi_torch(
    folder: str | Path,
    *,
    config: PiConfig | None = None,
    dtype: torch.dtype = torch.float32,
    device: str | torch.device = "cpu",
) -> PiModel:
    """Load a checkpoint in openpi's PyTorch format.

    Sizes, and whether it is pi0 or pi0.5, come from the tensors; `config` overrides them. Some facts are in no
    checkpoint: the number of text slots, the number of denoise steps, and whether the prompt contains the state.

    Raises `CheckpointNotFound`, `UnsupportedCheckpoint`, `UnreadableCheckpoint` or `CheckpointMismatch`.
    """
    folder = Path(folder)
    detect_format(folder, "openpi_torch")
    with open_tensors(folder) as tensors:
        if config is None:
            config = infer_config(tensors.shapes, read_json_object(folder / "config.json"))
        return tensors.build(config, dtype=dtype, device=device)
