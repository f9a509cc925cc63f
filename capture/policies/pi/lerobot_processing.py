"""LeRobot's LIBERO preprocessing: images, state, cameras, and actions back to the environment.

Formulas: LeRobot's LiberoProcessorStep, the policies' own image preparation and the saved pipelines; checked against
arrays that LeRobot computed.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from vla_attention.capture.environments.episode_protocol import LEROBOT
from vla_attention.capture.policies.pi.lerobot_config import IMAGES, LerobotConfig, UnsupportedLerobotFeature
from vla_attention.capture.policies.pi.lerobot_pipeline import LerobotPipeline
from vla_attention.capture.policies.pi.processing import simulated_arm
from vla_attention.capture.policies.pi.tokenizer import PromptFormat
from vla_attention.capture.policies.robot import Robot
from vla_attention.schemas.errors import listing

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


def slots(config: LerobotConfig, rename: Mapping[str, str], robot: Robot | None = None) -> dict[str, str | None]:
    """Return slot of the model -> camera of the robot (None: of the simulators), in the order of the model's keys.

    Slots have the names of their features without "observation.images."; slots with a camera come first, the others
    (None) are black and masked.
    """
    source = {rename.get(feature, feature): camera for feature, camera in LIBERO_CAMERAS.items()}
    if robot is not None:
        source = {f"{IMAGES}{slot}": camera for slot, camera in robot.cameras.items()}
    present = [feature for feature in config.cameras if feature in source]
    absent = [feature for feature in config.cameras if feature not in source]
    if not present:
        raise UnsupportedLerobotFeature(
            f"The policy's cameras are {listing(config.cameras)}, and the environment offers {listing(source)}: no "
            "picture would reach the policy."
        )
    return {feature.removeprefix(IMAGES): source.get(feature) for feature in [*present, *absent]}


class LerobotProcessing:
    """Processing of a LeRobot policy outside its model, from its checkpoint."""

    def __init__(self, config: LerobotConfig, pipeline: LerobotPipeline, robot: Robot | None = None):
        cameras = slots(config, pipeline.rename, robot)
        self.robot = robot or simulated_arm({slot: camera for slot, camera in cameras.items() if camera is not None})
        for what, given, needed in (
            ("state", config.state_dim, self.robot.state_dim),
            ("action", config.action_dim, self.robot.action_dim),
        ):
            if given != needed:
                raise UnsupportedLerobotFeature(
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

    def model_picture(self, frame: NDArray[np.uint8], size: int) -> tuple[NDArray[np.uint8], Tensor]:
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
