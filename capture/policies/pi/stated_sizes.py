"""The sizes of a pi model that no checkpoint states: in a case.json beside the checkpoint, or in its config.json."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from vla_attention.capture.policies.checkpoints import CheckpointNotFound, Size, Steps, read_json_object, read_typed
from vla_attention.capture.policies.pi.config import CAMERA_SLOTS, GemmaConfig, PiConfig, SiglipConfig
from vla_attention.capture.policies.pi.lerobot_config import MAX_CAMERAS
from vla_attention.schemas.safe_text import check_name, check_text

#: File beside a checkpoint that states its sizes; parity cases (`tests/kit/pi_parity.py`) have one.
CASE_FILE = "case.json"
#: File of a checkpoint in openpi's PyTorch format that may state the sizes, in the form of a case.json.
CONFIG_FILE = "config.json"


class _Sizes(msgspec.Struct, frozen=True):
    paligemma: GemmaConfig
    action_expert: GemmaConfig
    siglip: SiglipConfig
    vocab_size: Size
    action_dim: Size
    action_horizon: Steps
    max_token_len: Steps
    num_denoise_steps: Steps = msgspec.field(name="num_steps")
    discrete_state_input: bool = False


class _Layout(msgspec.Struct, frozen=True):
    image_keys: Annotated[tuple[str, ...], Meta(max_length=MAX_CAMERAS)] = CAMERA_SLOTS


class _Case(msgspec.Struct, frozen=True):
    model: Literal["pi0", "pi05"]
    config: _Sizes
    layout: _Layout = _Layout()
    name: str = ""


def read_config(path: Path) -> PiConfig:
    """Read the sizes of a model from a case.json, or from a file with its `model` and `config`."""
    if not path.is_file():
        raise CheckpointNotFound(f"There is no '{path}', which states the sizes of the model.")
    case = read_typed(path, _Case)
    for camera in case.layout.image_keys:
        check_name("camera", camera)
    sizes = msgspec.structs.asdict(case.config)
    return PiConfig(**sizes, pi05=case.model == "pi05", cameras=case.layout.image_keys)


def states_sizes(path: Path) -> bool:
    """Return whether there is a config.json that states all sizes, like a case.json (`examples/cubes_policy`)."""
    return path.is_file() and {"model", "config"} <= read_json_object(path).keys()


def stated_name(path: Path) -> str | None:
    """Return the name that a checkpoint's config.json gives its policy, if its sizes are stated there, too."""
    name = read_typed(path, _Case).name if states_sizes(path) else ""
    check_text("policy", name)
    return name or None
