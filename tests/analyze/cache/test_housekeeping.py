"""The size of the cache: bounded, and what a killed process left is removed."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

import numpy as np
import pytest

from tests.kit.stores import StoreSpec, write_store
from vla_attention.analyze.__main__ import main
from vla_attention.analyze.cache.kept_files import ENDING, kept_bytes, kept_files, make_room, write_file


@pytest.fixture(scope="module")
def store(tmp_path_factory) -> Path:
    return write_store(tmp_path_factory.mktemp("store") / "a.zarr", spec=StoreSpec(tasks=(0, 1), episodes=2))


def size_of(folder: Path) -> int:
    return sum(size for _, size, _ in kept_files(folder))


def kept(folder: Path, question: str, size: int, used: float) -> Path:
    key = hashlib.sha256(question.encode()).digest()
    path = folder / key.hex()[:32] / f"{key.hex()[:32]}{ENDING}"
    write_file(path, kept_bytes(key, {"mass": np.zeros(size // 8)}))
    os.utime(path, (used, used))
    return path


def test_what_was_not_used_for_longest_goes_first(tmp_path):
    folder = tmp_path / "cache"
    paths = [kept(folder, name, 1_000, used) for name, used in (("b", 20), ("a", 10), ("c", 30))]
    stranger = folder / "notes.txt"
    stranger.write_text("mine")
    for _ in range(2):
        make_room(folder, 3_000)
        assert [path.exists() for path in paths] == [True, False, True]
    assert size_of(folder) <= 3_000
    assert not paths[1].parent.exists()
    make_room(folder, 0)
    assert list(folder.iterdir()) == [stranger]


def test_a_question_larger_than_the_cache_stays_within_it(cache, store, tmp_path, monkeypatch):
    assert main([str(store), "--no-plots", "--output", str(tmp_path / "out")]) == 0
    all_of_it = size_of(cache)
    make_room(cache, 0)
    monkeypatch.setenv("VLA_CACHE_SIZE", str(all_of_it // 2))
    assert main([str(store), "--no-plots", "--output", str(tmp_path / "out")]) == 0
    assert 0 < size_of(cache) <= all_of_it // 2


def test_what_a_killed_process_was_writing_is_removed(cache, store, tmp_path):
    assert main([str(store), "--no-plots", "--output", str(tmp_path / "out")]) == 0
    question = kept_files(cache)[0][2].parent
    (question / f"{'a' * 32}.partial").write_bytes(b"half")
    make_room(cache, 0)
    assert not question.exists()


def test_nothing_is_written_without_a_cache(cache, store, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    before = os.environ["VLA_CACHE"]
    assert main([str(store), "--no-plots", "--no-cache", "--output", str(tmp_path / "out")]) == 0
    assert os.environ["VLA_CACHE"] == before
    assert not cache.exists()
    monkeypatch.setenv("VLA_CACHE", "off")
    assert main([str(store), "--no-plots", "--output", str(tmp_path / "out")]) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out"]
