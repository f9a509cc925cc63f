"""LeRobot's config.json for pi0 and pi0.5: its fields for inference. Unsupported features are refused.

A feature that is switched on and unknown here is an error with its name: it could change the actions of the policy.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vla_attention.capture.policies.checkpoints import (
    MAX_SIZE,
    MAX_STEPS,
    UnsupportedCheckpoint,
    read_json_object,
    values_of,
)
from vla_attention.capture.policies.pi.flow_time import MAX_PERIOD, MIN_PERIOD
from vla_attention.capture.policies.pi.sizes import MAX_TOKEN_LEN
from vla_attention.schemas.errors import listing

#: Fields that are read below.
_READ = {
    "type", "paligemma_variant", "action_expert_variant", "dtype", "chunk_size", "n_action_steps", "max_state_dim",
    "max_action_dim", "num_inference_steps", "min_period", "max_period", "image_resolution", "empty_cameras",
    "tokenizer_max_length", "normalization_mapping", "input_features", "output_features",
}  # fmt: skip

#: Features of the inference that are not supported, with the value that switches them off.
_OFF: dict[str, Any] = {
    "use_visual_memory": False,
    "use_proprioceptive_memory": False,
    "use_relative_actions": False,
    "use_peft": False,
    "rtc_config": None,
    "rtc_training_max_delay": 0,
    "n_obs_steps": 1,
}

#: Fields of training, the hub, the device and speed, which do not change the actions of a policy. Some (exclusions of
#: relative actions, sizes of memories) belong to a feature that is refused if it is on.
_HARMLESS = {
    "device", "use_amp", "push_to_hub", "repo_id", "private", "tags", "license", "pretrained_path",
    "pretrained_revision", "compile_model", "compile_mode", "gradient_checkpointing", "freeze_vision_encoder",
    "train_expert_only", "relative_exclude_joints", "action_feature_names", "memory_frames", "memory_stride",
    "memory_temporal_attention_every",
}  # fmt: skip
_HARMLESS_BEGINNINGS = ("optimizer_", "scheduler_", "time_sampling_")

#: Cameras, with those that are always black. LeRobot's policies have up to five.
MAX_CAMERAS = 64
STATE_FEATURE, ACTION_FEATURE = "observation.state", "action"
IMAGES = "observation.images."


class UnsupportedLerobotFeature(UnsupportedCheckpoint):
    """The checkpoint uses a feature that is not supported here."""


@dataclass(frozen=True)
class LerobotConfig:
    """Fields of config.json for inference. cameras: visual features in order, including empty ones."""

    pi05: bool
    dtype: str
    chunk_size: int
    n_action_steps: int
    max_state_dim: int
    max_action_dim: int
    num_inference_steps: int
    min_period: float
    max_period: float
    image_size: int
    tokenizer_max_length: int
    cameras: tuple[str, ...]
    state_dim: int
    action_dim: int
    normalization: dict[str, str]
    #: the whole content, for `infer_config`
    raw: dict[str, Any]


def read_lerobot_config(folder: Path) -> LerobotConfig:
    """Read a checkpoint's config.json; `UnsupportedLerobotFeature` names an unsupported feature."""
    path = folder / "config.json"
    content = read_json_object(path)
    with values_of(path):
        return _config(content, f"'{path}'")


def _config(content: dict[str, Any], where: str) -> LerobotConfig:
    _refuse_unknown(content, where)
    pi05 = content.get("type") == "pi05"
    inputs, outputs = _features(content, "input_features", where), _features(content, "output_features", where)
    chunk_size = _whole(content, "chunk_size", 50, where, most=MAX_STEPS)
    steps = _whole(content, "n_action_steps", 50, where, most=MAX_STEPS)
    if steps > chunk_size:
        raise UnsupportedLerobotFeature(
            f"{where} executes n_action_steps {steps} of a chunk_size of {chunk_size}: more than there are."
        )
    dtype = content.get("dtype", "float32")
    if dtype not in ("float32", "bfloat16"):
        raise UnsupportedLerobotFeature(f"{where} has dtype '{dtype}'; supported are float32 and bfloat16.")
    cameras = [name for name, (kind, _) in inputs.items() if kind == "VISUAL"]
    for i in range(_whole(content, "empty_cameras", 0, where, least=0, most=MAX_CAMERAS)):
        if (name := f"{IMAGES}empty_camera_{i}") not in cameras:
            cameras.append(name)
    if len(cameras) > MAX_CAMERAS:
        raise UnsupportedLerobotFeature(f"{where} has {len(cameras)} cameras; supported are at most {MAX_CAMERAS}.")
    others = [name for name, (kind, _) in inputs.items() if kind != "VISUAL" and name != STATE_FEATURE]
    others += [name for name in outputs if name != ACTION_FEATURE]
    if others:
        raise UnsupportedLerobotFeature(
            f"{where} has features that this program cannot give or use: {listing(others)}; it knows images, "
            f"{STATE_FEATURE} and {ACTION_FEATURE}."
        )
    max_state_dim, max_action_dim = (_whole(content, name, 32, where) for name in ("max_state_dim", "max_action_dim"))
    if not pi05 and max_state_dim != max_action_dim:
        raise UnsupportedLerobotFeature(
            f"{where} has max_state_dim {max_state_dim} and max_action_dim {max_action_dim}; supported are equal ones."
        )
    return LerobotConfig(
        pi05=pi05,
        dtype=dtype,
        chunk_size=chunk_size,
        n_action_steps=steps,
        max_state_dim=max_state_dim,
        max_action_dim=max_action_dim,
        num_inference_steps=_whole(content, "num_inference_steps", 10, where, most=MAX_STEPS),
        min_period=_period(content, "min_period", MIN_PERIOD, where),
        max_period=_period(content, "max_period", MAX_PERIOD, where),
        image_size=_image_size(content, where),
        tokenizer_max_length=_whole(content, "tokenizer_max_length", MAX_TOKEN_LEN[pi05], where, most=MAX_STEPS),
        cameras=tuple(cameras),
        state_dim=inputs.get(STATE_FEATURE, ("STATE", max_state_dim))[1],
        action_dim=outputs.get(ACTION_FEATURE, ("ACTION", max_action_dim))[1],
        normalization=texts_by_name(content.get("normalization_mapping"), f"{where} has normalization_mapping"),
        raw={
            "chunk_size": chunk_size,
            "max_action_dim": max_action_dim,
            "paligemma_variant": str(content.get("paligemma_variant", "gemma_2b")),
            "action_expert_variant": str(content.get("action_expert_variant", "gemma_300m")),
        },
    )


