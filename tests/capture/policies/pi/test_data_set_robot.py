"""The robot of a data set for each kind of pi checkpoint: cameras, sizes, relative actions, openpi's DROID."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest

from tests.kit.pi_golden import GOLDEN
from tests.kit.small_tokenizer import train_small_tokenizer
from vla_attention.capture.policies.checkpoints import CheckpointMismatch
from vla_attention.capture.policies.pi.config import find_config
from vla_attention.capture.policies.pi.data_set_robot import openpi_robot
from vla_attention.capture.policies.pi.family import PiSettings
from vla_attention.capture.policies.pi.loading import choose_config, load_pi_policy
from vla_attention.capture.policies.pi.preprocess import read_norm_stats
from vla_attention.capture.policies.pi.stated_sizes import read_config
from vla_attention.capture.policies.robot import Robot, RobotData
from vla_attention.schemas.errors import BadArgument

DROID = RobotData(
    name="droid",
    cameras=("exterior_image_1_left", "exterior_image_2_left", "wrist_image_left"),
    numbers={"joint_position": 7, "gripper_position": 1, "actions": 8},
)
DROID_ROBOT = Robot(
    cameras={"base_0_rgb": "exterior_image_1_left", "left_wrist_0_rgb": "wrist_image_left"},
    state=("joint_position", "gripper_position"),
    state_dim=8,
    actions=("actions",),
    action_dim=8,
)


def openpi_checkpoint(folder, case, asset, state, actions):
    """A golden checkpoint in openpi's PyTorch format with the statistics of another robot.

    The golden pi0 is LeRobot's, whose tensors are the same.
    """
    stored = GOLDEN / case / "checkpoint_openpi_torch"
    shutil.copytree(stored if stored.is_dir() else GOLDEN / case / "checkpoint_lerobot", folder / "checkpoint")
    shutil.rmtree(folder / "checkpoint" / "assets", ignore_errors=True)
    generator = np.random.default_rng(0)

    def statistics(size):
        low = generator.uniform(-1, 0, size)
        numbers = {"mean": low + 0.5, "std": np.full(size, 0.4), "q01": low, "q99": low + 1}
        return {name: values.tolist() for name, values in numbers.items()}

    path = folder / "checkpoint" / "assets" / asset / "norm_stats.json"
    path.parent.mkdir(parents=True)
    path.write_text(json.dumps({"norm_stats": {"state": statistics(state), "actions": statistics(actions)}}))
    return folder / "checkpoint"


@pytest.fixture(scope="module")
def tokenizer(tmp_path_factory):
    return train_small_tokenizer(tmp_path_factory.mktemp("tokenizer") / "small.model")


def test_openpi_s_conversion_of_droid_is_known_by_its_columns(tmp_path):
    folder = openpi_checkpoint(tmp_path, "pi05_batch2", "droid", 8, 8)
    assert openpi_robot(DROID, read_norm_stats(folder)) == DROID_ROBOT


@pytest.mark.parametrize(("case", "name"), [("pi05_batch2", "pi05_droid"), ("pi0_batch2", "pi0_droid")])
def test_openpi_s_configuration_of_droid_is_known_by_its_statistics(tmp_path, case, name):
    folder = openpi_checkpoint(tmp_path, case, "droid", 8, 8)
    # This one states small sizes of its own in config.json; a released one does not.
    (folder / "config.json").write_text(json.dumps({"action_dim": 32, "action_horizon": 15}))
    chosen = choose_config(folder, "openpi_torch", PiSettings(), of_data_set=True)
    assert chosen.config == find_config(name)
    assert chosen.name == name
    assert name in chosen.source
    with pytest.raises(CheckpointMismatch):
        choose_config(folder, "openpi_torch", PiSettings())


def test_actions_of_a_robot_are_unnormalised_and_made_absolute(tmp_path, tokenizer):
    folder = openpi_checkpoint(tmp_path, "pi05_batch2", "trossen", 14, 14)
    data = RobotData(
        "bimanual", ("observation.images.cam_high",), {"observation.state": 14, "action": 14},
        chosen_cameras={"left_wrist_0_rgb": "none"}, relative_actions=6,
    )  # fmt: skip
    config = read_config(GOLDEN / "pi05_batch2" / "case.json")
    settings = PiSettings(
        str(folder), tokenizer=str(tokenizer), robot_data=data, model_config=GOLDEN / "pi05_batch2" / "case.json"
    )
    policy = load_pi_policy(settings)
    assert policy.robot.cameras == {"base_0_rgb": "observation.images.cam_high"}
    state = np.linspace(-0.5, 0.5, 14)
    model = np.random.default_rng(1).uniform(-1, 1, (config.action_horizon, config.action_dim))
    stats = json.loads(next(folder.rglob("norm_stats.json")).read_text())["norm_stats"]["actions"]
    low, high = (np.array(stats[name]) for name in ("q01", "q99"))
    expected = (model[:, :14] + 1) / 2 * (high - low + 1e-6) + low
    expected[:, :6] += state[:6]
    np.testing.assert_allclose(policy.processing.environment_actions(model, state), expected, atol=1e-12)
    picture = np.random.default_rng(2).integers(0, 255, (56, 56, 3)).astype(np.uint8)
    prepared = policy.prepare_robot({"observation.images.cam_high": picture}, state, "fold the towel")
    np.testing.assert_array_equal(prepared.frames["base_0_rgb"], picture)  # not turned around
    assert policy.act(prepared, 0).shape == (config.action_horizon, 14)
    with pytest.raises(BadArgument, match=r"\(8,\).*\(14,\)"):
        policy.prepare_robot({"observation.images.cam_high": picture}, state[:8], "fold the towel")


def test_what_does_not_fit_the_checkpoint_is_said(tmp_path):
    changes = {"numbers": {"joint_position": 6, "gripper_position": 1, "actions": 8}}
    folder = openpi_checkpoint(tmp_path, "pi05_batch2", "droid", 8, 8)
    with pytest.raises(BadArgument, match=r" 8 .* 7:"):
        openpi_robot(RobotData(**{**vars(DROID), **changes}), read_norm_stats(folder))
