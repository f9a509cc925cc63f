"""Copies of stores: `verify` accepts them, every kept number is equal, and a damaged episode is refused."""

from __future__ import annotations

import io
import json
import lzma
import os
import re
import shutil
import tarfile
from pathlib import Path

import numpy as np
import pytest

from tests.kit.stores import StoreSpec, small_effects, small_steps, write_store
from vla_attention.analyze.__main__ import main as analyze
from vla_attention.analyze.store.copying import PARTS, copy_store, open_source, part_sizes
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.root import NAMES_FILE
from vla_attention.schemas.stores.store_format import CorruptEpisode, RunMismatch
from vla_attention.schemas.stores.verify import verify_store

SPEC = StoreSpec(
    tasks=(0,),
    episodes=2,
    replans=2,
    layers=(0,),
    heads=(0,),
    contributions=True,
    plant_effects=small_effects,
    plant_steps=small_steps,
)


@pytest.fixture(scope="module")
def original(tmp_path_factory) -> Path:
    return write_store(tmp_path_factory.mktemp("copied") / "a.zarr", spec=SPEC)


def all_bytes(folder: Path) -> dict[str, bytes]:
    return {str(file.relative_to(folder)): file.read_bytes() for file in folder.rglob("*") if file.is_file()}


@pytest.mark.parametrize("without", [(), ("frames",), ("contributions",), ("effects",), ("steps",), tuple(PARTS)])
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
            or ("effects" in without and name in ("effects/change", "joint/cut"))
            or ("steps" in without and name.startswith("steps/"))
        }
        assert left == expected
        for name in mine.attributes.arrays:
            assert np.array_equal(mine.read(name), theirs.read(name), equal_nan=True), name
        folders = {entry.name for entry in mine.folder.iterdir()}
        assert folders.isdisjoint(set(without) & {"effects", "frames", "objects", "steps"})
    assert list(tmp_path.iterdir()) == [tmp_path / "b.zarr"]
    assert all_bytes(original) == before
    sizes = part_sizes(store)
    assert copied.left_bytes == sum(sizes[name] for name in without)
    assert sum(part_sizes(copy)[name] for name in without) == 0
    if not without:
        names = json.loads((tmp_path / "b.zarr" / NAMES_FILE).read_text())
        assert names == [episode.name for episode in store.episodes]
        assert {**all_bytes(tmp_path / "b.zarr"), NAMES_FILE: b""} == {**before, NAMES_FILE: b""}


def test_a_copy_is_brought_up_to_date(tmp_path):
    path = write_store(tmp_path / "a.zarr", spec=SPEC, episodes=1)
    first = copy_store(open_store(path), tmp_path / "b.zarr", ("frames",))
    write_store(path, mode="resume", spec=SPEC)
    second = copy_store(open_store(path), tmp_path / "b.zarr", ("frames",))
    assert (first.added, first.present, second.added, second.present) == (1, 0, 1, 1)
    assert verify_store(open_store(tmp_path / "b.zarr")) == []
    with pytest.raises(RunMismatch):
        copy_store(open_store(path), tmp_path / "b.zarr", ("objects",))
    other = write_store(tmp_path / "other.zarr", spec=SPEC, seed=5)
    with pytest.raises(RunMismatch):
        copy_store(open_store(other), tmp_path / "b.zarr", ("frames",))


@pytest.mark.parametrize("words", [(), ("--tar",), ("--without", "frames"), ("--tar", "--without", "frames")])
def test_an_episode_that_was_recorded_again_is_not_taken_for_the_copied_one(tmp_path, capsys, words):
    path, target = write_store(tmp_path / "a.zarr", spec=SPEC), tmp_path / "b.zarr"
    assert analyze(["store", "copy", str(path), str(target), *words]) == 0
    assert analyze(["store", "copy", str(path), str(target), *words]) == 0
    assert re.search(r"\b0 episodes added \(2 ", capsys.readouterr().out)
    shutil.rmtree(path / "episodes/task000_episode001")
    write_store(path, mode="resume", spec=SPEC, plant_success=lambda *_: False)
    before = all_bytes(target)
    assert analyze(["store", "copy", str(path), str(target), *words]) == 2
    said = capsys.readouterr().err
    assert "task000_episode001" in said
    assert said.count("\n") == 1
    assert all_bytes(target) == before


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
    with pytest.raises(CorruptEpisode):
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
    with pytest.raises(CorruptEpisode, match=r"task000_episode000 .*joint/rows"):
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
    assert analyze(["store", "copy", str(original), "--without", "frames"]) == 0
    said = capsys.readouterr().out
    assert " frames " in said
    assert analyze(["store", "copy", str(original), str(tmp_path / "b.zarr"), "--without", "frames"]) == 0
    assert "2 episodes added" in capsys.readouterr().out
    (tmp_path / "file").touch()
    for words, expected in (
        ([str(original), str(tmp_path / "x.zarr"), "--without", "frame"], "'frames'"),
        ([str(original), str(tmp_path / "x")], "'.zarr'"),
        ([str(original), str(original)], str(original)),
        ([str(original), str(original / "episodes" / "x.zarr"), "--tar"], str(original)),
        ([str(original), str(original / "sub" / "more" / "x.zarr")], str(original)),
        ([str(original), str(tmp_path / "file" / "x.zarr")], str(tmp_path / "file")),
        ([str(tmp_path / "none.zarr")], "none.zarr"),
    ):
        assert analyze(["store", "copy", *words]) == 2
        said = capsys.readouterr().err
        assert expected in said
        assert said.count("\n") == 1
    assert not (tmp_path / "x.zarr").exists()


