"""Merged stores hold what the given ones hold; what differs between them is named, and nothing is left of a failure."""

from __future__ import annotations

import errno
import os
import re
import shutil
from pathlib import Path

import pytest

from tests.kit.attacks import files_of
from tests.kit.stores import StoreSpec, assert_whole, root_attributes, write_episode, write_store
from vla_attention.analyze.__main__ import main as analyze
from vla_attention.analyze.store.copying import copy_store
from vla_attention.analyze.store.merging import merge_stores
from vla_attention.capture.store.store_writer import open_run
from vla_attention.schemas.stores.reader import open_store

SPEC = StoreSpec(tasks=(0, 1), episodes=2, replans=1, layers=(0,), heads=(0,))


@pytest.fixture(scope="module")
def original(tmp_path_factory) -> Path:
    """The store that one capture would have written."""
    return write_store(tmp_path_factory.mktemp("original") / "whole.zarr", spec=SPEC)


def written_alone(path: Path, task: int) -> Path:
    store = open_run(path, root_attributes(SPEC), "new", durable=False)
    for episode in range(SPEC.episodes):
        write_episode(store, SPEC, task, episode)
    return path


@pytest.fixture
def parts(tmp_path) -> list[Path]:
    """The same episodes, captured into two stores."""
    return [written_alone(tmp_path / name, task) for task, name in enumerate(("a.zarr", "b.zarr"))]


def episode_bytes(store: Path) -> dict[str, bytes]:
    return {
        file.relative_to(store).as_posix(): file.read_bytes()
        for file in (store / "episodes").rglob("*")
        if file.is_file()
    }


def inodes(store: Path) -> set[int]:
    return {file.stat().st_ino for file in (store / "episodes").rglob("*") if file.name.startswith("c.")}


def refused(capsys, *words: object) -> str:
    assert analyze(["store", "copy", *map(str, words)]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    return said


@pytest.mark.parametrize("copy", [False, True])
def test_the_merged_store_is_the_one_that_one_capture_writes(original, parts, tmp_path, capsys, copy):
    before = [episode_bytes(part) for part in parts]
    words = ["store", "copy", *map(str, parts), "-o", str(tmp_path / "c.zarr"), *(["--copy"] if copy else [])]
    assert analyze(words) == 0
    said = capsys.readouterr().out
    assert f"c.zarr: 4 episodes (2 of {parts[0]}, 2 of {parts[1]})" in said
    assert ("shared" in said) is not copy
    assert episode_bytes(tmp_path / "c.zarr") == episode_bytes(original)
    assert [episode_bytes(part) for part in parts] == before
    shared = inodes(tmp_path / "c.zarr") & (inodes(parts[0]) | inodes(parts[1]))
    assert shared == (set() if copy else inodes(tmp_path / "c.zarr"))
    assert_whole(tmp_path / "c.zarr")
    merged = open_store(tmp_path / "c.zarr")
    assert merged.run == open_store(original).run
    assert merged.attributes.provenance["merged_from"] == "a.zarr (2 episodes), b.zarr (2 episodes)"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.zarr", "b.zarr", "c.zarr"]
    shutil.rmtree(parts[0])
    assert_whole(tmp_path / "c.zarr")


@pytest.mark.parametrize("code", [errno.EXDEV, errno.EPERM, errno.ENOSYS])
def test_files_are_copied_where_there_are_no_hard_links(original, parts, tmp_path, monkeypatch, code):
    def no_links(*_: object, **__: object) -> None:
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(os, "link", no_links)
    merged = merge_stores([open_store(part) for part in parts], tmp_path / "c.zarr")
    assert (merged.linked_bytes, merged.episodes) == (0, 4)
    assert merged.copied_bytes == sum(map(len, episode_bytes(tmp_path / "c.zarr").values())) - len(
        (tmp_path / "c.zarr/episodes/zarr.json").read_bytes()
    )
    assert episode_bytes(tmp_path / "c.zarr") == episode_bytes(original)


def test_different_runs_are_refused_field_by_field(parts, tmp_path, capsys):
    other = write_store(tmp_path / "other.zarr", spec=SPEC, tasks=(1,), seed=3, mantissa_bits=7)
    said = refused(capsys, parts[0], other, "-o", tmp_path / "c.zarr")
    assert re.search(r"protocol\.seed .*0 .*3 .*recording\.mantissa_bits", said)
    slim = tmp_path / "slim.zarr"
    copy_store(open_store(parts[1]), slim, ("objects",))
    said = refused(capsys, parts[0], slim, "-o", tmp_path / "c.zarr")
    assert "'objects'" in said
    assert not (tmp_path / "c.zarr").exists()


def test_equal_episodes_are_refused_by_name(original, parts, tmp_path, capsys):
    said = refused(capsys, parts[0], parts[1], original, "-o", tmp_path / "c.zarr")
    assert re.search(f"{parts[0]} .*{original} .*: task000_episode000, task000_episode001", said)
    assert "task000_episode000" in refused(capsys, parts[0], parts[0], "-o", tmp_path / "c.zarr")


def flipped(episode: Path) -> None:
    (file,) = files_of(episode, "joint/rows")
    content = bytearray(file.read_bytes())
    content[30] ^= 1
    file.write_bytes(content)


@pytest.mark.parametrize("copy", [False, True])
@pytest.mark.parametrize(
    ("damage", "named"),
    [
        (flipped, "joint/rows"),
        (lambda episode: (episode / "state/zarr.json").unlink(), "state/zarr.json"),
        (lambda episode: (episode / "seal/zarr.json").unlink(), "seal"),
    ],
)
def test_damage_is_named_and_nothing_is_left(parts, tmp_path, capsys, damage, named, copy):
    damage(parts[1] / "episodes/task001_episode000")
    before = sorted(path.name for path in tmp_path.iterdir())
    said = refused(capsys, *parts, "-o", tmp_path / "c.zarr", *(["--copy"] if copy else []))
    assert named in said
    assert "task001_episode000" in said
    assert sorted(path.name for path in tmp_path.iterdir()) == before
