"""An environment without a simulator, in which nothing moves: the real command line then takes seconds."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest

from tests.kit.policy_inputs import make_observation
from vla_attention.capture.environments.base import NO_DEPARTURES, Departures, Moment, StepResult
from vla_attention.capture.environments.episode_protocol import WAIT_STEPS
from vla_attention.schemas.episode_steps import HAND, POSE, TaskGoal
from vla_attention.schemas.groupings.vocabulary import SceneObject


class StillScene:
    """Shows the same pictures at every step of an episode; another episode has other pictures. Nothing is solved."""

    objects = (SceneObject("cube", "object", True), SceneObject("background", "background", False))

    def reset(self, initial_state_index: int, seed: int) -> None:
        self._observation = make_observation(initial_state_index)
        self.initial_state_digest = hashlib.sha256(bytes([initial_state_index])).hexdigest()

    def missing_resets(self, initial_state_index: int, seed: int) -> int:
        return 0

    def step(self, action: np.ndarray, observe: bool) -> StepResult:
        return StepResult(False, self._observation if observe else None)

    def segmentation(self, camera: str) -> np.ndarray:
        return np.ones((256, 256), dtype=np.int32)

    def close(self) -> None:
        pass


class ToldScene(StillScene):
    """A `StillScene` that tells moments, as simulators do: the hand rises, and touches the cube at the third step."""

    bodies = (HAND, "cube")

    def __init__(self, task_id: int) -> None:
        self.goals = tuple(
            TaskGoal(task, f"lift_{task}", f"lift cube {task}", (f"up cube_{task}",), None)
            for task in (task_id, task_id + 1)
        )

    def reset(self, initial_state_index: int, seed: int) -> None:
        super().reset(initial_state_index, seed)
        self.steps = 0

    def step(self, action: np.ndarray, observe: bool) -> StepResult:
        self.steps += 1
        return super().step(action, observe)

    def moment(self) -> Moment:
        poses = np.zeros((2, POSE), np.float32)
        poses[:, 3], poses[0, 2] = 1, self.steps / 100
        touches = self.steps >= WAIT_STEPS + 3
        return Moment(poses, np.full(2, 0.04, np.float32), np.array([False, touches]), np.array([False, touches]))

    def departures(self) -> Departures:
        return NO_DEPARTURES


def capture_without_simulator(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let captures of this test run in a `ToldScene`."""
    monkeypatch.setattr(
        "vla_attention.capture.engine.simulator_process.make_environment",
        lambda suite, task_id, settings: ToldScene(task_id),
    )
    monkeypatch.setattr("vla_attention.capture.run.capture_run.default_num_envs", lambda suite: 1)
    monkeypatch.setattr("vla_attention.capture.environments.drawing.check_drawing", lambda suite, libero_assets: "")
