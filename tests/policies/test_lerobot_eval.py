"""examples/lerobot_plugin in LeRobot's own loop, and by the plain console command: two environments at once."""

from __future__ import annotations

import importlib.metadata
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

pytest.importorskip("lerobot", reason="run by make test-policies, in .venv-lerobot")

import gymnasium

import vla_attention as va
from tests.policies import lerobot_models as models
from tests.policies.noise_environment import ENDS, NoiseEnvironment
from tests.policies.word_tokenizer import INSTRUCTION, WordTokenizer
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.verify import verify_store

#: Of a data set: what the pictures and the state are normalised with.
STATISTICS = {
    name: {
        kind: torch.full((feature.shape[0], *[1] * (len(feature.shape) - 1)), value)
        for kind, value in (("mean", 0.5), ("std", 0.25))
    }
    for name, feature in models.environment_features().items()
}
#: The plain console command of this environment.
COMMAND = Path(sys.executable).with_name("lerobot-eval")


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


@pytest.mark.parametrize("name", ["smolvla", "evo1"])
def test_two_environments_are_two_episodes_that_end_when_they_end(lerobot_eval, tmp_path, name):
    from lerobot_policy_vla_attention.recorder import Recorder

    if name == "evo1":
        pytest.importorskip("lerobot.policies.evo1", reason="LeRobot 0.6's, in .venv-lerobot06")
        policy, tokenizer = models.small_evo1(tmp_path / "vlm", max_action_dim=models.ACTION_DIM), {}
    else:
        policy, tokenizer = models.small_smolvla(tmp_path / "vlm"), {"tokenizer": WordTokenizer()}
    recorder = Recorder(str(tmp_path / "run.zarr"), **tokenizer, untrained=True, durable=False)

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
    if name == "smolvla":  # pads a picture of 48 x 64 at the top
        np.testing.assert_array_equal(frame[16:], first)
    assert "bowl" in va.open(tmp_path / "run.zarr").words()["words"]["item"].to_list()


@pytest.fixture
def saved_act(tmp_path):
    """A folder as `--policy.path` takes it."""
    if not [*importlib.metadata.distributions(name="torchvision")]:
        pytest.skip("a command of its own has no stand-in for torchvision (.venv-lerobot06 has torchvision)")
    from lerobot.policies.factory import make_pre_post_processors

    policy = models.small_act(**models.features(48, 64))
    policy.save_pretrained(tmp_path / "act")
    for pipeline in make_pre_post_processors(policy.config, dataset_stats=STATISTICS):
        pipeline.save_pretrained(tmp_path / "act")
    return tmp_path / "act"


def evaluated(policy: Path, store: Path, command: tuple[str | Path, ...] = (COMMAND,)) -> Any:
    """Run lerobot-eval with the store's variable set."""
    arguments = [
        *(f"--policy.path={policy}", "--policy.device=cpu", f"--output_dir={store.parent / 'evaluation'}"),
        *("--env.discover_packages_path=tests.policies.noise_environment", "--env.type=noise"),
        *("--eval.n_episodes=2", "--eval.batch_size=2", "--eval.use_async_envs=false", "--seed=1000"),
    ]
    settings = {**os.environ, "VLA_ATTENTION_STORE": str(store), "PYTHONPATH": str(Path(__file__).parents[2])}
    return subprocess.run([*command, *arguments], env=settings, capture_output=True, text=True, cwd=store.parent)


def test_the_console_command_records_where_the_variable_names_a_store(saved_act, tmp_path):
    done = evaluated(saved_act, tmp_path / "run.zarr")
    assert done.returncode == 0, done.stderr[-3000:]
    store = open_store(tmp_path / "run.zarr")
    assert verify_store(store) == []
    facts = [part.attributes for part in store.episodes]
    assert [(part.success, part.num_steps) for part in facts] == [(True, ENDS[0]), (False, ENDS[1])]
    assert [set(part.noise_seed) for part in facts] == [{1000}, {1001}]
    reported = json.loads((tmp_path / "evaluation" / "eval_info.json").read_text())
    assert reported["overall"]["pc_success"] == 50
    # Stored as the environment gives them, though the policy gets them normalised.
    first = NoiseEnvironment(1)._observation()
    np.testing.assert_array_equal(store.episodes[1].read("frames/wrist")[0], first["pixels"]["wrist"])
    np.testing.assert_allclose(store.episodes[1].read("state")[:, 0], [0, 5 / 20, 10 / 20])


def test_another_command_records_nothing_and_says_so(saved_act, tmp_path):
    done = evaluated(saved_act, tmp_path / "run.zarr", (sys.executable, "-m", "lerobot.scripts.lerobot_eval"))
    assert "lerobot_eval records nothing" in done.stdout
    assert not (tmp_path / "run.zarr").exists()


def test_nothing_is_evaluated_where_nothing_can_be_recorded(monkeypatch, tmp_path):
    import lerobot_policy_vla_attention as plugin

    monkeypatch.setitem(sys.modules, "lerobot_policy_vla_attention.recorder", None)
    # LeRobot goes on after an exception of another class.
    with pytest.raises(SystemExit, match="attention cannot be recorded"):
        plugin.begin(str(tmp_path / "run.zarr"), "lerobot-eval")
