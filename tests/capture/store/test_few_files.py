"""How many files and folders captured episodes have: clusters and hubs count them.

Not here, because they need packages of their own: policies of LeRobot and GR00T (`tests/policies`). Each site takes 7
files, 9 with contributions, as the sites here do.
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.kit.attacks import files_of
from tests.kit.lerobot_data_sets import episodes_of_store, write_data_set
from tests.kit.still_scene import capture_without_simulator
from tests.kit.stores import write_store
from vla_attention.analyze.store.copying import copy_store
from vla_attention.capture.__main__ import main as capture
from vla_attention.capture.store import codecs as store_codecs
from vla_attention.capture.store.disk_estimate import estimate_disk
from vla_attention.schemas.stores.reader import open_store

MOST_FILES = 41
WHERE = ("--task-suite", "robosuite", "--task-id", "0", "--num-episodes", "1", "--max-steps", "30")
TINY = ("--checkpoint", "untrained-tiny")
CAMERAS = {"base_0_rgb": "image", "left_wrist_0_rgb": "wrist_image"}


def run(*arguments: object) -> None:
    assert capture([str(argument) for argument in arguments]) == 0


def check_few(store: Path, most: int = MOST_FILES) -> int:
    """Fail unless every array of every episode is one file; returns the most files that an episode has."""
    found = []
    for episode in open_store(store).episodes:
        folder = Path(str(episode.folder))
        for name in episode.attributes.arrays:
            assert len(files_of(folder, name)) == 1, name
        kinds = {file.parent: json.loads(file.read_text())["node_type"] for file in folder.rglob("zarr.json")}
        folders = {folder, *(path for path in folder.rglob("*") if path.is_dir())}
        assert folders == set(kinds), "a folder that is neither a group nor an array"
        found.append(sum(path.is_file() for path in folder.rglob("*")))
        root = open_store(store).attributes
        pictures = sum("frames/" in name for name in episode.attributes.arrays)
        expected = estimate_disk(root.recording, root.sites, [0] * pictures, 1, 1).inodes_per_episode
        assert len(folders) + found[-1] <= expected <= 1.7 * (len(folders) + found[-1])
        assert found[-1] == len(kinds) + len(episode.attributes.arrays)
    assert max(found) <= most
    return max(found)


@pytest.fixture
def still_scene(monkeypatch: pytest.MonkeyPatch) -> None:
    """Captures in a scene in which nothing moves, with a block of rows for as few replans as there can be."""
    capture_without_simulator(monkeypatch)
    monkeypatch.setattr(store_codecs, "TARGET_CHUNK_BYTES", 1)


@pytest.mark.usefixtures("still_scene")
def test_pi_its_reruns_and_replays(tmp_path):
    store = tmp_path / "run.zarr"
    run("pi", *WHERE, *TINY, "--queries", "all", "--denoise", "all", "--contributions", "--output", store)
    assert check_few(store, 32) == 32
    run("rerun", store, "--knockout", "camera:base_0_rgb", "--output", tmp_path / "without.zarr")
    check_few(tmp_path / "without.zarr")
    data = write_data_set(tmp_path / "data", "v3.0", episodes_of_store(store, CAMERAS))
    run("replay", data, *TINY, "--contributions", "--output", tmp_path / "replay.zarr")
    check_few(tmp_path / "replay.zarr")


def test_an_episode_of_any_length_has_the_same_files(tmp_path, monkeypatch):
    monkeypatch.setattr(store_codecs, "TARGET_CHUNK_BYTES", 1)
    counts = {replans: check_few(write_store(tmp_path / f"{replans}.zarr", replans=replans)) for replans in (1, 60)}
    assert counts[1] == counts[60]
    copy_store(open_store(tmp_path / "60.zarr"), tmp_path / "copy.zarr", ("frames",))
    assert check_few(tmp_path / "copy.zarr") < counts[60]
