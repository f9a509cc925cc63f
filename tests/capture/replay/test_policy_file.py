"""`capture replay --policy FILE.py`: a policy that no family knows, on a data set, through `va.record`."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import torch
import zarr

from tests.kit.lerobot_data_sets import H264, made_up_episodes, write_data_set
from tests.kit.small_torch_policy import BLOCKS, HEADS, HORIZON, SmallPolicy
from vla_attention.analyze.__main__ import main as analyze
from vla_attention.capture.__main__ import main as capture
from vla_attention.capture.policies.noise import noise_seed
from vla_attention.schemas.stores.reader import open_store

TASKS = ("pick the bowl", "pick up the plate")
CAMERAS = ("observation.images.front", "observation.images.wrist")
FILE = """
import torch
import vla_attention as va
from tests.kit.small_torch_policy import HORIZON, SmallPolicy, small_layout


def load(device):
    policy = SmallPolicy().to(device)

    def act(frame):
        picture = torch.from_numpy(frame.images["observation.images.front"][::8, ::12].copy()).permute(2, 0, 1) / 255
        state = torch.from_numpy(frame.values["observation.state"]).float()
        noise = torch.randn(1, HORIZON, 2)
        return policy.act(picture[None], [frame.instruction], state[None], noise)

    return va.datasets.ReplayPolicy(
        policy, small_layout(), act, tokenizer=policy.tokenizer, every=2, untrained=True, checkpoint="random weights"
    )
"""


@pytest.fixture
def data(tmp_path) -> Path:
    made = made_up_episodes((5, 4, 3), CAMERAS, state=2, action=2, tasks=TASKS)
    return write_data_set(tmp_path / "bowls", "v3.0", made, video=H264)


@pytest.fixture
def file(tmp_path) -> Path:
    path = tmp_path / "my_policy.py"
    path.write_text(FILE)
    return path


def run(*arguments: object) -> int:
    return capture([str(argument) for argument in arguments])


def test_any_torch_policy_on_a_data_set(tmp_path, data, file, capsys):
    store = tmp_path / "replay.zarr"
    assert run("replay", data, "--policy", file, "--output", store) == 0
    assert "3 episodes added" in capsys.readouterr().out
    root = open_store(store).attributes
    assert (root.protocol.name, root.protocol.suite, root.protocol.replan_steps) == ("dataset", "bowls", 2)
    assert root.data_set is not None
    assert root.data_set.columns["camera front"] == CAMERAS[0]
    episode = zarr.open_group(store / "episodes" / "task001_episode001", mode="r")
    assert episode["joint/rows"].shape[:4] == (2, BLOCKS, 2, HEADS)
    assert episode.attrs["env_step"] == [0, 2]
    assert (episode.attrs["instruction"], episode.attrs["success"]) == (TASKS[1], None)
    assert episode.attrs["dataset_action_count"] == [3, 2]
    prompt = episode.attrs["prompts"][0]
    assert [piece["text"].strip() for piece in prompt["pieces"] if piece["text"].strip()] == TASKS[1].split()
    # the actions are those of the policy on this frame, with the noise of this call's seed
    import vla_attention as va

    frame = list(va.datasets.open(data).episode(1).frames())[2]
    seed = noise_seed(7, 1, 1, 1)
    assert episode.attrs["noise_seed"][1] == seed
    picture = torch.from_numpy(frame.images[CAMERAS[0]][::8, ::12].copy()).permute(2, 0, 1) / 255
    state = torch.from_numpy(frame.values["observation.state"]).float()[None]
    with torch.no_grad():
        expected = SmallPolicy().act(picture[None], [TASKS[1]], state, _noise(seed))[0]
    np.testing.assert_array_equal(episode["actions"][1], expected.double().numpy())
    assert analyze(["store", "verify", str(store)]) == 0
    assert analyze([str(store), "--output", str(tmp_path / "results"), "--no-plots"]) == 0


def _noise(seed: int) -> torch.Tensor:
    torch.manual_seed(seed)
    return torch.randn(1, HORIZON, 2)


def test_a_file_s_replay_is_continued(tmp_path, data, file, capsys):
    store = tmp_path / "replay.zarr"
    options = ("replay", data, "--policy", file, "--output", store, "--layers", 0, 2, "--queries", "all")
    assert run(*options, "--episode", 2) == 0
    assert run(*options, "--resume") == 0
    assert re.search("1 of 3 .* 2 to run", capsys.readouterr().out)
    episode = zarr.open_group(store / "episodes" / "task000_episode002", mode="r")
    assert episode["joint"].attrs["layer"] == [0, 2]
    assert episode["joint/rows"].shape[4] == HORIZON
    assert run(*options, "--resume", "--every", 1) == 2
    assert re.search("replan_steps .*2,.* 1", capsys.readouterr().err)


def test_mistakes_are_named(tmp_path, data, capsys):
    for name, content, options, named in (
        ("none.py", None, (), "none.py"),
        ("number.py", "def load(device): return 3", (), "va.datasets.ReplayPolicy"),
        ("camera.py", FILE, ("--camera", "top=front"), "'top'"),
        ("knockout.py", FILE, ("--knockout", "camera:top"), "top"),
    ):
        file = tmp_path / name
        if content is not None:
            file.write_text(content)
        try:
            code = run("replay", data, "--policy", file, "--output", tmp_path / "replay.zarr", *options)
        except SystemExit as end:  # argparse's own
            code = end.code
        assert code == 2, name
        error = capsys.readouterr().err
        assert named in error, name
        assert "Traceback" not in error