def _refuse_unknown(content: Mapping[str, Any], where: str) -> None:
    if content.get("type") not in ("pi0", "pi05"):
        raise UnsupportedLerobotFeature(f"{where} is of type {content.get('type')!r}; supported are pi0 and pi05.")
    on = [f"{name} {content[name]!r}" for name, off in _OFF.items() if content.get(name, off) not in (off, None)]
    if on:
        raise UnsupportedLerobotFeature(f"{where} uses a feature that is not supported: {listing(on)}.")
    known = _READ | _HARMLESS | _OFF.keys()
    unknown = [
        f"{name} {value!r}"
        for name, value in content.items()
        if name not in known and not name.startswith(_HARMLESS_BEGINNINGS) and value not in (None, False, 0, "", [], {})
    ]
    if unknown:
        raise UnsupportedLerobotFeature(
            f"{where} has settings that this program does not know, and that may change what the policy does: "
            f"{listing(unknown)}."
        )


def _whole(
    content: Mapping[str, Any], name: str, default: int, where: str, least: int = 1, most: int = MAX_SIZE
) -> int:
    value = content.get(name, default)
    if not isinstance(value, int) or isinstance(value, bool) or not least <= value <= most:
        raise UnsupportedLerobotFeature(
            f"{where} has {name} {value!r}; expected a whole number of at least {least} and at most {most}."
        )
    return value


def _period(content: Mapping[str, Any], name: str, default: float, where: str) -> float:
    value = content.get(name, default)
    if not isinstance(value, (int, float)) or isinstance(value, bool) or not 0 < value < math.inf:
        raise UnsupportedLerobotFeature(f"{where} has {name} {value!r}; expected a number above 0.")
    return float(value)


def texts_by_name(value: object, what: str) -> dict[str, str]:
    """Return a table of texts, empty if there is none; `UnsupportedLerobotFeature` begins with `what`."""
    if value is None:
        return {}
    if not isinstance(value, dict) or not all(isinstance(text, str) for text in value.values()):
        raise UnsupportedLerobotFeature(f"{what} {value!r}; expected a table of texts.")
    return value


def _features(content: Mapping[str, Any], name: str, where: str) -> dict[str, tuple[str, int]]:
    """Return feature -> (type, last size) of input_features or output_features, in their order."""
    features = content.get(name) or {}
    try:
        sizes = {key: (str(feature["type"]), int(feature["shape"][-1])) for key, feature in features.items()}
    except (TypeError, KeyError, IndexError, ValueError, AttributeError, OverflowError):
        raise UnsupportedLerobotFeature(f"{where} has {name} without types and shapes: {features!r}.") from None
    for key, (_, size) in sizes.items():
        if not 1 <= size <= MAX_SIZE:
            raise UnsupportedLerobotFeature(
                f"{where} has {name} with '{key}' of {size} numbers; expected 1 to {MAX_SIZE}."
            )
    return sizes


def _image_size(content: Mapping[str, Any], where: str) -> int:
    resolution = content.get("image_resolution", [224, 224])
    if not isinstance(resolution, list) or len(resolution) != 2 or resolution[0] != resolution[1]:
        raise UnsupportedLerobotFeature(f"{where} has image_resolution {resolution!r}; supported are square images.")
    return _whole({"image_resolution": resolution[0]}, "image_resolution", 224, where, most=MAX_STEPS)
