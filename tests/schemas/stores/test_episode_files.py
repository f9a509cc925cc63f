"""The cheap look at an episode: what is missing, cut off or of another episode is named; arrays are not read."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest

from tests.kit.stores import StoreSpec, write_store
from vla_attention.schemas.stores.episode_files import check_presence
from vla_attention.schemas.stores.reader import StoredEpisode, open_store

SPEC = StoreSpec(tasks=(0,), episodes=2, replans=2, layers=(0,), heads=(0,), contributions=True)
ROWS = "joint/rows/c.0.0.0.0.0.0"


@pytest.fixture(scope="module")
def original(tmp_path_factory) -> Path:
    return write_store(tmp_path_factory.mktemp("present") / "a.zarr", spec=SPEC)


@pytest.fixture
def episode(original, tmp_path) -> Path:
    shutil.copytree(original, tmp_path / "a.zarr")
    return tmp_path / "a.zarr/episodes/task000_episode000"


def problems(episode: Path) -> list[str]:
    stored = StoredEpisode(episode, episode.name, open_store(episode.parents[1]).run)
    return [problem.text for problem in check_presence(stored)]


def test_a_whole_episode_is_present(episode):
    assert problems(episode) == []


def test_every_file_is_missed(episode):
    for file in sorted(file for file in episode.rglob("*") if file.is_file()):
        content = file.read_bytes()
        for change in (file.unlink, lambda file=file: file.write_bytes(b"")):
            change()
            found = problems(episode)
            assert found, file
            assert all("task000_episode000" in line for line in found)
            name = "seal" if file.parent.name == "seal" else str(file.relative_to(episode))
            assert any(name in line for line in found)
        file.write_bytes(content)
    assert problems(episode) == []


def test_cut_off_grown_and_edited_files(episode):
    rows = episode / ROWS
    content = rows.read_bytes()
    for changed in (content[:-1], content + b"\0"):
        rows.write_bytes(changed)
        (line,) = problems(episode)
        assert ROWS in line
        assert {str(len(changed)), str(len(content))} <= set(re.findall(r"\d+", line))
    rows.write_bytes(content)
    document = episode / "joint/zarr.json"
    document.write_bytes(document.read_bytes().replace(b"3", b"4"))
    assert "joint/zarr.json" in " ".join(problems(episode))


def test_a_folder_under_another_name_and_in_another_store(episode, tmp_path):
    copy = episode.with_name("task000_episode007")
    shutil.copytree(episode, copy)
    assert "task000_episode000" in " ".join(problems(copy))
    other = write_store(tmp_path / "b.zarr", spec=SPEC, seed=5)
    shutil.rmtree(other / "episodes/task000_episode000")
    shutil.copytree(episode, other / "episodes/task000_episode000")
    assert problems(other / "episodes/task000_episode000")
