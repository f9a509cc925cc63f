"""Files from elsewhere: regular ones only, and JSON of limited size.

A pipe would wait for ever, a device gives bytes without end, and a link may lead out of its folder.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from vla_attention.schemas.errors import UserError
from vla_attention.schemas.foreign_files import read_regular
from vla_attention.schemas.jsonable import decode_json

#: What makes an error of a sentence: mostly a class of errors.
Refuse = Callable[[str], UserError]

#: Files and folders below one folder of a checkpoint. Those of openpi have some hundreds.
MAX_FILES = 100_000


def check_regular(path: Path, refuse: Refuse, *, inside: Path | None = None) -> int:
    """Return the size in bytes of a regular file.

    inside: the folder that a link may not leave; None for a file that the user named.

    Raises:
        FileNotFoundError: there is nothing, or a link to nothing.
        What `refuse` makes: the path is no regular file, or a link that leads out of the folder.
    """
    size = path.stat().st_size
    if not path.is_file():
        raise refuse(f"'{path}' cannot be read: it is no regular file.")
    if inside is not None:
        _check_inside(path, inside, refuse)
    return size


def _check_inside(path: Path, folder: Path, refuse: Refuse) -> None:
    real, home = path.resolve(), folder.resolve()
    # Links of the hub's cache lead from a snapshot to the blobs of the same repository.
    blobs = [part.parent / "blobs" for part in home.parents if part.name == "snapshots"]
    if not any(real.is_relative_to(place) for place in (home, *blobs[:1])):
        raise refuse(
            f"'{path}' is a link that leads out of its folder, to '{real}'; put a copy of the file in its place."
        )


def check_folder(folder: Path, refuse: Refuse, *, inside: bool = True) -> None:
    """Check every file below a folder, for a library that opens them by itself; see `check_regular`.

    inside: whether links have to stay in it. Where they need not, one may lead to a folder, which is not searched.
    """
    for seen, path in enumerate(folder.rglob("*")):
        if seen == MAX_FILES:
            raise refuse(f"'{folder}' holds more than {MAX_FILES} files; expected some hundreds.")
        if path.is_dir() and not (inside and path.is_symlink()):
            continue
        if not path.exists():
            raise refuse(f"'{path}' is a link to a file that does not exist.")
        check_regular(path, refuse, inside=folder if inside else None)


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
        content = decode_json(read_regular(path, MAX_JSON_BYTES))
    except (ValueError, OSError) as error:
        raise refuse(f"'{path}' is not valid JSON ({error}).") from error
    if not isinstance(content, dict):
        raise refuse(f"'{path}' should hold a JSON object, but holds a {type(content).__name__}.")
    return content
