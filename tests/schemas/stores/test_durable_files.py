"""What is renamed was flushed to the disk before, and its new name is flushed before anything else is renamed."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest

from tests.kit.durable_stores import write_store
from tests.kit.stores import StoreSpec
from vla_attention.analyze.__main__ import main as analyze

SPEC = StoreSpec(tasks=(0, 2), episodes=2, replans=2)


class Disk:
    """Notes what is flushed and renamed; `check_rename` is called with the paths of every rename."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.flushed: set[Path] = set()
        self.owed: set[Path] = set()
        self.renamed: list[str] = []
        flush = os.fsync
        for name in ("rename", "replace"):
            monkeypatch.setattr(os, name, self.noting(getattr(os, name)))

        def noted_flush(handle: int) -> None:
            flush(handle)
            place = Path(os.readlink(f"/proc/self/fd/{handle}"))
            self.flushed.add(place)
            self.owed.discard(place)

        monkeypatch.setattr(os, "fsync", noted_flush)

    def noting(self, rename: Any) -> Any:
        def noted(source: Any, target: Any, **options: Any) -> None:
            source, target = Path(source), Path(target)
            assert not self.owed, "the names of what was renamed before are not on the disk"
            assert {source, *source.rglob("*")} <= self.flushed, "what is renamed is not on the disk"
            rename(source, target, **options)
            self.owed.add(target.parent)
            self.renamed.append(target.name)

        return noted


@pytest.fixture
def store(tmp_path) -> Path:
    return write_store(tmp_path / "a.zarr", spec=SPEC)


@pytest.mark.parametrize("words", [("copy",), ("copy", "--without", "frames"), ("copy", "--tar")], ids=" ".join)
def test_copies_are_on_the_disk(store, tmp_path, monkeypatch, words):
    command, *options = words
    disk = Disk(monkeypatch)
    assert analyze(["store", command, str(store), str(tmp_path / "b.zarr"), *options]) == 0
    assert not disk.owed
    names = [name for name in disk.renamed if name.startswith("task")]
    assert len(names) == 4


def test_merged_stores_are_on_the_disk(store, tmp_path, monkeypatch):
    more = write_store(tmp_path / "more.zarr", spec=StoreSpec(tasks=(1,), episodes=1, replans=2))
    disk = Disk(monkeypatch)
    assert analyze(["store", "copy", str(store), str(more), "-o", str(tmp_path / "all.zarr"), "--copy"]) == 0
    assert (disk.renamed, disk.owed) == (["episodes.json", "all.zarr"], set())


def test_what_repair_writes_again_is_on_the_disk(store, monkeypatch):
    (store / "episodes/zarr.json").unlink()
    disk = Disk(monkeypatch)
    assert analyze(["store", "verify", str(store), "--repair", "--quick"]) == 0
    assert (disk.renamed, disk.owed) == (["zarr.json"], set())
