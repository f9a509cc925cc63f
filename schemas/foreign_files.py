"""Files that anybody may have made: regular ones only, and no more bytes than what they hold may have.

A pipe would wait for ever for somebody who writes into it, and a device gives bytes without end.
"""

from __future__ import annotations

import errno
import os
import stat
import tomllib
from pathlib import Path
from typing import Any

#: Bytes of a document (JSON, TOML) that is read. The largest of a store, the attributes of an episode whose prompt
#: changes at each of 1,000 calls, has 20 MB.
MAX_DOCUMENT_BYTES = 100_000_000
#: Of a TOML file, which a person writes, and the dots of one of its lines.
_MAX_TOML_BYTES, _MAX_DOTS = 1_000_000, 1_000


def open_regular(path: str | Path) -> int:
    """Open a file for reading, and return its descriptor; `OSError` for what is no regular file, or a link to one."""
    handle = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
    mode = os.fstat(handle).st_mode
    if stat.S_ISREG(mode):
        return handle
    os.close(handle)
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    raise OSError(errno.EINVAL, "it is no regular file", str(path))


def read_regular(path: str | Path, most: int = MAX_DOCUMENT_BYTES) -> bytes:
    """Read a regular file of at most so many bytes; `OSError` for anything else."""
    with open(open_regular(path), "rb", buffering=0) as file:
        size = os.fstat(file.fileno()).st_size
        if size > most:
            raise OSError(errno.EFBIG, f"it has {size:,} bytes; expected at most {most:,}", str(path))
        return file.readall()


def read_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file; `OSError` or `ValueError` for anything else."""
    return decode_toml(read_regular(path, _MAX_TOML_BYTES).decode())


def decode_toml(text: str) -> dict[str, Any]:
    """The table that a text in TOML holds; `ValueError` for anything else."""
    if any(line.count(".") > _MAX_DOTS for line in text.splitlines()):  # tomllib takes the square of their number
        raise ValueError(f"a line has more than {_MAX_DOTS} dots")
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise ValueError("its lists and tables are nested too deep") from None
