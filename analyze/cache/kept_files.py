"""Files of the cache: one for each episode of a question.

A file is the sha256 of its key and its content, then the content: names, types, shapes and numbers of the arrays. It is
renamed into place when it is whole, so that any number of processes may fill one cache. One that is cut off, damaged or
of another question or episode is as if it were not there.
"""

from __future__ import annotations

import hashlib
import os
import re
import secrets
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

Arrays = dict[str, NDArray[Any]]

ENDING = ".masses"
#: Of a file that is being written, or was when its process ended.
UNFINISHED = ".partial"
_DIGEST_BYTES = 32
_QUESTION = re.compile(r"[0-9a-f]{32}")
_FILE = re.compile(rf"[0-9a-f]{{32}}({re.escape(ENDING)}|{re.escape(UNFINISHED)})")


def kept_bytes(key: bytes, arrays: Arrays) -> bytes:
    """Return the content of a file. key: digest of question and episode."""
    parts = [(name, array.dtype.str, array.shape, array.tobytes()) for name, array in arrays.items()]
    content = msgspec.msgpack.encode(parts)
    return hashlib.sha256(key + content).digest() + content


def write_file(path: Path, content: bytes) -> None:
    """Write a file whole or not at all; raises `OSError` when it cannot be written."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f"{secrets.token_hex(16)}{UNFINISHED}")
    try:
        partial.write_bytes(content)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def read_arrays(path: Path, key: bytes) -> Arrays | None:
    """Return the arrays of a file, read-only, and note that it was used; None unless it is whole and has this key."""
    try:
        whole = path.read_bytes()
    except OSError:
        return None
    digest, content = whole[:_DIGEST_BYTES], whole[_DIGEST_BYTES:]
    if hashlib.sha256(key + content).digest() != digest:
        return None
    with suppress(OSError):  # of somebody else, or removed by another process: it was read
        os.utime(path)
    return {name: np.ndarray(shape, kind, numbers) for name, kind, shape, numbers in msgspec.msgpack.decode(content)}


def kept_files(folder: Path) -> list[tuple[float, int, Path]]:
    """When each file of a cache was last used, its bytes and its path; files with other names are not the cache's."""
    files = []
    for question in entries(folder):
        if _QUESTION.fullmatch(question.name) and question.is_dir(follow_symlinks=False):
            for entry in entries(Path(question.path)):
                if _FILE.fullmatch(entry.name) and entry.is_file(follow_symlinks=False):
                    with suppress(OSError):  # another process removed it
                        status = entry.stat()
                        files.append((status.st_mtime, status.st_size, Path(entry.path)))
    return files


def make_room(folder: Path, most_bytes: int) -> None:
    """Remove files, least recently used first, until the cache is within its size."""
    files = sorted(kept_files(folder))
    total = sum(size for _, size, _ in files)
    for _, size, path in files:
        if total <= most_bytes:
            return
        with suppress(OSError):  # it belongs to somebody else; or other files are in the folder
            path.unlink(missing_ok=True)
            total -= size
            path.parent.rmdir()


def entries(folder: Path) -> list[os.DirEntry[str]]:
    """What is in a folder; nothing where it cannot be read."""
    try:
        return list(os.scandir(folder))
    except OSError:
        return []
