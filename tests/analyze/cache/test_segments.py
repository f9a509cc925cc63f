"""Segments give the content that was written for an episode of a question, or nothing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from vla_attention.analyze.cache.array_bytes import arrays_from_bytes, arrays_to_bytes
from vla_attention.analyze.cache.segments import SegmentWriter, find_records, question_digest, read_record

QUESTION, OTHER = question_digest("one"), question_digest("other")
KEYS = [bytes([i]) * 32 for i in range(3)]
STATE = b"s" * 32
CONTENTS = {KEYS[0]: b"first", KEYS[1]: b"", KEYS[2]: b"third record"}


def write(folder: Path, question: bytes = QUESTION) -> Path:
    writer = SegmentWriter(folder, question, "a question")
    for key, content in CONTENTS.items():
        writer.add(key, STATE, content)
    writer.close()
    assert writer.path is not None
    return writer.path


def read(folder: Path, question: bytes = QUESTION) -> dict[bytes, bytes]:
    found = {}
    for key, records in find_records(folder, question).items():
        for record in records:
            content = read_record(record, key, question)
            if content is not None and record.state == STATE:
                found[key] = content
    return found


def test_what_was_written_is_read(tmp_path):
    write(tmp_path)
    assert read(tmp_path) == CONTENTS
    assert read(tmp_path, OTHER) == {}
    assert read(tmp_path / "none") == {}


def test_no_changed_byte_gives_another_content(tmp_path):
    path = write(tmp_path)
    whole = path.read_bytes()
    lost = 0
    for position in range(len(whole)):
        for bit in (1, 0x80):
            path.write_bytes(whole[:position] + bytes([whole[position] ^ bit]) + whole[position + 1 :])
            found = read(tmp_path)
            assert found.items() <= CONTENTS.items(), position
            lost += found != CONTENTS
    assert lost > len(whole)


def test_a_segment_that_was_cut_off_keeps_its_first_records(tmp_path):
    path = write(tmp_path)
    whole = path.read_bytes()
    counts = []
    for length in range(len(whole) + 1):
        path.write_bytes(whole[:length])
        found = read(tmp_path)
        assert found.items() <= CONTENTS.items()
        counts.append(len(found))
    assert counts == sorted(counts)
    assert set(counts) == {0, 1, 2, 3}


def test_records_of_another_question_are_not_taken(tmp_path):
    """Neither a segment that was moved here, nor its records behind our own first line."""
    other = write(tmp_path / "other", OTHER)
    here = tmp_path / "here"
    path = write(here)
    ours, theirs = path.read_bytes(), other.read_bytes()
    path.write_bytes(theirs)
    assert read(here) == {}
    path.write_bytes(ours[: ours.index(b"\n") + 1] + theirs[theirs.index(b"\n") + 1 :])
    assert set(find_records(here, QUESTION)) == set(KEYS)
    assert read(here) == {}


@pytest.mark.parametrize("content", [b"", b"\n", b"{}\n", b"[]\n", b"\xff" * 5000, b'{"format": 1}\n' + b"vlaE" * 99])
def test_other_files_are_no_segments(tmp_path, content):
    (tmp_path / "0123456789abcdef.masses").write_bytes(content)
    write(tmp_path)
    assert read(tmp_path) == CONTENTS


def test_arrays_come_back_as_they_were():
    arrays = {
        "mass": np.random.default_rng(0).random((3, 2, 1, 4))[..., :-1],
        "nothing": np.zeros((0, 5), np.float32),
        "counts": np.arange(4),
        "odd": np.array([np.nan, np.inf, -0.0]),
        "scalar": np.float64(2.5) * np.ones(()),
        "flags": np.array([True, False]),
    }
    found = arrays_from_bytes(arrays_to_bytes(arrays))
    assert list(found) == list(arrays)
    for name, array in arrays.items():
        assert found[name].dtype == array.dtype
        assert found[name].shape == array.shape
        assert found[name].tobytes() == array.tobytes()
    with pytest.raises(TypeError):
        arrays_to_bytes({"text": np.array(["a"])})
    with pytest.raises(ValueError, match="another size"):
        arrays_from_bytes(arrays_to_bytes(arrays) + b"x")
