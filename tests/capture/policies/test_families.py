"""A third policy family needs an entry in the registry only, from the help text to the analysis."""

from __future__ import annotations

import re

import numpy as np
import polars as pl
import pytest
import zarr

from vla_attention.capture.__main__ import main
from vla_attention.capture.engine import simulator_process
from vla_attention.capture.environments.base import Observation, StepResult
from vla_attention.capture.policies import families
from vla_attention.capture.policies.cosmos.family import CosmosSettings
from vla_attention.capture.policies.pi.family import PiSettings
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.groupings.vocabulary import SceneObject


class StubEnvironment:
    """A picture of 4 x 4 pixels that changes with every step; the task is never solved."""

    objects = (SceneObject("robot", "robot", False), SceneObject("background", "background", False))
    initial_state_digest = "d" * 64

    def __init__(self) -> None:
        self.steps = 0

    def reset(self, initial_state_index: int, seed: int) -> None:
        self.steps = 100 * initial_state_index

    def missing_resets(self, initial_state_index: int, seed: int) -> int:
        return initial_state_index

    def step(self, action: np.ndarray, observe: bool) -> StepResult:
        self.steps += 1
        if not observe:
            return StepResult(False, None)
        picture = np.random.default_rng(self.steps).integers(0, 255, (4, 4, 3), dtype=np.uint8)
        return StepResult(
            False, Observation({"agentview": picture}, np.zeros(3), np.array([0.0, 0, 0, 1]), np.zeros(2))
        )

    def segmentation(self, camera: str) -> np.ndarray:
        return np.repeat(np.array([0, 1], dtype=np.int32), 8).reshape(4, 4)

    def close(self) -> None:
        pass


@pytest.fixture
def toy_is_registered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(families, "FAMILY_MODULES", (*families.FAMILY_MODULES, "tests.kit.toy_family"))
    monkeypatch.setattr(simulator_process, "make_environment", lambda suite, task_id, settings: StubEnvironment())
    monkeypatch.setattr("vla_attention.capture.run.capture_run.default_num_envs", lambda suite: 1)
    monkeypatch.setattr("vla_attention.capture.environments.drawing.check_drawing", lambda suite, libero_assets: "")


@pytest.mark.usefixtures("toy_is_registered")
def test_a_third_family_captures_and_is_analysed(tmp_path, capfd):
    arguments = ["--task-id", "0", "--num-episodes", "2", "--max-steps", "6", "--toy-size", "3", "--no-contributions"]
    assert main(["toy", *arguments, "--output-dir", str(tmp_path)]) == 0

    store = tmp_path / "toy_robosuite.zarr"
    policy = dict(zarr.open_group(store, mode="r").attrs)["policy"]
    assert (policy["family"], policy["checkpoint"], policy["config"]["size"]) == ("toy", "toy-weights", 3)
    episode = zarr.open_group(store / "episodes/task000_episode001", mode="r")
    assert episode["joint/rows"].shape == (3, 1, 1, 2, 1, 7)
    np.testing.assert_allclose(episode["joint/atoms"][..., -1], 1, rtol=1e-6)
    # The ratio is the family's own default of the analysis.
    steps = pl.read_parquet(tmp_path / "steps.parquet")
    assert steps.height == 6
    assert (tmp_path / "attention_ratio_results_robosuite.json").is_file()
    assert "seen to read" in capfd.readouterr().out
    # Its store is run again with the family's own options.
    assert main(["rerun", str(store), "--toy-size", "3", "--check", "2"]) == 0
    assert "bit-equal" in capfd.readouterr().out
    assert main(["rerun", str(store)]) == 2
    assert re.search("action_horizon 3,.* 4", capfd.readouterr().err)


@pytest.mark.parametrize(
    ("settings", "given"),
    [
        (PiSettings("untrained-tiny", config_name="pi05_libero", dtype="bfloat16"), "--config-name, --dtype bfloat16"),
        (CosmosSettings("untrained-tiny", vae_path="x.pth"), "--vae-path"),
    ],
)
def test_options_of_checkpoints_are_refused_for_policies_that_come_along(settings, given):
    with pytest.raises(BadArgument, match=f"{given} .*'untrained-tiny'"):
        settings.build("cpu")
