"""Files from elsewhere: regular ones only, and JSON of limited size, nesting and numbers.

A pipe would wait for ever, a device gives bytes without end, and a link may lead out of its folder.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Callable
from pathlib import Path
from typing import Any

from vla_attention.schemas.errors import UserError
from vla_attention.schemas.jsonable import decode_json

#: What makes an error of a sentence: mostly a class of errors.
Refuse = Callable[[str], UserError]

#: Files and folders below one folder of a checkpoint. Those of openpi have some hundreds.
MAX_FILES = 100_000

#: The folder of the hub's cache whose files are links to `blobs` beside it.
_SNAPSHOTS = "snapshots"


def check_regular(path: Path, refuse: Refuse, *, inside: Path | None = None) -> int:
    """Return the size in bytes of a regular file.

    inside: the folder that a link may not leave; None for a file that the user named. Links of the hub's cache lead
    from a snapshot to the blobs of the same repository.

    Raises:
        FileNotFoundError: there is nothing, or a link to nothing.
        What `refuse` makes: the path is no regular file, or a link that leads out of the folder.
    """
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            raise refuse(f"'{path}' cannot be read: it is no regular file.")
        if inside is not None:
            _check_inside(path, inside, refuse)
    except FileNotFoundError:
        raise
    except (OSError, RuntimeError) as error:  # a circle of links is a RuntimeError of pathlib
        if isinstance(error, UserError):
            raise
        raise refuse(f"'{path}' cannot be read ({getattr(error, 'strerror', None) or error}).") from error
    return status.st_size


def _check_inside(path: Path, folder: Path, refuse: Refuse) -> None:
    real, home = path.resolve(), folder.resolve()
    if real.is_relative_to(home):
        return
    repository = next((part.parent for part in home.parents if part.name == _SNAPSHOTS), None)
    if repository is None or not real.is_relative_to(repository / "blobs"):
        raise refuse(
            f"'{path}' is a link that leads out of its folder, to '{real}'; put a copy of the file in its place."
        )


def check_folder(folder: Path, refuse: Refuse, *, inside: bool = True) -> None:
    """Check every file below a folder, for a library that opens them by itself; see `check_regular`.

    inside: whether links have to stay in it. Where they need not, one may lead to a folder, which is not searched.
    """
    waiting, seen = [folder], 0
    while waiting:
        here = waiting.pop()
        try:
            entries = list(os.scandir(here))
        except OSError as error:
            raise refuse(f"'{here}' cannot be read ({error.strerror or error}).") from error
        seen += len(entries)
        if seen > MAX_FILES:
            raise refuse(f"'{folder}' holds more than {MAX_FILES} files; expected some hundreds.")
        for entry in entries:
            if entry.is_dir(follow_symlinks=not inside):
                if not entry.is_symlink():
                    waiting.append(Path(entry.path))
                continue
            try:
                check_regular(Path(entry.path), refuse, inside=folder if inside else None)
            except FileNotFoundError as error:
                if isinstance(error, UserError):
                    raise
                raise refuse(f"'{entry.path}' is a link to a file that does not exist.") from None


#: Bytes of a JSON file. The largest of a real checkpoint, statistics and trees of arrays, have 0.2 MB; decoded, empty
#: lists take 25 times as much memory.
MAX_JSON_BYTES = 8_000_000


def read_object(path: Path, refuse: Refuse, *, inside: Path | None = None) -> dict[str, Any]:
    """Read a JSON file that holds an object. inside: see `check_regular`.

    Raises:
        FileNotFoundError: there is no such file.
        What `refuse` makes: it is no regular file, too large, no JSON, too deep, or holds something else.
    """
    if (size := check_regular(path, refuse, inside=inside)) > MAX_JSON_BYTES:
        raise refuse(f"'{path}' has {size:,} bytes; expected at most {MAX_JSON_BYTES:,}.")
    try:
        content = decode_json(path.read_bytes())
    except (ValueError, OSError) as error:
        raise refuse(f"'{path}' is not valid JSON ({error}).") from error
    if not isinstance(content, dict):
        raise refuse(f"'{path}' should hold a JSON object, but holds a {type(content).__name__}.")
    return content
