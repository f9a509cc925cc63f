"""Processing between the environment and the model, which differs between the ecosystems of pi policies.

openpi and LeRobot resize with different filters, normalise with different formulas, write different prompts and execute
different numbers of actions. A `Processing` does this for one policy; `PiPolicy` is the same for both.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from vla_attention.capture.environments.episode_protocol import (
    CAMERAS,
    OPENPI,
    OPENPI_REPLAN_STEPS,
    EvaluationProtocol,
)
from vla_attention.capture.policies.pi.config import PiConfig
from vla_attention.capture.policies.pi.preprocess import (
    ENVIRONMENT_ACTION_DIM,
    RELATIVE_ACTIONS,
    NormalisationMode,
    Normaliser,
    NormStats,
    resize_with_pad,
    turn,
)
from vla_attention.capture.policies.pi.tokenizer import PromptFormat
from vla_attention.capture.policies.robot import NONE, Robot
from vla_attention.schemas.errors import BadArgument, listing, unknown_name

#: Slot -> environment camera (openpi's LIBERO inputs); other slots are black and masked.
CAMERA_OF_SLOT = {"base_0_rgb": "agentview", "left_wrist_0_rgb": "robot0_eye_in_hand"}

#: Numbers of the state in both ecosystems: position, axis-angle, two finger joints.
STATE_DIM = 8


def simulator_cameras(
    policy_cameras: Sequence[str], usual: Mapping[str, str], chosen: Mapping[str, str]
) -> dict[str, str]:
    """Return policy camera -> camera of the simulators, in the policy's order; the others are black and masked.

    usual: what a policy camera sees unless `chosen` says another one, or `none`.

    Raises:
        UnknownName: a chosen camera does not exist, on either side.
        BadArgument: no camera of the policy would see anything.
    """
    for given, camera in chosen.items():
        if given not in policy_cameras:
            raise unknown_name("camera of the policy", given, policy_cameras)
        if camera not in (*CAMERAS, NONE):
            raise unknown_name("camera of the simulators", camera, [*CAMERAS, NONE])
    seen = {name: chosen.get(name, usual.get(name, NONE)) for name in policy_cameras}
    cameras = {name: camera for name, camera in seen.items() if camera != NONE}
    if not cameras:
        raise BadArgument(
            f"None of the policy's cameras {listing(policy_cameras)} would see anything; the simulators have "
            f"{listing(CAMERAS)}: give --camera POLICY=CAMERA."
        )
    return cameras


def simulated_arm(cameras: dict[str, str], relative_actions: int = 0) -> Robot:
    """Return the arm of the simulators; cameras: slot of the model -> camera."""
    state = ("position", "axis_angle", "gripper")
    return Robot(cameras, state, STATE_DIM, (), ENVIRONMENT_ACTION_DIM, relative_actions, turned=True)


@dataclass(frozen=True)
class Processing:
    """Processing of observations and actions outside the model.

    ecosystem, normalisation, image_resize: what it is, for the store. robot: slots of the model without a camera are
    black and masked. resize: a picture (height, width, 3) uint8 and a size -> the stored picture (size, size, 3) uint8
    and the model's (1, 3, size, size) in -1..1; whole_grey_levels: the model's is the stored one, without rounding.
    cut_long_prompts: a prompt with more tokens than slots is cut (with a warning) instead of refused. protocol,
    default_replan_steps: of the ecosystem's own evaluation.
    """

    ecosystem: str
    robot: Robot
    state: Normaliser
    actions: Normaliser
    normalisation: str
    resize: Callable[[NDArray[np.uint8], int], tuple[NDArray[np.uint8], Tensor]]
    image_resize: str
    whole_grey_levels: bool
    prompt_format: PromptFormat
    cut_long_prompts: bool
    protocol: EvaluationProtocol
    default_replan_steps: int

    def pictures_of_frame(self, frame: NDArray[np.uint8], size: int) -> tuple[NDArray[np.uint8], Tensor]:
        """Return the stored picture and the model's of a raw frame; those of simulators are turned by 180°."""
        return self.resize(turn(frame) if self.robot.turned else frame, size)

    def environment_actions(
        self, model_actions: NDArray[np.floating], state: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the actions (horizon, action dim of the robot) of the model's (horizon, action dim).

        Undoes the normalisation, and adds the state where actions are differences to it (openpi's pi0_libero).
        """
        actions = self.actions.unnormalise(model_actions)[..., : self.robot.action_dim].astype(np.float64)
        relative = self.robot.relative_actions
        actions[..., :relative] += state[:relative]
        return actions

    def provenance(self) -> dict[str, Any]:
        """Return plain JSON values that identify the processing."""
        return {
            "processing": self.ecosystem,
            "normalisation": self.normalisation,
            "relative_actions": bool(self.robot.relative_actions),
            "image_resize": self.image_resize,
        }


def openpi_arm(config: PiConfig, chosen: Mapping[str, str]) -> Robot:
    """Return the arm of the simulators, with what `--camera` says; openpi's pi0 of LIBERO has relative actions."""
    cameras = simulator_cameras(config.cameras, CAMERA_OF_SLOT, chosen)
    return simulated_arm(cameras, 0 if config.pi05 else RELATIVE_ACTIONS)


def openpi_processing(
    config: PiConfig, stats: NormStats, robot: Robot | None = None, replan_steps: int = OPENPI_REPLAN_STEPS
) -> Processing:
    """Return openpi's client and server transforms, of the simulators' arm (None) or another robot.

    As openpi's LIBERO configurations, pi0.5 normalises by quantiles and pi0 by z-scores.
    """
    robot = robot or openpi_arm(config, {})
    stats.check(robot.state_dim, robot.action_dim, config.action_dim)
    mode: NormalisationMode = "quantile" if config.pi05 else "z-score"
    return Processing(
        "openpi",
        robot,
        stats.state.normaliser(mode),
        stats.actions.normaliser(mode),
        normalisation=mode,
        resize=openpi_pictures,
        image_resize="PIL bilinear with antialiasing",
        whole_grey_levels=True,
        prompt_format="task-state-action" if config.discrete_state_input else "instruction-newline",
        cut_long_prompts=True,
        protocol=OPENPI,
        default_replan_steps=replan_steps,
    )


def openpi_pictures(picture: NDArray[np.uint8], size: int) -> tuple[NDArray[np.uint8], Tensor]:
    """Resize with PIL's bilinear filter; uint8 all the way."""
    image = resize_with_pad(picture, size)
    return image, image_tensor(image)


def image_tensor(image: NDArray[np.uint8]) -> Tensor:
    """Return (1, 3, height, width) float32 in [-1, 1] of an image (height, width, 3): x/255·2 - 1, as in openpi."""
    scaled = image.astype(np.float32) / 255.0 * 2.0 - 1.0
    return torch.from_numpy(np.ascontiguousarray(scaled.transpose(2, 0, 1)))[None]
