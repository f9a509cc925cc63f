"""What a policy has beyond `Policy` when its calls are made on the frames of a data set."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from vla_attention.capture.policies.policy import Policy, PolicyInput
from vla_attention.capture.policies.robot import Robot


class RobotPolicy(Policy, Protocol):
    """A policy of a family that reads data sets, built for the robot of one."""

    @property
    def robot(self) -> Robot:
        """The columns that the policy reads."""

    def prepare_robot(
        self, pictures: Mapping[str, NDArray[np.uint8]], state: NDArray[np.float64], instruction: str
    ) -> PolicyInput:
        """Turn a frame into the model's input; pictures: column -> (height, width, 3) uint8."""
