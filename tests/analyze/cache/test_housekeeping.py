"""The size of the cache: bounded, shown, removed when asked; and the commands that use it."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

import numpy as np
import pytest

from vla_attention.analyze.__main__ import main
from vla_attention.analyze.cache.housekeeping import clear, kept_files, make_room
from vla_attention.analyze.cache.kept_files import ENDING, kept_bytes, write_file
from vla_attention.analyze.cache.places import CachePlace, cache_place, parse_size
from vla_attention.schemas.errors import BadArgument
from vla_attention.testing.stores import StoreSpec, write_store


@pytest.fixture(scope="module")
def store(tmp_path_factory) -> Path:
    return write_store(tmp_path_factory.mktemp("store") / "a.zarr", spec=StoreSpec(tasks=(0, 1), episodes=2))


def kept(place: CachePlace, question: str, size: int, used: float) -> Path:
    key = hashlib.sha256(question.encode()).digest()
    path = place.folder / key.hex()[:32] / f"{key.hex()[:32]}{ENDING}"
    write_file(path, kept_bytes(key, f"about {question}", {"mass": np.zeros(size // 8)}))
    os.utime(path, (used, used))
    return path


def test_what_was_not_used_for_longest_goes_first(tmp_path):
    place = CachePlace(tmp_path / "cache", 3_000)
    paths = [kept(place, name, 1_000, used) for name, used in (("b", 20), ("a", 10), ("c", 30))]
    stranger = place.folder / "notes.txt"
    stranger.write_text("mine")
    assert make_room(place) > 1_000
    assert [path.exists() for path in paths] == [True, False, True]
    assert sum(one.size for one in kept_files(place.folder)) <= 3_000
    assert not paths[1].parent.exists()
    assert make_room(place) == 0
    assert clear(place.folder) > 2_000
    assert list(place.folder.iterdir()) == [stranger]


def test_a_question_larger_than_the_cache_stays_within_it(cache, store, tmp_path, monkeypatch):
    assert main([str(store), "--no-plots", "--output", str(tmp_path / "out")]) == 0
    all_of_it = sum(one.size for one in kept_files(cache))
    clear(cache)
    monkeypatch.setenv("VLA_CACHE_SIZE", str(all_of_it // 2))
    assert main([str(store), "--no-plots", "--output", str(tmp_path / "out")]) == 0
    assert 0 < sum(one.size for one in kept_files(cache)) <= all_of_it // 2


def test_a_smaller_size_holds_although_nothing_is_new(cache, store, tmp_path, monkeypatch):
    assert main([str(store), "--no-plots", "--output", str(tmp_path / "out")]) == 0
    before = kept_files(cache)
    assert len(before) == 4  # one for each episode
    monkeypatch.setenv("VLA_CACHE_SIZE", str(max(one.size for one in before)))
    assert main([str(store), "--no-plots", "--output", str(tmp_path / "out")]) == 0
    (left,) = kept_files(cache)
    assert left.path in {one.path for one in before}


def test_what_a_killed_process_was_writing_is_removed(cache, store, tmp_path):
    assert main([str(store), "--no-plots", "--output", str(tmp_path / "out")]) == 0
    question = kept_files(cache)[0].path.parent
    (question / f"{'a' * 32}.partial").write_bytes(b"half")
    clear(cache)
    assert not question.exists()


def test_the_command_shows_and_removes(cache, store, tmp_path, capsys):
    assert main(["cache"]) == 0
    assert "nothing is kept yet" in capsys.readouterr().out
    assert main([str(store), "--no-plots", "--output", str(tmp_path / "out")]) == 0
    assert main(["time", str(store), "--no-plots", "--output", str(tmp_path / "time"), "--layers", "2"]) == 0
    capsys.readouterr()
    assert main(["cache"]) == 0
    printed = capsys.readouterr().out
    assert f"{cache}: " in printed
    assert "of at most 2 GB; 2 questions" in printed
    assert "masses of grouping default, site joint, 2 layers" in printed
    assert "masses of grouping default, site joint, 1 layer," in printed
    assert main(["cache", "--clear"]) == 0
    assert "Removed" in capsys.readouterr().out
    assert kept_files(cache) == []


def test_nothing_is_written_without_a_cache(cache, store, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    before = os.environ["VLA_CACHE"]
    assert main([str(store), "--no-plots", "--no-cache", "--output", str(tmp_path / "out")]) == 0
    assert os.environ["VLA_CACHE"] == before
    assert not cache.exists()
    monkeypatch.setenv("VLA_CACHE", "off")
    assert main([str(store), "--no-plots", "--output", str(tmp_path / "out")]) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out"]
    capsys.readouterr()
    assert main(["cache"]) == 0
    assert "The cache is off" in capsys.readouterr().out


def test_the_cache_is_beside_the_results(tmp_path, monkeypatch):
    monkeypatch.delenv("VLA_CACHE")
    monkeypatch.chdir(tmp_path)
    assert cache_place() == CachePlace(tmp_path / "results/.cache")
    for value in ("on", "1", " "):
        monkeypatch.setenv("VLA_CACHE", value)
        assert cache_place() == CachePlace(tmp_path / "results/.cache")
    monkeypatch.setenv("VLA_CACHE", "elsewhere")
    monkeypatch.setenv("VLA_CACHE_SIZE", "1.5 GB")
    assert cache_place() == CachePlace(tmp_path / "elsewhere", 1_500_000_000)


@pytest.mark.parametrize(
    ("text", "size"), [("10", 10), ("10B", 10), ("2k", 2_000), ("1.5mb", 1_500_000), ("3TB", 3e12)]
)
def test_sizes(text, size):
    assert parse_size(text) == size


@pytest.mark.parametrize("text", ["much", "-1", "1 PB", "GB", "1,5GB", "9" * 400])
def test_what_is_no_size_is_one_sentence(text, cache, store, tmp_path, monkeypatch, capsys):
    with pytest.raises(BadArgument, match="is no size; expected"):
        parse_size(text)
    monkeypatch.setenv("VLA_CACHE_SIZE", text)
    assert main([str(store), "--no-plots", "--output", str(tmp_path / "out")]) == 2
    assert "VLA_CACHE_SIZE" in capsys.readouterr().err
