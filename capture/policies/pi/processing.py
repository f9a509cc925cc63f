"""Processing between the environment and the model, which differs between the ecosystems of pi policies.

openpi and LeRobot resize with different filters, normalise with different formulas, write different prompts and execute
different numbers of actions. A `Processing` does this for one policy; `PiPolicy` is the same for both.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

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
    NormStats,
    environment_actions,
    model_image,
    resize_with_pad,
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


class Processing(Protocol):
    """Processing of observations and actions outside the model."""

    @property
    def prompt_format(self) -> PromptFormat:
        """Format of the prompt, made of instruction and state."""

    @property
    def cut_long_prompts(self) -> bool:
        """Whether a prompt with more tokens than slots is cut (with a warning) or refused."""

    @property
    def robot(self) -> Robot:
        """Cameras, state and actions of the robot: slots of the model without a camera are black and masked."""

    @property
    def protocol(self) -> EvaluationProtocol:
        """The ecosystem's own evaluation."""

    @property
    def default_replan_steps(self) -> int:
        """Actions that the ecosystem's own evaluation executes of each chunk."""

    @property
    def whole_grey_levels(self) -> bool:
        """Whether the model's image is the stored one, without rounding."""

    def pictures_of_frame(self, frame: NDArray[np.uint8], size: int) -> tuple[NDArray[np.uint8], Tensor]:
        """Return the model's image of a raw frame: (size, size, 3) uint8 for the store, (1, 3, size, size) in -1..1."""

    def normalise_state(self, state: NDArray[np.float64]) -> NDArray[np.floating]:
        """Return the state (state,) in the model's range, not padded."""

    def environment_actions(
        self, model_actions: NDArray[np.floating], state: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the actions (horizon, action dim of the robot) of the model's (horizon, action dim)."""

    def provenance(self) -> dict[str, Any]:
        """Return plain JSON values that identify the processing."""


class OpenpiProcessing:
    """openpi's client and server transforms: of LIBERO, or of the robot of a data set.

    `cameras`: policy camera -> camera of the simulators, see `simulator_cameras`; None: openpi's of LIBERO.
    `relative_actions`: the model was trained on differences to the state (openpi's pi0_libero), so the state is added.
    `robot`: its own number of them replaces `relative_actions`.
    """

    def __init__(
        self,
        config: PiConfig,
        norm_stats: NormStats,
        *,
        normalisation: NormalisationMode,
        relative_actions: bool = False,
        replan_steps: int = OPENPI_REPLAN_STEPS,
        robot: Robot | None = None,
        cameras: dict[str, str] | None = None,
    ):
        if robot is None:
            seen = cameras or simulator_cameras(config.cameras, CAMERA_OF_SLOT, {})
            robot = simulated_arm(seen, RELATIVE_ACTIONS if relative_actions else 0)
        self.robot = robot
        norm_stats.check(normalisation, self.robot.state_dim, config.action_dim, self.robot.action_dim)
        self.protocol = OPENPI
        self.norm_stats = norm_stats
        self.normalisation = normalisation
        self.default_replan_steps = replan_steps
        self.prompt_format: PromptFormat = "task-state-action" if config.discrete_state_input else "instruction-newline"
        self.cut_long_prompts = True
        self.whole_grey_levels = True

    def pictures_of_frame(self, frame: NDArray[np.uint8], size: int) -> tuple[NDArray[np.uint8], Tensor]:
        """Rotate pictures of simulators by 180°, resize with PIL's bilinear filter; uint8 all the way."""
        image = model_image(frame, size) if self.robot.turned else resize_with_pad(frame, size)
        return image, image_tensor(image)

    def normalise_state(self, state: NDArray[np.float64]) -> NDArray[np.floating]:
        """Normalise by the checkpoint's statistics."""
        return self.norm_stats.state.normalise(state, self.normalisation)

    def environment_actions(
        self, model_actions: NDArray[np.floating], state: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Undo the normalisation, add the state where actions are relative to it, keep the robot's dimensions."""
        return environment_actions(
            model_actions.astype(np.float64),
            self.norm_stats,
            self.normalisation,
            relative_to=state if self.robot.relative_actions else None,
            action_dim=self.robot.action_dim,
            num_relative=self.robot.relative_actions,
        )

    def provenance(self) -> dict[str, Any]:
        """Return the ecosystem, the normalisation, and whether actions are relative."""
        return {
            "processing": "openpi",
            "normalisation": self.normalisation,
            "relative_actions": bool(self.robot.relative_actions),
            "image_resize": "PIL bilinear with antialiasing",
        }


def image_tensor(image: NDArray[np.uint8]) -> Tensor:
    """Return (1, 3, height, width) float32 in [-1, 1] of an image (height, width, 3): x/255·2 - 1, as in openpi."""
    scaled = image.astype(np.float32) / 255.0 * 2.0 - 1.0
    return torch.from_numpy(np.ascontiguousarray(scaled.transpose(2, 0, 1)))[None]
