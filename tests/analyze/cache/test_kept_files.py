"""A file of the cache gives the arrays that were written for a question and an episode, or nothing."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from vla_attention.analyze.cache.kept_files import kept_bytes, read_arrays, write_file

KEY, OTHER = b"k" * 32, b"o" * 32
ARRAYS = {
    "mass": np.random.default_rng(0).random((3, 2, 1, 4))[..., :-1],
    "nothing": np.zeros((0, 5), np.float32),
    "counts": np.arange(4),
    "odd": np.array([np.nan, np.inf, -0.0]),
    "scalar": np.float64(2.5) * np.ones(()),
    "flags": np.array([True, False]),
}


def test_arrays_come_back_as_they_were(tmp_path: Path) -> None:
    path = tmp_path / "question" / "a.masses"
    write_file(path, kept_bytes(KEY, ARRAYS))
    found = read_arrays(path, KEY)
    assert found is not None
    assert list(found) == list(ARRAYS)
    for name, array in ARRAYS.items():
        assert found[name].dtype == array.dtype
        assert found[name].shape == array.shape
        assert found[name].tobytes() == array.tobytes()
    assert [file.name for file in path.parent.iterdir()] == ["a.masses"]


def test_no_changed_or_missing_byte_gives_other_arrays(tmp_path: Path) -> None:
    path = tmp_path / "a.masses"
    whole = kept_bytes(KEY, {"mass": np.arange(6.0)})
    for position in range(len(whole)):
        for bit in (1, 0x80):
            path.write_bytes(whole[:position] + bytes([whole[position] ^ bit]) + whole[position + 1 :])
            assert read_arrays(path, KEY) is None, position
        path.write_bytes(whole[:position])
        assert read_arrays(path, KEY) is None, position


def test_files_of_other_episodes_and_questions_are_not_taken(tmp_path: Path) -> None:
    path = tmp_path / "a.masses"
    write_file(path, kept_bytes(OTHER, ARRAYS))
    assert read_arrays(path, KEY) is None
    assert read_arrays(tmp_path / "none", KEY) is None
    for content in (b"", b"\n", b"{}\n", b"[]\n", b"\xff" * 5000):
        path.write_bytes(content)
        assert read_arrays(path, KEY) is None
