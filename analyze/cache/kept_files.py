"""Files of the cache: one for each episode of a question.

    line 1      JSON: what the file is, its key, and name, type and shape of the arrays
    numbers     one array after the other, C order, little endian
    sha256      of all that is before it

A file is renamed into place when it is whole, so that any number of processes may fill one cache. One that is cut off,
damaged or of another question or episode is as if it were not there.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
import secrets
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Arrays = dict[str, NDArray[Any]]

FORMAT = "vla-attention cache 3"
ENDING = ".masses"
#: Of a file that is being written, or was when its process ended.
UNFINISHED = ".partial"
_DIGEST_BYTES = 32
#: Longer first lines are damage.
_LONGEST_LINE = 65_536
_TYPES = ("<f8", "<f4", "<i8", "<i4", "|u1", "|b1")
_QUESTION = re.compile(r"[0-9a-f]{32}")
_FILE = re.compile(rf"[0-9a-f]{{32}}({re.escape(ENDING)}|{re.escape(UNFINISHED)})")


def kept_bytes(key: bytes, arrays: Arrays) -> bytes:
    """Return the content of a file; raises `TypeError` for arrays of another type than `_TYPES`.

    key: digest of question and episode.
    """
    described, contents = [], []
    for name, array in arrays.items():
        kind = array.dtype.newbyteorder("<").str
        if kind not in _TYPES:
            raise TypeError(f"arrays of {array.dtype} are not kept")
        described.append([name, kind, list(array.shape)])
        contents.append(np.ascontiguousarray(array, dtype=kind).tobytes())
    line = json.dumps({"format": FORMAT, "key": key.hex(), "arrays": described}).encode()
    # Numbers begin at a multiple of 8 bytes.
    content = b"".join((line, b" " * (-(len(line) + 1) % 8), b"\n", *contents))
    return content + hashlib.sha256(content).digest()


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
    content, digest = whole[:-_DIGEST_BYTES], whole[-_DIGEST_BYTES:]
    first = _first_line(content)
    if first.get("key") != key.hex() or hashlib.sha256(content).digest() != digest:
        return None
    with suppress(OSError):  # of somebody else, or removed by another process: it was read
        os.utime(path)
    arrays: Arrays = {}
    start = content.index(b"\n") + 1
    try:
        for name, kind, shape in first["arrays"]:
            if kind not in _TYPES:
                return None
            count = math.prod(shape)
            arrays[name] = np.frombuffer(content, kind, count, start).reshape(shape)
            start += count * np.dtype(kind).itemsize
    except (KeyError, TypeError, ValueError):
        return None  # its digest is right: somebody else wrote it
    return arrays if start == len(content) else None


def _first_line(content: bytes) -> dict[str, Any]:
    """The first line, empty where it is none of a file of the cache."""
    try:
        first = json.loads(content[:_LONGEST_LINE].partition(b"\n")[0])
    except ValueError:
        return {}
    return first if isinstance(first, dict) and first.get("format") == FORMAT else {}


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
