"""Copies of stores: `verify` accepts them, every kept number is equal, and a damaged episode is refused."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from vla_attention.analyze.__main__ import main as analyze
from vla_attention.analyze.copy.copying import PARTS, check_parts, copy_store, part_sizes
from vla_attention.schemas.errors import UnknownName
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.store_format import CorruptEpisode, RunMismatch
from vla_attention.schemas.stores.verify import verify_store
from vla_attention.testing.stores import StoreSpec, write_store

SPEC = StoreSpec(tasks=(0,), episodes=2, replans=2, layers=(0,), heads=(0,), contributions=True)


@pytest.fixture(scope="module")
def original(tmp_path_factory) -> Path:
    return write_store(tmp_path_factory.mktemp("copied") / "a.zarr", spec=SPEC)


def all_bytes(folder: Path) -> dict[str, bytes]:
    return {str(file.relative_to(folder)): file.read_bytes() for file in folder.rglob("*") if file.is_file()}


@pytest.mark.parametrize("without", [(), ("frames",), ("contributions",), ("contributions", "frames", "objects")])
def test_a_copy_verifies_and_holds_the_same_numbers(original, tmp_path, without):
    before = all_bytes(original)
    store = open_store(original)
    copied = copy_store(store, tmp_path / "b.zarr", without)
    copy = open_store(tmp_path / "b.zarr")
    assert verify_store(copy) == []
    assert [episode.name for episode in copy.episodes] == [episode.name for episode in store.episodes]
    for mine, theirs in zip(copy.episodes, store.episodes, strict=True):
        left = set(theirs.attributes.arrays) - set(mine.attributes.arrays)
        expected = {
            name
            for name in theirs.attributes.arrays
            if ("frames" in without and name.startswith("frames/"))
            or ("objects" in without and name.startswith("objects/"))
            or ("contributions" in without and name == "joint/contribution")
        }
        assert left == expected
        for name in mine.attributes.arrays:
            assert np.array_equal(mine.read(name), theirs.read(name), equal_nan=True), name
        folders = {entry.name for entry in mine.folder.iterdir()}
        assert folders.isdisjoint(set(without) & {"frames", "objects"})
    assert list(tmp_path.iterdir()) == [tmp_path / "b.zarr"]
    assert all_bytes(original) == before
    sizes = part_sizes(store)
    assert copied.left_bytes == sum(sizes[name] for name in without)
    assert sum(part_sizes(copy)[name] for name in without) == 0
    if not without:
        assert all_bytes(tmp_path / "b.zarr") == before


def test_the_copy_lists_the_parts_it_lacks(original, tmp_path):
    copy_store(open_store(original), tmp_path / "b.zarr", ("frames",))
    root = open_store(tmp_path / "b.zarr").attributes
    assert root.provenance["copied_without"] == "frames"
    assert root.recording.frames is False
    assert root.recording.contributions is True
    copy_store(open_store(tmp_path / "b.zarr"), tmp_path / "c.zarr", ("contributions",))
    last = open_store(tmp_path / "c.zarr").attributes
    assert last.provenance["copied_without"] == "frames, contributions"
    assert last.provenance["copied_from"] == root.provenance["copied_from"]
    assert verify_store(open_store(tmp_path / "c.zarr")) == []


def test_part_sizes_add_up_to_the_episodes(original):
    episodes = sum(file.stat().st_size for file in (original / "episodes").rglob("*") if file.is_file())
    outside = (original / "episodes/zarr.json").stat().st_size
    sizes = part_sizes(open_store(original))
    assert sum(sizes.values()) == episodes - outside
    assert all(sizes[name] > 0 for name in PARTS)


def test_a_copy_is_brought_up_to_date(tmp_path):
    path = write_store(tmp_path / "a.zarr", spec=SPEC, episodes=1)
    first = copy_store(open_store(path), tmp_path / "b.zarr", ("frames",))
    write_store(path, mode="resume", spec=SPEC)
    second = copy_store(open_store(path), tmp_path / "b.zarr", ("frames",))
    assert (first.added, first.present, second.added, second.present) == (1, 0, 1, 1)
    assert verify_store(open_store(tmp_path / "b.zarr")) == []
    with pytest.raises(RunMismatch, match="leaves other parts behind"):
        copy_store(open_store(path), tmp_path / "b.zarr", ("objects",))
    other = write_store(tmp_path / "other.zarr", spec=SPEC, seed=5)
    with pytest.raises(RunMismatch, match="of another run"):
        copy_store(open_store(other), tmp_path / "b.zarr", ("frames",))


@pytest.mark.parametrize("file", ["zarr.json", "joint/rows/zarr.json", "seal/zarr.json"])
def test_damaged_metadata_is_refused_and_never_sealed_anew(original, tmp_path, file):
    path = tmp_path / "a.zarr"
    shutil.copytree(original, path)
    damaged = path / "episodes/task000_episode000" / file
    damaged.write_bytes(damaged.read_bytes().replace(b'"', b" ", 1))
    with pytest.raises(CorruptEpisode, match="task000_episode000"):
        copy_store(open_store(path), tmp_path / "b.zarr", ("frames",))
    assert verify_store(open_store(tmp_path / "b.zarr")) == []
    assert not list((tmp_path / "b.zarr/episodes").glob("task*"))


def test_a_changed_root_and_a_lost_array_are_refused(original, tmp_path):
    path = tmp_path / "a.zarr"
    shutil.copytree(original, path)
    root = json.loads((path / "zarr.json").read_text())
    root["attributes"]["protocol"]["seed"] += 1
    (path / "zarr.json").write_text(json.dumps(root))
    with pytest.raises(CorruptEpisode, match="a run of another configuration"):
        copy_store(open_store(path), tmp_path / "b.zarr", ("frames",))
    shutil.rmtree(path)
    shutil.copytree(original, path)
    shutil.rmtree(path / "episodes/task000_episode000/joint/rows")
    with pytest.raises(CorruptEpisode, match="joint/rows"):
        copy_store(open_store(path), tmp_path / "c.zarr", ("frames",))


@pytest.mark.parametrize("without", [(), ("frames",)])
def test_damaged_values_are_refused(original, tmp_path, without):
    path = tmp_path / "a.zarr"
    shutil.copytree(original, path)
    (chunk,) = path.glob("episodes/task000_episode000/joint/rows/c.*")
    content = bytearray(chunk.read_bytes())
    content[len(content) // 2] ^= 1
    chunk.write_bytes(bytes(content))
    with pytest.raises(CorruptEpisode, match="task000_episode000 is damaged: its joint/rows"):
        copy_store(open_store(path), tmp_path / "b.zarr", without)
    assert not list((tmp_path / "b.zarr/episodes").glob("task*"))


def test_the_seal_of_a_changed_copy_names_the_captured_one(original, tmp_path):
    copy_store(open_store(original), tmp_path / "b.zarr", ("frames",))
    copy_store(open_store(tmp_path / "b.zarr"), tmp_path / "c.zarr", ("objects",))
    stores = [open_store(path) for path in (original, tmp_path / "b.zarr", tmp_path / "c.zarr")]
    for captured, first, second in zip(*(store.episodes for store in stores), strict=True):
        assert captured.seal.copied_from == ""
        assert first.seal.copied_from == second.seal.copied_from == captured.seal.digest
        assert len({captured.seal.run, first.seal.run, second.seal.run}) == 2  # frames are part of the recording


def test_command_line(original, tmp_path, capsys):
    assert analyze(["copy", str(original), "--without", "frames"]) == 0
    said = capsys.readouterr().out
    assert "always copied" in said
    assert "A copy without frames takes" in said
    assert analyze(["copy", str(original), str(tmp_path / "b.zarr"), "--without", "frames"]) == 0
    assert "2 episodes added" in capsys.readouterr().out
    for words, expected in (
        ([str(original), str(tmp_path / "x.zarr"), "--without", "frame"], "Did you mean 'frames'?"),
        ([str(original), str(tmp_path / "x")], "ends with '.zarr'"),
        ([str(original), str(original)], "to itself"),
        ([str(original), str(original / "zarr.json" / "x.zarr")], "Cannot copy to"),
        ([str(tmp_path / "none.zarr")], "There is no store at"),
    ):
        assert analyze(["copy", *words]) == 2
        said = capsys.readouterr().err
        assert expected in said
        assert said.count("\n") == 1
    assert not (tmp_path / "x.zarr").exists()


def test_parts_are_checked():
    assert check_parts(["objects", "frames", "objects"]) == ("frames", "objects")
    with pytest.raises(UnknownName):
        check_parts(["rows"])
