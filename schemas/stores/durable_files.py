"""Files of a store that is written: on the disk before they have their name."""

from __future__ import annotations

import errno
import os
from pathlib import Path


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
    number = folder.stat().st_ino
    try:
        folder.rename(target)
    except OSError:
        # A file server whose answer was lost is asked again, and reports a failure after the success.
        if not target.is_dir() or target.stat().st_ino != number:
            raise
    if durable:
        _flush(target.parent)


def publish_file(file: Path, target: Path) -> None:
    """Rename a complete file to `target`, in place of one that is there; folders that `target` needs are made.

    When it returns, content and name are on the disk: what is written next may rely on them after a crash.
    """
    made = [folder for folder in target.parents if not folder.exists()]
    target.parent.mkdir(parents=True, exist_ok=True)
    _flush(file)
    file.replace(target)
    for folder in (target.parent, *(folder.parent for folder in made)):
        _flush(folder)


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
