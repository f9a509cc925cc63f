"""LeRobot's config.json for pi0 and pi0.5: its fields for inference.

A switch that changes what a policy computes, and that is not computed here, is refused by its name.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from vla_attention.capture.policies.checkpoints import (
    Size,
    Steps,
    UnsupportedCheckpoint,
    read_json_object,
    read_typed,
)
from vla_attention.capture.policies.pi.flow_time import MAX_PERIOD, MIN_PERIOD
from vla_attention.capture.policies.pi.sizes import MAX_TOKEN_LEN
from vla_attention.capture.policies.robot import IMAGES
from vla_attention.schemas.errors import listing

#: The switches that are refused, with the value that turns each off.
REFUSED: dict[str, Any] = {
    "use_visual_memory": False,
    "use_proprioceptive_memory": False,
    "use_relative_actions": False,
    "use_peft": False,
    "rtc_config": None,
    "rtc_training_max_delay": 0,
    "n_obs_steps": 1,
}
#: Cameras, with those that are always black. LeRobot's policies have up to five.
MAX_CAMERAS = 64
STATE_FEATURE, ACTION_FEATURE = "observation.state", "action"

Period = Annotated[float, Meta(gt=0, le=sys.float_info.max)]


class LerobotFeature(msgspec.Struct, frozen=True):
    """What a policy reads or gives: pictures (VISUAL), a state or actions; the last size of a vector is its length."""

    type: str
    shape: Annotated[tuple[Size, ...], Meta(min_length=1)]


class LerobotConfig(msgspec.Struct, frozen=True):
    """Fields of config.json for inference, with LeRobot's defaults."""

    type: Literal["pi0", "pi05"]
    dtype: str = "float32"
    chunk_size: Steps = 50
    n_action_steps: Steps = 50
    max_state_dim: Size = 32
    max_action_dim: Size = 32
    num_inference_steps: Steps = 10
    min_period: Period = MIN_PERIOD
    max_period: Period = MAX_PERIOD
    image_resolution: tuple[Steps, Steps] = (224, 224)
    tokenizer_max_length: Steps | None = None
    empty_cameras: Annotated[int, Meta(ge=0, le=MAX_CAMERAS)] = 0
    input_features: dict[str, LerobotFeature] | None = None
    output_features: dict[str, LerobotFeature] | None = None
    normalization_mapping: dict[str, str] | None = None
    paligemma_variant: str = "gemma_2b"
    action_expert_variant: str = "gemma_300m"

    def __post_init__(self) -> None:
        inputs, outputs = self.input_features or {}, self.output_features or {}
        others = [name for name, it in inputs.items() if it.type != "VISUAL" and name != STATE_FEATURE]
        others += [name for name in outputs if name != ACTION_FEATURE]
        width, height = self.image_resolution
        for is_wrong, problem in (
            (self.dtype not in ("float32", "bfloat16"), f"dtype '{self.dtype}'; supported are float32 and bfloat16"),
            (
                self.n_action_steps > self.chunk_size,
                f"n_action_steps {self.n_action_steps} of a chunk_size of {self.chunk_size}: more than there are",
            ),
            (width != height, f"image_resolution {self.image_resolution}; supported are square images"),
            (
                not self.pi05 and self.max_state_dim != self.max_action_dim,
                f"max_state_dim {self.max_state_dim}, max_action_dim {self.max_action_dim}; supported are equal ones",
            ),
            (len(self.cameras) > MAX_CAMERAS, f"{len(self.cameras)} cameras; supported are at most {MAX_CAMERAS}"),
            (
                bool(others),
                f"features that this program cannot give or use: {listing(others)}; it knows images, {STATE_FEATURE} "
                f"and {ACTION_FEATURE}",
            ),
        ):
            if is_wrong:
                raise ValueError(problem)

    @property
    def pi05(self) -> bool:
        """Whether it is pi0.5's."""
        return self.type == "pi05"

    @property
    def max_token_len(self) -> int:
        """Slots of the text."""
        return self.tokenizer_max_length or MAX_TOKEN_LEN[self.pi05]

    @property
    def cameras(self) -> tuple[str, ...]:
        """The features of pictures in order, with the empty ones."""
        stated = [name for name, feature in (self.input_features or {}).items() if feature.type == "VISUAL"]
        return tuple(dict.fromkeys([*stated, *(f"{IMAGES}empty_camera_{i}" for i in range(self.empty_cameras))]))

    @property
    def state_dim(self) -> int:
        """Numbers of a state."""
        feature = (self.input_features or {}).get(STATE_FEATURE)
        return self.max_state_dim if feature is None else feature.shape[-1]

    @property
    def action_dim(self) -> int:
        """Numbers of an action."""
        feature = (self.output_features or {}).get(ACTION_FEATURE)
        return self.max_action_dim if feature is None else feature.shape[-1]


def read_lerobot_config(folder: Path) -> LerobotConfig:
    """Read a checkpoint's config.json; `UnsupportedCheckpoint` names a switch or value that is not supported."""
    path = folder / "config.json"
    content = read_json_object(path)
    on = [f"{name} {content[name]!r}" for name, off in REFUSED.items() if content.get(name, off) not in (off, None)]
    if on:
        raise UnsupportedCheckpoint(f"'{path}' uses what is not supported: {listing(on)}.")
    return read_typed(path, LerobotConfig)
