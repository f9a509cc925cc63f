"""The sizes of a pi model that no checkpoint states: in a case.json beside the checkpoint, or in its config.json."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from vla_attention.capture.policies.checkpoints import (
    MAX_BLOCKS,
    MAX_SIZE,
    MAX_STEPS,
    check_size,
    read_json_object,
)
from vla_attention.capture.policies.pi.config import CAMERA_SLOTS, GemmaConfig, PiConfig, SiglipConfig
from vla_attention.capture.policies.pi.lerobot_config import MAX_CAMERAS
from vla_attention.schemas.errors import BadArgument, UserError
from vla_attention.schemas.safe_text import check_name, check_text

#: File beside a checkpoint that states its sizes; parity cases (`tests/kit/pi_parity.py`) have one.
CASE_FILE = "case.json"
#: File of a checkpoint in openpi's PyTorch format that may state the sizes, in the form of a case.json.
CONFIG_FILE = "config.json"


class SizesNotStated(UserError, ValueError):
    """A file does not state the sizes of a model."""


def read_config(path: Path) -> PiConfig:
    """Read the sizes of a model from a case.json, or from a file with its `model` and `config`."""
    if not path.is_file():
        raise SizesNotStated(f"There is no '{path}', which states the sizes of the model.")
    content = read_json_object(path)
    try:
        return _config(content, path)
    except (KeyError, TypeError, AttributeError) as error:
        raise SizesNotStated(
            f"'{path}' does not state the sizes of a pi model: {error!s} is missing or wrong; expected 'model' (pi0 or "
            "pi05) and 'config' with paligemma, action_expert, siglip, vocab_size, action_dim, action_horizon, "
            "max_token_len, num_steps."
        ) from error


def states_sizes(path: Path) -> bool:
    """Return whether there is a config.json that states all sizes, like a case.json (`examples/cubes_policy`)."""
    if not path.is_file():
        return False
    content = read_json_object(path)
    return "model" in content and isinstance(content.get("config"), Mapping)


def stated_name(path: Path) -> str | None:
    """Return the name that a checkpoint's config.json gives its policy, if its sizes are stated there, too."""
    if not states_sizes(path):
        return None
    name = read_json_object(path).get("name")
    if not isinstance(name, str) or not name:
        return None
    check_text("policy", name)
    return name


def _config(content: Mapping[str, Any], path: Path) -> PiConfig:
    sizes: Mapping[str, Any] = content["config"]
    model = content["model"]
    if model not in ("pi0", "pi05"):
        raise BadArgument(f"'{path}' is of model '{model}'; expected 'pi0' or 'pi05'.")

    def size(name: str, value: object) -> int:
        # Those of blocks and steps are in no tensor's shape.
        most = {"depth": MAX_BLOCKS, "action_horizon": MAX_STEPS, "max_token_len": MAX_STEPS, "num_steps": MAX_STEPS}
        return check_size(f"'{name}' of '{path}'", value, most.get(name, MAX_SIZE))

    def part(name: str, ignored: str) -> dict[str, int]:
        return {key: size(key, value) for key, value in sizes[name].items() if key != ignored}

    layout: Mapping[str, Any] = content.get("layout", {})
    cameras = layout.get("image_keys", CAMERA_SLOTS)
    if not isinstance(cameras, (list, tuple)) or len(cameras) > MAX_CAMERAS:
        raise TypeError("image_keys")
    for camera in cameras:
        check_name("camera", str(camera))
    return PiConfig(
        paligemma=GemmaConfig(**part("paligemma", "lora_configs")),
        action_expert=GemmaConfig(**part("action_expert", "lora_configs")),
        siglip=SiglipConfig(**part("siglip", "num_classes")),
        vocab_size=size("vocab_size", sizes["vocab_size"]),
        action_dim=size("action_dim", sizes["action_dim"]),
        action_horizon=size("action_horizon", sizes["action_horizon"]),
        max_token_len=size("max_token_len", sizes["max_token_len"]),
        num_denoise_steps=size("num_steps", sizes["num_steps"]),
        pi05=model == "pi05",
        discrete_state_input=bool(sizes.get("discrete_state_input", False)),
        cameras=tuple(map(str, cameras)),
    )
