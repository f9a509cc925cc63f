"""Load LeRobot's pi0 and pi0.5 checkpoints: config.json, model.safetensors, and the saved pipelines.

LeRobot computes times and their waves in float64 and steps time as 1 + step · dt; its policies do so here too.
In bfloat16 its image encoder stays in float32. Formulas of the processing: LeRobot's LiberoProcessorStep, the policies'
own image preparation and the saved pipelines; checked against arrays that LeRobot computed.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from vla_attention.capture.environments.episode_protocol import LEROBOT
from vla_attention.capture.policies.checkpoints import CheckpointMismatch, UnsupportedCheckpoint
from vla_attention.capture.policies.pi.config import PiConfig
from vla_attention.capture.policies.pi.formats import detect_format
from vla_attention.capture.policies.pi.lerobot_config import IMAGES, LerobotConfig, read_lerobot_config
from vla_attention.capture.policies.pi.lerobot_pipeline import LerobotPipeline, read_lerobot_pipeline
from vla_attention.capture.policies.pi.model import PiModel
from vla_attention.capture.policies.pi.openpi_torch import TensorFile, open_tensors
from vla_attention.capture.policies.pi.processing import simulated_arm, simulator_cameras
from vla_attention.capture.policies.pi.sizes import is_pi05, stated_config
from vla_attention.capture.policies.pi.tokenizer import PromptFormat
from vla_attention.capture.policies.robot import Robot
from vla_attention.capture.policies.weights import DTYPES

#: LeRobot's names for the pictures of its LIBERO environment -> the simulator's cameras.
LIBERO_CAMERAS = {IMAGES + "image": "agentview", IMAGES + "image2": "robot0_eye_in_hand"}


def lerobot_image(frame: NDArray[np.uint8], size: int, *, turned: bool = True) -> Tensor:
    """Return the model's image (1, 3, size, size) float32 in [-1, 1] of a raw camera frame (height, width, 3).

    Turned by 180° if it is a simulator's, resized bilinearly without antialiasing with the aspect ratio kept, centred
    on black.
    """
    frame = frame[::-1, ::-1] if turned else frame
    image = torch.from_numpy(np.ascontiguousarray(frame.transpose(2, 0, 1)))[None].float() / 255.0
    height, width = image.shape[2:]
    if (height, width) != (size, size):
        ratio = max(width / size, height / size)
        fitted = (int(height / ratio), int(width / ratio))
        image = F.interpolate(image, size=fitted, mode="bilinear", align_corners=False).clamp(0.0, 1.0)
        below, right = size - fitted[0], size - fitted[1]
        image = F.pad(image, (right // 2, right - right // 2, below // 2, below - below // 2))
    return image * 2.0 - 1.0


def slots(
    config: LerobotConfig,
    rename: Mapping[str, str],
    robot: Robot | None = None,
    chosen: Mapping[str, str] = MappingProxyType({}),
) -> dict[str, str | None]:
    """Return slot of the model -> camera of the robot (None: of the simulators), in the order of the model's keys.

    Slots have the names of their features without "observation.images."; slots with a camera come first, the others
    (None) are black and masked. chosen: `--camera` with names of slots or features, see `simulator_cameras`.
    """
    names = [feature.removeprefix(IMAGES) for feature in config.cameras]
    if robot is not None:
        source = robot.cameras
    else:
        usual = {
            rename.get(feature, feature).removeprefix(IMAGES): camera for feature, camera in LIBERO_CAMERAS.items()
        }
        source = simulator_cameras(names, usual, {name.removeprefix(IMAGES): seen for name, seen in chosen.items()})
    return {name: source.get(name) for name in sorted(names, key=lambda name: name not in source)}


class LerobotProcessing:
    """Processing of a LeRobot policy outside its model, from its checkpoint."""

    def __init__(
        self,
        config: LerobotConfig,
        pipeline: LerobotPipeline,
        robot: Robot | None = None,
        chosen: Mapping[str, str] = MappingProxyType({}),
    ):
        cameras = slots(config, pipeline.rename, robot, chosen)
        self.robot = robot or simulated_arm({slot: camera for slot, camera in cameras.items() if camera is not None})
        for what, given, needed in (
            ("state", config.state_dim, self.robot.state_dim),
            ("action", config.action_dim, self.robot.action_dim),
        ):
            if given != needed:
                raise UnsupportedCheckpoint(
                    f"The policy has {what}s of {given} numbers, and those of the environments have {needed}: it was "
                    "made for another robot."
                )
        self.pipeline = pipeline
        self.protocol = LEROBOT
        self.default_replan_steps = config.n_action_steps
        self.cut_long_prompts = pipeline.cut_long_prompts
        self.whole_grey_levels = False
        self.prompt_format: PromptFormat = (
            "task-state-action"
            if pipeline.state_in_prompt
            else "raw-instruction-newline"
            if pipeline.new_line
            else "raw-instruction"
        )

    def pictures_of_frame(self, frame: NDArray[np.uint8], size: int) -> tuple[NDArray[np.uint8], Tensor]:
        """Resize in float32; the stored picture is the same, rounded to whole grey levels."""
        image = lerobot_image(frame, size, turned=self.robot.turned)
        kept = ((image[0].permute(1, 2, 0) + 1.0) * 127.5).round().clamp(0, 255).to(torch.uint8)
        return kept.numpy(), image

    def normalise_state(self, state: NDArray[np.float64]) -> NDArray[np.floating]:
        """Normalise in float32, the dtype of LeRobot's states."""
        return self.pipeline.state.normalise(state)

    def environment_actions(
        self, model_actions: NDArray[np.floating], state: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Keep the robot's dimensions and undo the normalisation."""
        return self.pipeline.action.unnormalise(model_actions[..., : self.robot.action_dim]).astype(np.float64)

    def provenance(self) -> dict[str, Any]:
        """Return the ecosystem, the normalisation, and whether actions are relative."""
        return {
            "processing": "lerobot",
            "normalisation": f"state {self.pipeline.state.mode}, action {self.pipeline.action.mode}",
            "relative_actions": False,
            "image_resize": "torch bilinear without antialiasing",
        }


def load_lerobot(
    folder: str | Path,
    *,
    sizes: PiConfig | None = None,
    dtype: torch.dtype | None = None,
    device: str | torch.device = "cpu",
    robot: Robot | None = None,
    chosen_cameras: Mapping[str, str] = MappingProxyType({}),
) -> tuple[PiModel, LerobotProcessing]:
    """Load a LeRobot checkpoint: the model, and the processing of images, prompts, states and actions.

    sizes: widths and heads, which config.json does not state because it is for full-size models. Only the sizes of
    the transformers and of the image encoder are taken from it. robot: of a data set; None: the arm of the simulators,
    with what `chosen_cameras` says of its cameras.
    """
    folder = Path(folder)
    detect_format(folder, "lerobot")
    stated = read_lerobot_config(folder)
    pipeline = read_lerobot_pipeline(folder, stated)
    processing = LerobotProcessing(stated, pipeline, robot, chosen_cameras)
    with open_tensors(folder) as tensors:
        config = model_config(stated, tensors, pipeline.rename, sizes, robot, chosen_cameras)
        model = tensors.build(config, dtype=dtype or DTYPES[stated.dtype], device=device)
    return model, processing


def model_config(
    stated: LerobotConfig,
    tensors: TensorFile,
    rename: dict[str, str],
    sizes: PiConfig | None,
    robot: Robot | None = None,
    chosen_cameras: Mapping[str, str] = MappingProxyType({}),
) -> PiConfig:
    """Return the model's configuration, as config.json states it; sizes: those of transformers and image encoder."""
    if is_pi05(tensors.shapes) != stated.pi05:
        names = {True: "pi05", False: "pi0"}
        raise CheckpointMismatch(
            f"The checkpoint's config.json says type '{names[stated.pi05]}', but its tensors are those of "
            f"{names[not stated.pi05]}."
        )
    named = {
        "action_horizon": stated.chunk_size,
        "action_dim": stated.max_action_dim,
        "paligemma_variant": stated.paligemma_variant,
        "action_expert_variant": stated.action_expert_variant,
    }
    base = sizes or stated_config(named, pi05=stated.pi05, image_size=stated.image_resolution[0])
    if base.siglip.image_size != stated.image_resolution[0]:
        raise CheckpointMismatch(
            f"The checkpoint's config.json says image_resolution {stated.image_resolution}, but its sizes are for "
            f"images of {base.siglip.image_size} pixels."
        )
    return dataclasses.replace(
        base,
        pi05=stated.pi05,
        action_horizon=stated.chunk_size,
        action_dim=stated.max_action_dim,
        max_token_len=stated.max_token_len,
        num_denoise_steps=stated.num_inference_steps,
        discrete_state_input=stated.pi05,
        cameras=tuple(slots(stated, rename, robot, chosen_cameras)),
        time_convention="stepped",
        min_period=stated.min_period,
        max_period=stated.max_period,
        float32_vision=True,
    )
