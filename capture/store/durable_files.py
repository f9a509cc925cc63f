"""Files that survive a crash: partial folders beside a store, flushing to disk, and failures in one sentence."""

from __future__ import annotations

import errno
import os
import shutil
import socket
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from vla_attention.schemas.errors import UserError
from vla_attention.schemas.stores.store_format import PARTIAL_SUFFIX, StoreError


class StoreWriteFailed(StoreError, OSError):
    """The operating system refused a write: the disk is full, a permission is missing, a device failed."""


def partial_folder(store: Path) -> Path:
    """The folder for what is being written: beside the store, on the same file system, and not in it."""
    return store.with_name(store.name + PARTIAL_SUFFIX)


def process_tag() -> str:
    """A name that no other process uses; it has the host and the process number, see `remove_dead_partials`."""
    return f"{socket.gethostname()}-{os.getpid()}-{uuid.uuid4().hex[:8]}"


def remove_dead_partials(store: Path) -> None:
    """Remove what killed processes of this machine left beside the store.

    Those of other machines cannot be checked here.
    """
    partial = partial_folder(store)
    for folder in partial.glob("*"):
        host, _, process = folder.name.partition("-")[2].rpartition("-")[0].rpartition("-")
        if host == socket.gethostname() and process.isdigit() and not _is_running(int(process)):
            shutil.rmtree(folder, ignore_errors=True)
    remove_if_empty(partial)


def _is_running(process: int) -> bool:
    try:
        os.kill(process, 0)  # signal 0 only checks that the process exists
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


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


def make_partial(folder: Path) -> None:
    """Create a folder for what is being written; another process may be removing the (empty) parent at this moment."""
    while True:
        folder.parent.mkdir(exist_ok=True)
        try:
            folder.mkdir()
        except FileNotFoundError:
            continue
        return


def remove_if_empty(folder: Path) -> None:
    """Remove a folder if it is empty."""
    try:
        folder.rmdir()
    except OSError:
        return  # another writer's episode is in it, or another process has removed it


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
