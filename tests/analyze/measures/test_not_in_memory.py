"""Arrays on disk are those that were written, and their file takes no room when nobody has them any more."""

from __future__ import annotations

import os
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from vla_attention.analyze.measures.not_in_memory import MadeWhenAsked, OnDisk
from vla_attention.schemas.errors import BadArgument


def test_arrays_are_read_as_they_were_written_in_any_order_and_by_threads():
    rng = np.random.default_rng(0)
    given = [{"mass": rng.random((i % 3, 4)), "keys": np.arange(i), "valid": np.array([True, i > 3])} for i in range(9)]
    kept = OnDisk(iter(given))
    assert len(kept) == 9
    with ThreadPoolExecutor(4) as threads:
        found = list(threads.map(kept.__getitem__, [*reversed(range(9))] * 5))
    for i, arrays in zip([*reversed(range(9))] * 5, found, strict=True):
        assert arrays.keys() == given[i].keys()
        for name, array in given[i].items():
            assert arrays[name].dtype == array.dtype
            np.testing.assert_array_equal(arrays[name], array)


def test_no_file_is_left_behind(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    kept = OnDisk([{"a": np.zeros(1000)}])
    assert list(tmp_path.iterdir()) == []
    number = kept._file.fileno()
    del kept
    with pytest.raises(OSError, match="Bad file descriptor"):
        os.fstat(number)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs Linux's device without room")
def test_a_full_disk_is_one_sentence(monkeypatch):
    monkeypatch.setattr(tempfile, "TemporaryFile", lambda buffering: open("/dev/full", "wb", buffering=0))  # noqa: SIM115
    with pytest.raises(BadArgument, match=r"No space left on device; set TMPDIR to a folder with room"):
        OnDisk([{"a": np.zeros(1000)}])


def test_members_are_made_at_every_access():
    made = []

    def make(i: int) -> str:
        made.append(i)
        return f"number {i}"

    names = MadeWhenAsked(make, [3, 1, 2])
    assert (len(names), made) == (3, [])
    assert [*names] == ["number 3", "number 1", "number 2"]
    assert names[-1] == names[2] == "number 2"
    assert [*names[1:]] == ["number 1", "number 2"]
    assert made == [3, 1, 2, 2, 2, 1, 2]
    with pytest.raises(IndexError):
        names[3]
