"""Files of the cache: segments, which only grow, and hold one record for each episode of one question.

    line 1      JSON: what the file is, the digest of its question, and the question in words
    records     header (magic, key of the episode, digest of its files, length), content, sha256

A process writes to a segment of its own, so that any number of processes may fill one cache. The sha256 is over the
question, the header and the content: a record that was cut off, damaged or moved here from another question is as if
it were not there.
"""

from __future__ import annotations

import hashlib
import json
import os
import secrets
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO

FORMAT = "vla-attention cache 1"
ENDING = ".masses"
_MAGIC = b"vlaE"
_HEADER = struct.Struct("<4s32s32sQ")
_DIGEST_BYTES = 32
#: Longer first lines and contents are damage: nothing of that size is read into memory.
_LONGEST_LINE = 65_536
_LONGEST_CONTENT = 2**33


@dataclass(frozen=True)
class Record:
    """Where the record of one episode is in a segment.

    Attributes:
        segment: the file.
        state: digest of how the episode's files were when the content was made, see `fingerprints`.
        start: position of its header.
        length: bytes of its content.
    """

    segment: Path
    state: bytes
    start: int
    length: int


def question_digest(question: str) -> bytes:
    """The digest of a question that was written as text."""
    return hashlib.sha256(question.encode()).digest()


def find_records(folder: Path, question: bytes) -> dict[bytes, list[Record]]:
    """The records of all segments of one question, by the episode's key, those of newer segments first.

    Reads headers only: whether a record is whole shows when it is read. What is no segment of the question is left out.
    """
    found: dict[bytes, list[Record]] = {}
    for path in _newest_first(folder):
        for key, record in _headers(path, question):
            found.setdefault(key, []).append(record)
    return found


def read_record(record: Record, key: bytes, question: bytes) -> bytes | None:
    """The content of a record; None when it is not the one that was written for this episode of this question."""
    try:
        with record.segment.open("rb") as file:
            file.seek(record.start)
            whole = file.read(_HEADER.size + record.length + _DIGEST_BYTES)
    except OSError:
        return None
    header, content, digest = whole[: _HEADER.size], whole[_HEADER.size : -_DIGEST_BYTES], whole[-_DIGEST_BYTES:]
    if header != _HEADER.pack(_MAGIC, key, record.state, record.length) or len(content) != record.length:
        return None
    return content if _record_digest(question, header, content) == digest else None


class SegmentWriter:
    """Appends records to a new segment of a question, which is made with the first of them."""

    def __init__(self, folder: Path, question: bytes, about: str) -> None:
        """Write into `folder`; `about` is the question in words."""
        self._folder, self._question = folder, question
        first = {"format": FORMAT, "question": question.hex(), "about": about}
        self._first_line = json.dumps(first).encode() + b"\n"
        self._file: IO[bytes] | None = None
        self.path: Path | None = None
        self.size = 0

    def size_with(self, content: bytes) -> int:
        """How many bytes the segment would have with one more record of this content."""
        return (self.size or len(self._first_line)) + _HEADER.size + len(content) + _DIGEST_BYTES

    def add(self, key: bytes, state: bytes, content: bytes) -> None:
        """Append the record of one episode; raises `OSError` when it cannot be written."""
        if self._file is None:
            self._folder.mkdir(parents=True, exist_ok=True)
            self.path = self._folder / f"{secrets.token_hex(8)}{ENDING}"
            self._file = self.path.open("xb")
            self._file.write(self._first_line)
        header = _HEADER.pack(_MAGIC, key, state, len(content))
        self._file.write(b"".join((header, content, _record_digest(self._question, header, content))))
        # What was measured is kept although the process may be ended before the last episode.
        self._file.flush()
        self.size = self.size_with(content)

    def close(self) -> None:
        """Close the segment, if there is one."""
        if self._file is not None:
            self._file.close()
            self._file = None


def segment_about(path: Path) -> str | None:
    """The question of a segment in words; None for a file that is no segment."""
    try:
        with path.open("rb") as file:
            first = _first_line(file)
    except OSError:
        return None
    about = None if first is None else first.get("about")
    return about if isinstance(about, str) else None


def touch(path: Path) -> None:
    """Note that a segment was used now: those that were not used for longest are removed first."""
    try:
        os.utime(path)
    except OSError:
        return  # of somebody else, or removed by another process: its records were read


def _newest_first(folder: Path) -> list[Path]:
    try:
        aged = [
            (entry.stat().st_mtime_ns, entry.path)
            for entry in os.scandir(folder)
            if entry.name.endswith(ENDING) and entry.is_file(follow_symlinks=False)
        ]
    except OSError:  # there is none yet, or another process removes one
        return []
    return [Path(path) for _, path in sorted(aged, reverse=True)]


def _headers(path: Path, question: bytes) -> Iterator[tuple[bytes, Record]]:
    try:
        with path.open("rb") as file:
            first = _first_line(file)
            if first is None or first.get("question") != question.hex():
                return
            size = os.fstat(file.fileno()).st_size
            start = file.tell()
            while start + _HEADER.size + _DIGEST_BYTES <= size:
                file.seek(start)
                magic, key, state, length = _HEADER.unpack(file.read(_HEADER.size))
                end = start + _HEADER.size + length + _DIGEST_BYTES
                # A record that is being written, was cut off or is damaged: where the next begins is not known.
                if magic != _MAGIC or length > _LONGEST_CONTENT or end > size:
                    return
                yield key, Record(path, state, start, length)
                start = end
    except (OSError, struct.error):
        return


def _first_line(file: IO[bytes]) -> dict[str, object] | None:
    line = file.readline(_LONGEST_LINE)
    try:
        first = json.loads(line)
    except ValueError:
        return None
    return first if isinstance(first, dict) and first.get("format") == FORMAT else None


def _record_digest(question: bytes, header: bytes, content: bytes) -> bytes:
    digest = hashlib.sha256(question)
    digest.update(header)
    digest.update(content)
    return digest.digest()
