"""An environment without a simulator, in which nothing moves: the real command line then takes seconds."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest

from tests.kit.policy_inputs import make_observation
from vla_attention.capture.environments.base import StepResult
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


def capture_without_simulator(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let captures of this test run in a `StillScene`."""
    monkeypatch.setattr(
        "vla_attention.capture.rollout.simulator_source.make_environment", lambda suite, task_id, settings: StillScene()
    )
    monkeypatch.setattr("vla_attention.capture.run.capture_run.default_num_envs", lambda: 1)
