"""What the cache holds, and room for more: segments that were not used for longest are removed first."""

from __future__ import annotations

import os
import re
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from vla_attention.analyze.cache.places import CachePlace
from vla_attention.analyze.cache.segments import ENDING, segment_about

_QUESTION = re.compile(r"[0-9a-f]{32}")
_SEGMENT = re.compile(rf"[0-9a-f]{{16}}{re.escape(ENDING)}")


@dataclass(frozen=True)
class KeptSegment:
    """A segment in the cache: bytes on disk, and when it was last used (seconds since the epoch)."""

    path: Path
    size: int
    used: float

    @property
    def about(self) -> str:
        """Its question in words."""
        return segment_about(self.path) or "not readable"


def kept_segments(folder: Path) -> list[KeptSegment]:
    """The segments in a cache, the one that was used last first. Files with other names are not the cache's."""
    found = []
    for question in _entries(folder):
        if not (_QUESTION.fullmatch(question.name) and question.is_dir(follow_symlinks=False)):
            continue
        for entry in _entries(Path(question.path)):
            if _SEGMENT.fullmatch(entry.name) and entry.is_file(follow_symlinks=False):
                try:
                    status = entry.stat()
                except OSError:
                    continue  # another process removed it
                found.append(KeptSegment(Path(entry.path), status.st_size, status.st_mtime))
    return sorted(found, key=lambda one: one.used, reverse=True)


def make_room(place: CachePlace) -> int:
    """Remove segments, least recently used first, until the cache is within its size; returns how many bytes went."""
    segments = kept_segments(place.folder)
    total = sum(one.size for one in segments)
    removed = 0
    while segments and total - removed > place.most_bytes:
        removed += _remove(segments.pop())
    return removed


def clear(folder: Path) -> int:
    """Remove every segment, and the folders that are empty then; returns how many bytes were removed."""
    return sum(_remove(segment) for segment in kept_segments(folder))


def _remove(segment: KeptSegment) -> int:
    """Bytes that are gone: 0 for a segment that belongs to somebody else."""
    try:
        segment.path.unlink(missing_ok=True)
    except OSError:
        return 0
    with suppress(OSError):  # other segments are in it
        segment.path.parent.rmdir()
    return segment.size


def _entries(folder: Path) -> list[os.DirEntry[str]]:
    try:
        return list(os.scandir(folder))
    except OSError:
        return []
