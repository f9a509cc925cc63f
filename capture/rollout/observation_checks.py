"""What a simulator shows before a policy call: pictures that went black, and a state that is no number."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from vla_attention.capture.environments.base import Observation, camera_frame
from vla_attention.capture.rollout.simulation import SimulationFailed
from vla_attention.schemas.errors import listing

_STATE = ("eef_pos", "eef_quat", "gripper_qpos")


class CameraBlack(SimulationFailed):
    """A camera gave a black picture where the task's first one was not black: drawing has failed without an error."""


@dataclass
class ObservationChecks:
    """Checks the observations of one process; it keeps which cameras showed something in each task's first one."""

    _lit: dict[int, frozenset[str]] = field(default_factory=dict, init=False)

    def check(self, task_id: int, observation: Observation, cameras: Iterable[str], where: str) -> None:
        """Raise unless a policy may be called with an observation.

        Args:
            task_id: its task.
            observation: what the simulator gave.
            cameras: names of the environment's cameras that the policy sees.
            where: replan and episode, for the sentence.

        Raises:
            CameraBlack: a camera that showed something at first shows nothing.
            SimulationFailed: a number of the robot's state is NaN or infinite.
        """
        wrong = [name for name in _STATE if not np.isfinite(getattr(observation, name)).all()]
        if wrong:
            raise SimulationFailed(
                f"The simulator gave NaN or infinity as {listing(wrong)} at {where}. Nothing of this episode was kept."
            )
        lit = frozenset(camera for camera in cameras if camera_frame(observation, camera).any())
        black = self._lit.setdefault(task_id, lit) - lit
        if black:
            raise CameraBlack(
                f"The picture of {listing(sorted(black))} at {where} is black, and that of the task's first replan was "
                "not. Nothing of this episode was kept."
            )