@pytest.mark.parametrize("kind", ["compressed", "pipe", "folder", "holes", "text", "more"])
def test_what_is_no_tar_file_of_an_episode_is_damage_and_takes_no_room(original, tmp_path, kind):
    tars = tmp_path / "tars.zarr"
    copy_store(open_store(original), tars, (), tar=True)
    tar = tars / "episodes/task000_episode000.tar"
    whole = tar.read_bytes()
    tar.unlink()
    match kind:
        case "compressed":
            tar.write_bytes(lzma.compress(whole))
        case "pipe":
            os.mkfifo(tar)
        case "folder":
            tar.mkdir()
        case "text":
            tar.write_text("text")
        case "more":  # a file that the seal does not list
            tar.write_bytes(whole)
            with tarfile.open(tar, "a") as file:
                file.addfile(tarfile.TarInfo("task000_episode000/joint/notes"))
        case "holes":
            headers = {"GNU.sparse.major": "1", "GNU.sparse.minor": "0", "GNU.sparse.realsize": str(10**15)}
            hole = tarfile.TarInfo("task000_episode000/hole")
            hole.pax_headers, hole.size = headers, 512
            with tarfile.open(tar, "w", format=tarfile.PAX_FORMAT) as file:
                file.addfile(hole, io.BytesIO(b"1\n0\n1\n".ljust(512, b"\0")))
    with pytest.raises(CorruptEpisode, match="task000_episode000"):
        copy_store(open_source(tars), tmp_path / "back.zarr", ())


def test_tar_files_are_the_store_again_and_a_copy_of_them_goes_on(original, tmp_path, capsys):
    tars, back = tmp_path / "tars.zarr", tmp_path / "back.zarr"
    copy_store(open_store(original), tars, (), tar=True)
    names = {path.relative_to(tars).as_posix() for path in tars.rglob("*") if path.is_file()}
    assert names == {"zarr.json", "episodes/zarr.json", *(f"episodes/task000_episode00{i}.tar" for i in (0, 1))}
    whole = all_bytes(tars)
    (tars / "episodes/task000_episode001.tar").unlink()
    assert copy_store(open_store(original), tars, (), tar=True).added == 1
    assert all_bytes(tars) == whole
    assert analyze(["store", "copy", str(tars), str(back)]) == 0
    assert {**all_bytes(back), NAMES_FILE: b""} == {**all_bytes(original), NAMES_FILE: b""}
    assert copy_store(open_source(tars), back, ()).present == 2
    capsys.readouterr()
    for words, named in (
        (["analyze", str(tars)], "vla-attention store copy"),
        (["store", "copy", str(original), str(tars)], str(tars)),
        (["store", "copy", str(original), str(back), "--tar"], str(back)),
    ):
        assert analyze(words) == 2
        assert named in capsys.readouterr().err


@pytest.mark.parametrize(
    "change", [lambda tar: tar[:700], lambda tar: tar.replace(b"joint", b"paint"), lambda tar: b""]
)
def test_a_damaged_tar_file_is_refused(original, tmp_path, change):
    tars = tmp_path / "tars.zarr"
    copy_store(open_store(original), tars, (), tar=True)
    first = tars / "episodes/task000_episode000.tar"
    first.write_bytes(change(first.read_bytes()))
    with pytest.raises(CorruptEpisode, match="task000_episode000"):
        copy_store(open_source(tars), tmp_path / "back.zarr", ())
    assert open_store(tmp_path / "back.zarr").episodes == ()


@pytest.mark.filterwarnings("ignore:Ignored in")
@pytest.mark.parametrize("tar", [False, True])
def test_a_copy_has_nothing_but_what_the_format_names(original, tmp_path, tar):
    path = tmp_path / "a.zarr"
    shutil.copytree(original, path)
    episode = path / "episodes/task000_episode000"
    (path / "notes.txt").write_text("mine")
    (path / "episodes/a.png").write_text("mine")
    (episode / ".DS_Store").write_text("mine")
    (episode / "joint/rows/c.9").write_text("mine")
    copy_store(open_store(path), tmp_path / "b.zarr", (), tar=tar)
    copy_store(open_store(original), tmp_path / "expected.zarr", (), tar=tar)
    copied, expected = all_bytes(tmp_path / "b.zarr"), all_bytes(tmp_path / "expected.zarr")
    assert set(copied) == set(expected)
    assert not any(content == b"mine" for content in copied.values())
    if not tar:
        assert verify_store(open_store(tmp_path / "b.zarr")) == []
