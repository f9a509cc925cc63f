"""What every simulation environment offers the rollout: a task, named objects, pictures and their segmentation.

The rollout knows nothing about MuJoCo. An environment waits and steps like the published evaluation protocol does, but
draws pictures only when asked: a policy looks at every fifth step or so, and drawing is most of what a step costs.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from vla_attention.schemas.groupings.vocabulary import SceneObject

ROBOT = "robot"
"""Name of the one scene object that is the arm, its gripper and its mount."""

BACKGROUND = "background"
"""Name of the one scene object that is everything unnamed: table, floor, walls, sky."""


@dataclass(frozen=True)
class EnvironmentSettings:
    """What a user may choose about an environment.

    image_size: height and width of every camera picture in pixels; published results use 256.
    libero_assets: the LIBERO asset folder; without it the places named in `libero_installation` are tried.
    """

    image_size: int = 256
    libero_assets: Path | None = None


@dataclass(frozen=True)
class Task:
    """One task of a suite.

    instruction: the sentence given to the policy.
    num_initial_states: how many stored starting states there are; an episode names one by its index.
    """

    suite: str
    task_id: int
    name: str
    instruction: str
    num_initial_states: int


@dataclass(frozen=True)
class Observation:
    """What the robot perceives at one moment; pictures and numbers are sampled at the same physics substep.

    images: camera name -> (height, width, 3) uint8, exactly as robosuite and LIBERO deliver it, which is OpenGL's
        order: row 0 is the BOTTOM edge of what the camera sees, column 0 its LEFT edge. The picture is therefore upside
        down but not mirrored by a second axis. Reversing the rows alone would show the scene as a person sees it;
        policies trained on LIBERO reverse rows and columns (a rotation by 180 degrees), so that what they see is
        upright with left and right exchanged.
    eef_pos: (3,) float64, position of the gripper site in metres, world frame.
    eef_quat: (4,) float64, orientation of the hand as a quaternion in the order x, y, z, w.
    gripper_qpos: (2,) float64, positions of the two finger joints.
    """

    images: Mapping[str, NDArray[np.uint8]]
    eef_pos: NDArray[np.float64]
    eef_quat: NDArray[np.float64]
    gripper_qpos: NDArray[np.float64]


@dataclass(frozen=True)
class StepResult:
    """What one step led to: whether the task is solved now, and the observation if one was asked for."""

    success: bool
    observation: Observation | None


class Environment(Protocol):
    """One task in one simulator.

    An episode is `reset`, then `wait_steps` steps with `wait_action` (things fall into place), then at most `max_steps`
    steps of the policy. There is no observation before the first step: the protocol's first picture is the one after
    the last waiting step, so ask for it there with `observe=True`.
    """

    task: Task
    cameras: tuple[str, ...]
    objects: tuple[SceneObject, ...]
    max_steps: int
    wait_action: NDArray[np.float64]
    wait_steps: int

    def reset(self, initial_state_index: int, seed: int) -> None:
        """Begin an episode from a stored initial state; what ran before has no influence on it."""

    @property
    def initial_state_digest(self) -> str:
        """SHA-256 (hex) of the float64 bytes (time, qpos, qvel) of the state the current episode began with."""

    def step(self, action: NDArray[np.floating], observe: bool) -> StepResult:
        """Advance by one control step with a (7,) action: six pose deltas and the gripper.

        Pictures are drawn only with `observe=True`; they are bit-identical to those that drawing at every step gives.
        """

    def segmentation(self, camera: str) -> NDArray[np.int32]:
        """Return (height, width) indices into `objects` for the LAST observed picture of `camera`, pixel for pixel."""

    def close(self) -> None:
        """Free the simulator and its drawing context. Closing twice is fine."""
