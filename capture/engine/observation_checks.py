"""What a simulator shows before a policy call: pictures that show nothing, and a state that is no number."""

from __future__ import annotations

import warnings
from collections.abc import Sequence, Set
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from vla_attention.capture.engine.simulation import SimulationFailed
from vla_attention.capture.environments.base import Observation, camera_frame
from vla_attention.capture.store.episode_writer import CONSTANT_CAMERAS
from vla_attention.schemas.errors import Note, listing

_STATE = ("eef_pos", "eef_quat", "gripper_qpos")


class CameraBlack(SimulationFailed):
    """A camera gave a black picture where the task's first one was not black: drawing has failed without an error."""


@dataclass
class ObservationChecks:
    """Checks the observations of one process; it keeps which cameras showed something in each task's first one."""

    _lit: dict[int, frozenset[str]] = field(default_factory=dict, init=False)
    _told: set[str] = field(default_factory=set, init=False)

    def check(self, task_id: int, observation: Observation, cameras: Sequence[str], where: str) -> frozenset[str]:
        """Raise unless a policy may be called with an observation.

        A camera that shows nothing in the task's first observation may be meant to: that is said once, in a `Note`.

        Args:
            task_id: its task.
            observation: what the simulator gave.
            cameras: names of the environment's cameras that the policy sees.
            where: replan and episode, for the sentence.

        Returns:
            The cameras whose pictures are of one colour.

        Raises:
            CameraBlack: a camera that showed something at first shows nothing.
            SimulationFailed: a number of the robot's state is NaN or infinite.
        """
        wrong = [name for name in _STATE if not np.isfinite(getattr(observation, name)).all()]
        if wrong:
            reason = f"The simulator gave NaN or infinity as {listing(wrong)}"
            raise SimulationFailed(f"{reason} at {where}. Nothing of this episode was kept.", reason)
        lit = frozenset(camera for camera in cameras if camera_frame(observation, camera).any())
        constant = frozenset(camera for camera in cameras if _is_constant(camera_frame(observation, camera)))
        if task_id not in self._lit:
            self._tell(sorted(constant - self._told), lit, where)
        black = self._lit.setdefault(task_id, lit) - lit
        if black:
            raise CameraBlack(
                f"The picture of {listing(sorted(black))} at {where} is black, and that of the task's first replan was "
                "not. Nothing of this episode was kept."
            )
        return constant

    def _tell(self, constant: Sequence[str], lit: Set[str], where: str) -> None:
        self._told.update(constant)
        for camera in constant:
            warnings.warn(
                f"The picture of {camera} at {where}, the first of its task, is "
                f"{'of one colour' if camera in lit else 'black'}: the camera shows nothing. If it should, stop and "
                "look at it with vla-attention capture doctor. Episodes in which it never shows anything name it in "
                "their "
                f"provenance ({CONSTANT_CAMERAS}).",
                Note,
                stacklevel=3,
            )


def _is_constant(frame: NDArray[np.uint8]) -> bool:
    """Whether all pixels of a picture (row, column, channel) have one colour."""
    corner = frame[0, 0]
    # A few pixels decide nearly always; all of them would cost as much as the rest of the checks.
    return bool((frame[::32, ::32] == corner).all() and (frame == corner).all())
