"""examples/lerobot_eval_recorded.py in LeRobot's own evaluation loop: a small SmolVLA, two environments at once."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

pytest.importorskip("lerobot", reason="run by make test-policies, in .venv-lerobot")

import gymnasium

from tests.policies import lerobot_models as models
from tests.policies.word_tokenizer import INSTRUCTION, WordTokenizer
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.verify import verify_store

ENDS = (7, 12)


class NoiseEnvironment(gymnasium.Env[Any, Any]):
    """Pictures of noise; ends after a number of steps, the first environment in success."""

    metadata = {"render_fps": 10}  # noqa: RUF012
    task = task_description = INSTRUCTION
    _max_episode_steps = 20

    def __init__(self, number: int) -> None:
        pictures = {name: gymnasium.spaces.Box(0, 255, (48, 64, 3), dtype=np.uint8) for name in models.CAMERAS}
        self.observation_space = gymnasium.spaces.Dict(
            {
                "pixels": gymnasium.spaces.Dict(pictures),
                "agent_pos": gymnasium.spaces.Box(-1, 1, (models.STATE_DIM,), dtype=np.float64),
            }
        )
        self.action_space = gymnasium.spaces.Box(-1, 1, (models.ACTION_DIM,), dtype=np.float32)
        self.number, self.count = number, 0

    def _observation(self) -> dict[str, Any]:
        numbers = np.random.default_rng([self.number, self.count])
        return {
            "pixels": {name: numbers.integers(0, 255, (48, 64, 3), dtype=np.uint8) for name in models.CAMERAS},
            "agent_pos": np.full(models.STATE_DIM, self.count / 20),
        }

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        self.count = 0
        return self._observation(), {"is_success": False}

    def step(self, action: Any) -> Any:
        self.count += 1
        ended = self.count >= ENDS[self.number]
        success = {"is_success": bool(ended and self.number == 0)}
        # As LeRobot's own environments say it, which also reset themselves.
        return self._observation(), 0.0, ended, False, {**success, **({"final_info": success} if ended else {})}


def tokenized(batch: dict[str, Any]) -> dict[str, Any]:
    """The part of LeRobot's preprocessor that matters here: the task's token ids."""
    ids = torch.tensor([WordTokenizer().encode(text) for text in batch["task"]])
    seen = torch.ones_like(ids, dtype=torch.bool)
    return {**batch, "observation.language.tokens": ids, "observation.language.attention_mask": seen}


@pytest.fixture
def lerobot_eval():
    module = pytest.importorskip("lerobot.scripts.lerobot_eval")
    own = module.rollout, module.run_one
    yield module
    module.rollout, module.run_one = own


def test_two_environments_are_two_episodes_that_end_when_they_end(lerobot_eval, tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "path", [str(Path(__file__).parents[2] / "examples"), *sys.path])
    from lerobot_eval_recorded import Recorder

    policy = models.small_smolvla(tmp_path / "vlm")
    recorder = Recorder(str(tmp_path / "run.zarr"), tokenizer=WordTokenizer(), untrained=True, durable=False)

    def evaluate() -> Any:
        policy.reset()
        torch.manual_seed(0)
        env = gymnasium.vector.SyncVectorEnv(
            [lambda number=number: NoiseEnvironment(number) for number in range(2)],
            autoreset_mode=gymnasium.vector.AutoresetMode.NEXT_STEP,
        )
        nothing = lambda value: value  # noqa: E731
        return lerobot_eval.eval_policy_all(
            envs={"noise": {0: env}}, policy=policy, env_preprocessor=nothing, env_postprocessor=nothing,
            preprocessor=tokenized, postprocessor=nothing, n_episodes=2, start_seed=3,
        )  # fmt: skip

    plain = evaluate()
    recorder.install()
    recorded = evaluate()
    # What lerobot-eval reports is the same, but for its timings.
    assert plain["per_task"] == recorded["per_task"]
    store = open_store(tmp_path / "run.zarr")
    assert verify_store(store) == []
    facts = [
        (part.attributes.episode_index, part.attributes.success, part.attributes.num_steps) for part in store.episodes
    ]
    assert facts == [(0, True, ENDS[0]), (1, False, ENDS[1])]
    # A chunk has 5 actions: calls at 0, 5, and 10 where the episode goes on.
    assert [list(part.read("env_step")) for part in store.episodes] == [[0, 5], [0, 5, 10]]
    assert [part.attributes.instruction for part in store.episodes] == [INSTRUCTION] * 2
    first = NoiseEnvironment(1)._observation()["pixels"]["wrist"]
    frame = store.episodes[1].read("frames/wrist")[0]
    # SmolVLA pads a picture of 48 x 64 at the top.
    np.testing.assert_array_equal(frame[16:], first)
