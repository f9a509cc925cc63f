"""Cosmos through the real command lines: two sites in one store, which are never mixed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import zarr

from tests.end_to_end.written_tables import written_steps
from tests.kit.raw_rows import probabilities
from tests.kit.still_scene import capture_without_simulator
from vla_attention.analyze.__main__ import main as analyze
from vla_attention.capture.__main__ import main as capture

pytestmark = pytest.mark.simulator

#: One replan of one task, and one layer of it.
ONE_LAYER = (
    "cosmos",
    "--ckpt-path",
    "untrained-tiny",
    "--task-id",
    "0",
    "--num-episodes",
    "1",
    "--max-steps",
    "8",
    "--layers",
    "1",
)


@pytest.fixture(scope="module")
def cosmos_store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    store = tmp_path_factory.mktemp("cosmos") / "cosmos.zarr"
    arguments = [
        "cosmos",
        "--ckpt-path",
        "untrained-tiny",
        "--task-id",
        "1",
        "--num-episodes",
        "1",
        "--max-steps",
        "20",
    ]
    assert capture([*arguments, "--num-open-loop-steps", "8", "--output", str(store)]) == 0
    return store


def test_the_store_is_whole(cosmos_store):
    assert analyze(["store", "verify", str(cosmos_store)]) == 0


def test_rows_of_both_sites_sum_to_one_and_contributions_to_the_update(cosmos_store):
    episode = zarr.open_group(cosmos_store / "episodes/task001_episode000", mode="r")
    for site in ("self", "cross"):
        np.testing.assert_allclose(episode[f"{site}/atoms"][..., -1], 1.0, atol=1e-5)
        gram = episode[f"{site}/contribution"][:].astype(np.float64)
        np.testing.assert_allclose(gram[..., :-1, :-1].sum((-2, -1)), gram[..., -1, -1], rtol=1e-3)
    null = [part["role"] == "null" for part in episode.attrs["segments"]["cross"]]
    assert any(null)
    # Padded text takes attention and adds nothing.
    assert episode["cross/atoms"][..., :-1][..., null].min() > 0
    assert not episode["cross/contribution"][:][..., :-1, :][..., null, :].any()


def test_objects_lie_where_the_picture_shows_them(cosmos_store):
    """Cosmos's pictures are upright and not mirrored: the robot's gripper is in the upper half of the agent view."""
    episode = zarr.open_group(cosmos_store / "episodes/task001_episode000", mode="r")
    names = [thing["name"] for thing in episode.attrs["objects"]]
    coverage = episode["objects/primary"][0]
    side = round(len(coverage) ** 0.5)
    robot = coverage[:, names.index("robot")].reshape(side, side)
    assert robot[: side // 2].sum() > robot[side // 2 :].sum()


def test_each_site_is_analysed_by_itself(cosmos_store, tmp_path, capsys):
    assert analyze([str(cosmos_store), "--output", str(tmp_path / "self"), "--no-plots"]) == 0
    steps = written_steps(tmp_path / "self")
    assert "ratio" not in steps.columns
    assert (steps["visual_mass"] > 0).all()
    words = ["--site", "cross", "--group", "red=word:red", "--output", str(tmp_path / "cross"), "--no-plots"]
    assert analyze([str(cosmos_store), *words]) == 0
    assert (written_steps(tmp_path / "cross")["red_mass"] > 0).all()
    assert analyze([str(cosmos_store), "--group", "red=word:red", "--output", str(tmp_path / "none")]) == 2
    assert "--site" in capsys.readouterr().err


def test_the_published_frame_proxy_is_named_by_its_frames(tmp_path, monkeypatch):
    capture_without_simulator(monkeypatch)
    assert (
        capture([*ONE_LAYER, "--output-dir", str(tmp_path), "--visual-frame", "curr_last", "--text-frame", "frame0"])
        == 0
    )
    steps = written_steps(tmp_path)
    np.testing.assert_allclose(steps["ratio"], steps["curr_last_mass"] / steps["frame0_mass"], rtol=1e-6)
    assert (tmp_path / "attention_ratio_results_robosuite.json").is_file()


@pytest.mark.thorough
def test_queries_can_be_pooled_by_action_step(tmp_path):
    store = tmp_path / "a.zarr"
    assert capture([*ONE_LAYER, "--queries", "steps", "--output", str(store)]) == 0
    rows = probabilities(zarr.open_group(store / "episodes/task000_episode000", mode="r")["self/rows"])
    assert rows.shape[4] == 16 * 7
    assert analyze(["store", "verify", str(store)]) == 0


def test_bad_input_is_named_in_one_line(tmp_path, capsys):
    given = ["cosmos", "--ckpt-path", "untrained-tiny", "--output", str(tmp_path / "a.zarr")]
    assert capture([*given, "--query-frame", "actoin"]) == 2
    said = capsys.readouterr().err.strip()
    assert "'action'" in said
    assert "\n" not in said
