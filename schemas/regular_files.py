"""Opening files that somebody else may have made: regular ones only, and never more bytes than are expected.

To open a FIFO waits for ever, a device gives bytes without end, and a link may lead to any file of this machine.
"""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path

from vla_attention.schemas.limits import CLAIMED_BYTES, EXPANSION

#: Runs of bytes without a hole that are counted in a file.
_EXTENTS = 10_000
#: Without waiting for the other end of a FIFO, without becoming a terminal's process.
_FLAGS = os.O_RDONLY | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_NOCTTY", 0)
#: Flags with which a link is an error.
UNFOLLOWED = _FLAGS | getattr(os, "O_NOFOLLOW", 0)
_KINDS = {
    stat.S_IFIFO: "a FIFO",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFDIR: "a folder",
    stat.S_IFSOCK: "a socket",
    stat.S_IFLNK: "a link",
}


class NotRegular(OSError):
    """Something else than a regular file where a file is expected, or a file that is too large."""

    def __init__(self, problem: str, path: object) -> None:
        super().__init__(None, problem, str(path))


def open_regular(path: str | Path, *, follow: bool = True) -> tuple[int, int]:
    """Open a regular file for reading; returns its descriptor and its bytes. The caller closes the descriptor.

    Args:
        path: of the file.
        follow: whether the last part of the path may be a link.

    Raises:
        NotRegular: it is something else.
        OSError: it cannot be opened.
    """
    try:
        handle = os.open(path, _FLAGS if follow else UNFOLLOWED)
    except OSError as error:
        raise _not_opened(path, error, follow) from None
    try:
        status = os.fstat(handle)
        if not stat.S_ISREG(status.st_mode):
            raise not_regular(path, status.st_mode)
    except BaseException:
        os.close(handle)
        raise
    return handle, status.st_size


def not_regular(path: object, mode: int) -> NotRegular:
    """The error for a path of another kind; `mode` as in `os.stat_result`."""
    return NotRegular(f"it is {_KINDS.get(stat.S_IFMT(mode), 'something else')} and no regular file", path)


def _not_opened(path: str | Path, error: OSError, follow: bool) -> OSError:
    """The error of opening a path; a socket or a link gives an `OSError` that does not say so."""
    try:
        mode = (os.stat if follow else os.lstat)(path).st_mode
    except OSError:
        return error
    return error if stat.S_ISREG(mode) or stat.S_ISDIR(mode) else not_regular(path, mode)


def read_regular(path: str | Path, most: int, *, follow: bool = True) -> bytes:
    """All bytes of a regular file of at most `most` bytes; raises as `open_regular` does."""
    handle, size = open_regular(path, follow=follow)
    try:
        if size > most:
            raise NotRegular(f"it has {size:,} bytes; expected at most {most:,}", path)
        return read_all(handle, size)
    finally:
        os.close(handle)


def check_not_sparse(path: object, handle: int, size: int) -> None:
    """Raise `NotRegular` for an open file of which hardly any byte is stored: a kilobyte can have a terabyte of holes.

    A file system that does not know of holes has none.
    """
    stored = at = 0
    try:
        for _ in range(_EXTENTS):
            start = os.lseek(handle, at, os.SEEK_DATA)
            at = os.lseek(handle, start, os.SEEK_HOLE)
            stored += at - start
        stored += size - at
    except (AttributeError, OSError) as error:
        if getattr(error, "errno", None) != errno.ENXIO:  # no more data
            return
    finally:
        os.lseek(handle, 0, os.SEEK_SET)
    if size > max(CLAIMED_BYTES, EXPANSION * stored):
        raise NotRegular(f"it has {size:,} bytes, of which {stored:,} are stored and the others are holes", path)


def read_all(handle: int, size: int) -> bytes:
    """The bytes of an open file, at least those that it had when it was opened; more of a file that has grown."""
    content = os.read(handle, size + 1)
    if len(content) == size:
        return content
    parts = [content]
    while content and sum(map(len, parts)) <= size:
        content = os.read(handle, size + 1)
        parts.append(content)
    return b"".join(parts)
