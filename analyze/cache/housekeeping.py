"""Room in the cache: files that were not used for longest are removed first."""

from __future__ import annotations

import os
import re
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from vla_attention.analyze.cache.kept_files import ENDING, UNFINISHED
from vla_attention.analyze.cache.places import CachePlace

_QUESTION = re.compile(r"[0-9a-f]{32}")
_FILE = re.compile(rf"[0-9a-f]{{32}}({re.escape(ENDING)}|{re.escape(UNFINISHED)})")


@dataclass(frozen=True)
class KeptFile:
    """A file in the cache: bytes on disk, and when it was last used (seconds since the epoch)."""

    path: Path
    size: int
    used: float


def kept_files(folder: Path) -> list[KeptFile]:
    """The files in a cache, the one that was used last first. Files with other names are not the cache's."""
    files = []
    for question in _entries(folder):
        if not (_QUESTION.fullmatch(question.name) and question.is_dir(follow_symlinks=False)):
            continue
        for entry in _entries(Path(question.path)):
            if _FILE.fullmatch(entry.name) and entry.is_file(follow_symlinks=False):
                try:
                    status = entry.stat()
                except OSError:
                    continue  # another process removed it
                files.append(KeptFile(Path(entry.path), status.st_size, status.st_mtime))
    return sorted(files, key=lambda one: one.used, reverse=True)


def make_room(place: CachePlace) -> int:
    """Remove files, least recently used first, until the cache is within its size; returns how many bytes went."""
    files = kept_files(place.folder)
    total = sum(one.size for one in files)
    removed = 0
    while files and total - removed > place.most_bytes:
        removed += _remove(files.pop())
    return removed


def _remove(file: KeptFile) -> int:
    """Bytes that are gone: 0 for a file that belongs to somebody else."""
    try:
        file.path.unlink(missing_ok=True)
    except OSError:
        return 0
    with suppress(OSError):  # other files are in it
        file.path.parent.rmdir()
    return file.size


def _entries(folder: Path) -> list[os.DirEntry[str]]:
    try:
        return list(os.scandir(folder))
    except OSError:
        return []
