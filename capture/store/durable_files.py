"""Files that survive a crash: flushing to disk, and failures in one sentence."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from vla_attention.schemas.errors import UserError
from vla_attention.schemas.stores.store_format import StoreError


class StoreWriteFailed(StoreError, OSError):
    """The operating system refused a write: the disk is full, a permission is missing, a device failed."""


@contextmanager
def naming_the_failure(what: str) -> Iterator[None]:
    """Turn an error of the operating system into one sentence with what was being written."""
    try:
        yield
    except OSError as error:
        if isinstance(error, UserError):
            raise
        raise StoreWriteFailed(
            f"Cannot write {what}: {error.strerror or error}. Nothing of this episode was kept, and the episodes "
            "before it are unharmed; remove the cause and go on with --resume."
        ) from error


def publish(folder: Path, target: Path, durable: bool) -> None:
    """Rename a complete folder to `target`.

    `durable`: flush the content to disk before the rename and the new name after it, so that a crash of the machine
    leaves all of it or nothing. Otherwise only a crash of the process does.
    """
    if durable:
        # The rename must not reach the disk before the content.
        for parent, _, files in os.walk(folder):
            for file in files:
                _flush(Path(parent) / file)
            _flush(Path(parent))
    folder.rename(target)
    if durable:
        _flush(target.parent)


def _flush(path: Path) -> None:
    """Force one file or directory to disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    except OSError as error:
        # Some network file systems cannot flush directories, and have no other way to do it.
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):
            raise
    finally:
        os.close(handle)
