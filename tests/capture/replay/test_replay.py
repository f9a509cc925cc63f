"""`capture replay`: the rows of a run come back from its pictures, and every robot has its own columns."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import numpy as np
import polars as pl
import pytest
import zarr

import vla_attention as va
from tests.kit.lerobot_data_sets import H264, episodes_of_store, made_up_episodes, number_of, write_data_set
from tests.kit.pi_golden import GOLDEN
from tests.kit.races import unlike
from tests.kit.raw_rows import probabilities
from tests.kit.small_tokenizer import train_small_tokenizer
from tests.kit.still_scene import capture_without_simulator
from tests.thorough.hostile_data_sets.run_cases import CASES
from vla_attention.analyze.__main__ import main as analyze
from vla_attention.capture.__main__ import main as capture
from vla_attention.schemas.layout import Role
from vla_attention.schemas.stores.reader import open_store

LIBERO_COLUMNS = {"base_0_rgb": "image", "left_wrist_0_rgb": "wrist_image"}
LEROBOT_COLUMNS = {"image": "observation.images.image", "image2": "observation.images.image2"}
TINY = ("--checkpoint", "untrained-tiny")


@pytest.fixture(scope="module")
def tokenizer(tmp_path_factory) -> Path:
    return train_small_tokenizer(tmp_path_factory.mktemp("tokenizer") / "small.model")


def run(*arguments: object) -> int:
    return capture([str(argument) for argument in arguments])


def episode(store: Path, task: int, number: int) -> zarr.Group:
    return zarr.open_group(store / "episodes" / f"task{task:03d}_episode{number:03d}", mode="r")


def simulate(monkeypatch, store, *options):
    """A run of two episodes in a scene in which nothing moves; its noise changes from replan to replan."""
    capture_without_simulator(monkeypatch)
    where = ("--task-suite", "robosuite", "--task-id", 0, "--num-episodes", 2, "--max-steps", 15)
    assert run("pi", *where, "--output", store, *options) == 0


def assert_same_calls(one: Path, other: Path, num_episodes: int = 2) -> None:
    """Fail unless two stores have the same rows, actions, roles and pictures, to the bit."""
    for number in range(num_episodes):
        first, second = episode(one, 0, number), episode(other, 0, number)
        arrays = ("joint/rows", "joint/key_role", "joint/contribution", "actions")
        for name in (*arrays, *(f"frames/{camera}" for camera in first["frames"])):
            np.testing.assert_array_equal(first[name][:], second[name][:], err_msg=name)
        assert first.attrs["noise_seed"] == second.attrs["noise_seed"]


@pytest.mark.parametrize(("version", "every"), [("v2.1", 1), ("v3.0", 3)])
def test_pictures_of_a_run_give_the_rows_of_that_run(tmp_path, monkeypatch, version, every):
    simulate(monkeypatch, tmp_path / "run.zarr", *TINY)
    episodes = episodes_of_store(tmp_path / "run.zarr", LIBERO_COLUMNS, every=every)
    data = write_data_set(tmp_path / "data", version, episodes)
    assert run("replay", data, *TINY, "--every", every, "--output", tmp_path / "replay.zarr") == 0
    assert_same_calls(tmp_path / "run.zarr", tmp_path / "replay.zarr")
    replayed = episode(tmp_path / "replay.zarr", 0, 1)
    assert replayed.attrs["env_step"] == [0, every, 2 * every, 3 * every]
    assert analyze(["store", "verify", str(tmp_path / "replay.zarr")]) == 0


@pytest.mark.parametrize("case", ["pi05_batch2", "pi0_batch2"])
def test_a_lerobot_policy_gives_the_rows_of_its_run(tmp_path, monkeypatch, tokenizer, case):
    model = ("--checkpoint", GOLDEN / case / "checkpoint_lerobot", "--tokenizer", tokenizer)
    simulate(monkeypatch, tmp_path / "run.zarr", *model)
    episodes = episodes_of_store(tmp_path / "run.zarr", LEROBOT_COLUMNS, own_pictures=True, state_dtype="float32")
    data = write_data_set(tmp_path / "data", "v3.0", episodes)
    # the evaluations of LeRobot have another seed
    assert run("replay", data, *model, "--every", 1, "--seed", 1000, "--output", tmp_path / "replay.zarr") == 0
    assert_same_calls(tmp_path / "run.zarr", tmp_path / "replay.zarr")
    for camera in LEROBOT_COLUMNS:
        own = [episode(tmp_path / f"{name}.zarr", 0, 0)[f"camera_frames/{camera}"][:] for name in ("run", "replay")]
        np.testing.assert_array_equal(own[0][:, ::-1, ::-1], own[1])


@pytest.mark.parametrize("encoding", [H264])
def test_a_video_gives_nearly_the_rows_of_the_run(tmp_path, monkeypatch, encoding):
    """With the trained policy that we ship; docs/my-data-set.md has what was measured on pictures of a simulator."""
    cubes = ("--checkpoint", "pi05_cubes")
    simulate(monkeypatch, tmp_path / "run.zarr", *cubes)
    episodes = episodes_of_store(tmp_path / "run.zarr", LIBERO_COLUMNS)
    data = write_data_set(tmp_path / "data", "v3.0", episodes, video=encoding)
    assert run("replay", data, *cubes, "--every", 1, "--output", tmp_path / "replay.zarr") == 0
    for number in range(2):
        stores = [episode(tmp_path / f"{name}.zarr", 0, number) for name in ("run", "replay")]
        rows = [probabilities(one["joint/rows"]) for one in stores]
        moved = np.abs(rows[0] - rows[1]).sum(axis=-1) / 2  # probability that lies on other keys
        assert 0 < moved.mean() < 0.03
        assert moved.max() < 0.2


def test_the_store_says_what_was_replayed(tmp_path, capsys):
    made = made_up_episodes((7, 5, 9), ("observation.images.front", "observation.images.wrist"))
    data = write_data_set(tmp_path / "so101_pick", "v3.0", made, video=H264)
    cameras = ("--camera", "base_0_rgb=front", "--camera", "left_wrist_0_rgb=observation.images.wrist")
    store = tmp_path / "replay.zarr"
    options = (*TINY, *cameras, "--every", 3, "--output", store)
    assert run("replay", data, *options, "--episode", "1-2") == 0
    capsys.readouterr()
    root = open_store(store).attributes
    assert (root.protocol.name, root.protocol.suite, root.protocol.replan_steps) == ("dataset", "so101_pick", 3)
    assert root.data_set is not None
    assert (root.data_set.version, root.data_set.fps, root.data_set.robot_type) == ("v3.0", 10, "so101")
    assert root.data_set.columns["actions"] == "action"
    stored = episode(store, 0, 2)  # the third episode has the first task
    assert (stored.attrs["instruction"], stored.attrs["task_name"]) == (
        "put the cup on the plate",
        "put_the_cup_on_the_plate",
    )
    assert (stored.attrs["success"], stored.attrs["num_steps"]) == (None, 9)
    np.testing.assert_array_equal(stored["state"][:], made[2].columns["observation.state"][::3])
    np.testing.assert_array_equal(stored["dataset_actions"][1], made[2].columns["action"][3:7])
    assert stored.attrs["dataset_action_count"] == [4, 4, 3]
    np.testing.assert_array_equal(stored["dataset_actions"][2, :3], made[2].columns["action"][6:9])
    assert stored["actions"].shape == (3, 4, 6)
    assert len(set(stored.attrs["noise_seed"])) == 3
    # Pictures of 64 x 96 are fitted into 28 x 28; their stripes are still to be told apart.
    for camera, first in (("base_0_rgb", 200), ("left_wrist_0_rgb", 250)):
        frames = stored[f"frames/{camera}"][:]
        assert [number_of(np.repeat(np.repeat(f[5:23], 8, 0), 8, 1)) for f in frames] == [first, first + 3, first + 6]
    # with --resume, what is missing is added
    shutil.rmtree(store / "episodes" / "task000_episode002")
    assert run("status", store, "--check") == 1
    assert re.search("task 0 .*1 of 1 .*: 2", capsys.readouterr().out)
    assert run("replay", data, *options, "--resume") == 0
    assert re.search("1 of 3 .* 2 to run", capsys.readouterr().out)
    assert run("status", store, "--check") == 0
    assert "missing" not in capsys.readouterr().out
    assert sorted(path.name for path in (store / "episodes").glob("task*")) == [
        "task000_episode000",
        "task000_episode002",
        "task001_episode001",
    ]
    assert run("replay", data, *options) == 2
    assert str(store) in capsys.readouterr().err
    assert run("replay", data, *TINY, *cameras, "--every", 2, "--output", store, "--resume") == 2
    assert re.search(r"protocol\.replan_steps .*3,.* 2", capsys.readouterr().err)
    assert analyze(["store", "verify", str(store)]) == 0


def test_a_resumed_replay_has_the_bytes_of_an_undisturbed_one(tmp_path):
    made = made_up_episodes((7, 5, 9, 6), tuple(LIBERO_COLUMNS.values()), state=8, action=7)
    data = write_data_set(tmp_path / "data", "v3.0", made)
    whole, resumed = tmp_path / "a/replay.zarr", tmp_path / "b/replay.zarr"
    assert run("replay", data, *TINY, "--every", 3, "--output", whole) == 0
    shutil.copytree(whole, resumed)
    for name in ("task000_episode000", "task001_episode003"):
        shutil.rmtree(resumed / "episodes" / name)
    assert run("replay", data, *TINY, "--every", 3, "--output", resumed, "--resume") == 0
    shutil.rmtree(resumed / "episodes/task000_episode002")
    assert run("replay", data, *TINY, "--every", 3, "--output", resumed, "--resume") == 0
    assert unlike(whole, resumed) == ()


def test_another_instruction_and_known_outcomes(tmp_path):
    made = made_up_episodes((4, 4), tuple(LIBERO_COLUMNS.values()))
    for number, solved in enumerate((False, True)):
        made[number].columns["next.success"] = np.array([[False], [False], [False], [solved]])
    data = write_data_set(tmp_path / "data", "v2.1", made)
    store = tmp_path / "replay.zarr"
    words = ("--instruction", "close the box", "--action", "none")
    assert run("replay", data, *TINY, *words, "--output", store) == 0
    for number, solved in enumerate((False, True)):
        stored = episode(store, number, number)
        assert stored.attrs["success"] is solved
        assert stored.attrs["instruction"] == "close the box"
        assert "dataset_actions" not in stored


def test_a_replay_can_be_rerun_with_interventions(tmp_path, capsys):
    made = made_up_episodes((8,), tuple(LIBERO_COLUMNS.values()), state=14, action=14)
    data = write_data_set(tmp_path / "data", "v3.0", made, video=H264)
    store = tmp_path / "replay.zarr"
    assert run("replay", data, *TINY, "--output", store) == 0
    assert run("rerun", store, "--knockout", "camera:base_0_rgb") == 0
    said = capsys.readouterr().out
    assert "bit-equal" in said
    assert "NOT bit-equal" not in said
    [made_again] = [path for path in tmp_path.glob("*.zarr") if path != store]
    changed, base = (episode(path, 0, 0) for path in (made_again, store))
    assert not np.array_equal(changed["actions"][:], base["actions"][:])
    np.testing.assert_array_equal(changed["dataset_actions"][:], base["dataset_actions"][:])


def test_the_border_beside_a_picture_that_is_fitted_in_is_no_picture(tmp_path):
    """Pictures of 64 x 96 fill rows 5 to 22 of 28: of each of the 2 x 2 patches of 14 rows, 9 show something."""
    data = write_data_set(tmp_path / "data", "v3.0", made_up_episodes((8,), tuple(LIBERO_COLUMNS.values())))
    store = tmp_path / "replay.zarr"
    assert run("replay", data, *TINY, "--action", "none", "--output", store) == 0
    assert run("rerun", store, "--knockout", "camera:base_0_rgb", "--output", tmp_path / "cut.zarr") == 0
    for path in (store, tmp_path / "cut.zarr"):
        stored = episode(path, 0, 0)
        assert stored.attrs["shown"] == {camera: pytest.approx([5 / 28, 0, 18 / 28, 1]) for camera in LIBERO_COLUMNS}
    stored = episode(store, 0, 0)
    for camera in LIBERO_COLUMNS:
        seen = stored[f"frames/{camera}"][:].any(axis=(0, 2, 3))
        np.testing.assert_array_equal(seen, [5 <= row < 23 for row in range(28)])
    groups = {row["group"]: row for row in va.open(store).analyze()["tasks_groups"].iter_rows(named=True)}
    rows, roles = probabilities(stored["joint/rows"]).mean(axis=(1, 2, 3, 4)), stored["joint/key_role"][:]
    whole = (rows * (roles == Role.IMAGE)).sum(axis=1).mean()
    for group, part in (("visual", 9 / 14), ("border", 5 / 14)):
        assert groups[group]["mass"] == pytest.approx(whole * part, rel=1e-4)
        assert groups[group]["keys"] == pytest.approx(8 * part)
    scale = {row["item"]: row for row in va.open(store).words()["words"].iter_rows(named=True)}
    assert scale["image patches"]["mass"] == pytest.approx(groups["visual"]["mass"], rel=1e-4)
    assert scale["border of pictures"]["mass"] == pytest.approx(groups["border"]["mass"], rel=1e-4)
    shares = va.open(store).overlay(episode=0, tasks=0)["overlay_patches"].group_by("replan").agg(pl.sum("share"))
    np.testing.assert_allclose(shares["share"], 1.0, rtol=1e-4)


def test_mistakes_end_with_one_line(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    made = made_up_episodes((3, 3, 3), tuple(LIBERO_COLUMNS.values()), state=8, action=7)
    data = write_data_set(tmp_path / "data", "v2.1", made)
    for options, named in (
        (["--episode", 3], r"\b3; .* 0 to 2"),
        (["--camera", "base=image"], "'base'.*'base_0_rgb'"),
        (["--camera", "base_0_rgb=front"], "'data' 'front'"),
        (["--policy", "smolvla"], "--policy smolvla; .*pi"),
    ):
        assert run("replay", data, *TINY, "--output", "replay.zarr", *options) == 2
        error = capsys.readouterr().err
        assert re.search(named, error)
        assert error.startswith("vla-attention capture: ")
        assert "Traceback" not in error
    assert not list(tmp_path.rglob("*.zarr"))


def test_a_checkpoint_of_another_robot_is_refused(tmp_path, capsys, tokenizer):
    made = made_up_episodes((3,), tuple(LIBERO_COLUMNS.values()), state=14, action=14)
    data = write_data_set(tmp_path / "data", "v2.1", made)
    store = ("--tokenizer", tokenizer, "--output", tmp_path / "replay.zarr")
    assert run("replay", data, "--checkpoint", GOLDEN / "pi05_batch2/checkpoint_openpi_torch", *store) == 2
    assert re.search(r"\b8 .*'data' 14: observation\.state \(14\)", capsys.readouterr().err)


@pytest.mark.parametrize("name", ["table: a billion rows in a kilobyte", "picture: a PNG header of 100,000 x 100,000"])
def test_a_data_set_that_asks_for_all_memory_is_refused(tmp_path, capsys, name):
    (tmp_path / "case").mkdir()
    assert capture(CASES[name].make(tmp_path / "case")) == 2
    assert re.search(CASES[name].sentence, capsys.readouterr().err)
