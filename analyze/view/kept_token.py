"""The secret part of the viewer's link, kept for the next start with the same stores on the same port.

Who reads the file can read the stores while the viewer runs, so that only the user's own private files are believed,
and only such are written.
"""

from __future__ import annotations

import hashlib
import os
import re
import secrets
import stat
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from vla_attention.schemas.stores.store_url import StorePlace
from vla_attention.schemas.user_cache import user_cache

FOLDER = "links"
_BYTES = 24
_TOKEN = re.compile(rb"[A-Za-z0-9_-]{32}")
_OTHERS = stat.S_IRWXG | stat.S_IRWXO
#: Without --port each start has another port, and a file more: those that were used last stay.
_MOST_KEPT = 200


def new_token() -> str:
    """A token that nobody guesses."""
    return secrets.token_urlsafe(_BYTES)


def kept_token(places: Sequence[StorePlace], port: int) -> str | None:
    """The token that these stores had on this port before, or a new one that they will have; None: none can be kept."""
    try:
        folder = user_cache(FOLDER)
        _make_private(folder)
        path = folder / _name(places, port)
        token = _private_token(path)
        if token is None:
            token = new_token()
            _write(path, token)
        os.utime(path)
        _prune(folder)
    except (OSError, RuntimeError):  # no home, no right, a folder that others can write into
        return None
    return token


def _name(places: Sequence[StorePlace], port: int) -> str:
    """The links of a page name its stores by their numbers: another order is another page."""
    stores = [os.fspath(place.resolve()) if isinstance(place, Path) else str(place) for place in places]
    return hashlib.sha256("\n".join([str(port), *stores]).encode("utf-8", "surrogateescape")).hexdigest()


def _make_private(folder: Path) -> None:
    """Make the folder for this user alone; raises `OSError` where what is there is not theirs alone to write."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    with suppress(FileExistsError):
        folder.mkdir(mode=0o700)
    status = folder.lstat()
    by_others = status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
    if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.geteuid() or by_others:
        raise PermissionError(f"{folder} can be written by others")


def _private_token(path: Path) -> str | None:
    """What a file says that is this user's own, and that nobody else can read; None: there is no such file."""
    try:
        handle = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    except OSError:
        return None
    with open(handle, "rb") as file:
        status = os.fstat(handle)
        if not stat.S_ISREG(status.st_mode) or status.st_uid != os.geteuid() or status.st_mode & _OTHERS:
            return None
        content = file.read()
    return content.decode() if _TOKEN.fullmatch(content) else None


def _write(path: Path, token: str) -> None:
    """Put a private file into place at once; a file of others, or a link, is replaced."""
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=".new-")  # mode 0600
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(token.encode())
        os.replace(name, path)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise


def _prune(folder: Path) -> None:
    """Remove the files that were not used for longest."""
    with os.scandir(folder) as entries:
        files = [(entry.stat(follow_symlinks=False).st_mtime_ns, entry.name) for entry in entries]
    for _, name in sorted(files)[:-_MOST_KEPT]:
        with suppress(OSError):
            (folder / name).unlink()
