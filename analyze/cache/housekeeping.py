"""What the cache holds, and room for more: files that were not used for longest are removed first."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from vla_attention.analyze.cache.kept_files import ENDING, UNFINISHED, question_of
from vla_attention.analyze.cache.places import CachePlace
from vla_attention.analyze.show.numbers import format_bytes, plural
from vla_attention.analyze.show.tables import Table, texts
from vla_attention.schemas.safe_text import visible

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


def clear(folder: Path) -> int:
    """Remove every file, and the folders that are empty then; returns how many bytes were removed."""
    return sum(_remove(file) for file in kept_files(folder))


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


def describe_cache(place: CachePlace, files: Sequence[KeptFile]) -> str:
    """Folder and size, then a line for every question: its size, when it was last used, what it is."""
    total = sum(one.size for one in files)
    head = f"{place.folder}: {format_bytes(total)} of at most {format_bytes(place.most_bytes)}"
    if not files:
        return f"{head}; nothing is kept yet."
    questions: dict[Path, list[KeptFile]] = {}
    for one in files:
        questions.setdefault(one.path.parent, []).append(one)
    columns = [
        texts("kept", lambda kept: visible(question_of(kept[0].path) or "not readable"), left=True),
        texts("size", lambda kept: format_bytes(sum(one.size for one in kept))),
        texts("last used", lambda kept: f"{datetime.fromtimestamp(max(one.used for one in kept)):%Y-%m-%d %H:%M}"),
    ]
    return f"{head}; {plural(len(questions), 'question')}\n{Table(columns, list(questions.values()))}"
