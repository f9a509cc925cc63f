"""A benchmark for vla-eval of two tasks on a picture of noise: done after a number of steps."""

from __future__ import annotations

from typing import Any

import numpy as np
from vla_eval.benchmarks.base import StepBenchmark, StepResult
from vla_eval.specs import IMAGE_RGB, LANGUAGE, RAW

TASKS = ("put the bowl on the plate", "put the plate on the bowl")


class NoiseBenchmark(StepBenchmark):
    """Pictures of noise; an episode ends in success after 8 steps, at the second task in failure."""

    render_backends = frozenset({"gpu", "cpu"})

    def get_tasks(self) -> list[dict[str, Any]]:
        return [{"name": name, "suite": "noise"} for name in TASKS]

    def reset(self, task: dict[str, Any]) -> Any:
        self.numbers = np.random.default_rng(task["episode_idx"])
        self.count = 0
        return self.numbers.random((2, 56, 56, 3))

    def step(self, action: dict[str, Any]) -> StepResult:
        assert np.shape(action["actions"]) == (4,)
        self.count += 1
        return StepResult(self.numbers.random((2, 56, 56, 3)), 0.0, self.count == 8, {})

    def make_obs(self, raw_obs: Any, task: dict[str, Any]) -> dict[str, Any]:
        pictures = (255 * raw_obs).astype(np.uint8)
        images = {"base": pictures[0], "wrist": pictures[1]}
        return {"images": images, "task_description": task["name"], "states": np.full(5, self.count / 8)}

    def get_step_result(self, step_result: StepResult) -> dict[str, Any]:
        return {"success": self._task["name"] == TASKS[0]}

    def get_metadata(self) -> dict[str, Any]:
        return {"max_steps": 20}

    def get_action_spec(self) -> dict[str, Any]:
        return {"action": RAW}

    def get_observation_spec(self) -> dict[str, Any]:
        return {"image": IMAGE_RGB, "language": LANGUAGE}
