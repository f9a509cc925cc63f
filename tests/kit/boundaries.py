"""A process that ends before its n-th call that changes files below a folder, whichever module makes the call.

Python reports opening, renaming, removing and making files and folders to audit hooks; `os.fsync`, which it does not
report, is replaced. What a file holds between two such calls is tried with `limit_file_sizes`.
"""

from __future__ import annotations

import os
import resource
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

_CHANGES = frozenset(
    ("os.rename", "os.mkdir", "os.remove", "os.rmdir", "os.link", "os.symlink", "os.truncate", "os.utime", "os.chmod")
)
_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND


def end_before(folder: Path, number: int) -> Callable[[], int]:
    """Let this process end, as SIGKILL ends it, before the number-th change (from 0) below a folder; -1: never.

    Returns a function that gives the number of changes so far. A hook cannot be removed: for a process of its own.
    """
    count = 0
    below, flush = str(folder), os.fsync

    def note() -> None:
        nonlocal count
        if count == number:
            os.kill(os.getpid(), signal.SIGKILL)
        count += 1

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        if event == "open":
            path, _mode, flags = arguments
            changes = flags & _WRITING and isinstance(path, (str, os.PathLike)) and below in os.fspath(path)
        else:
            paths = [os.fspath(one) for one in arguments[:2] if isinstance(one, (str, os.PathLike))]
            # A path may be relative to an open folder, as in shutil.rmtree.
            changes = event in _CHANGES and any(below in path or "/" not in path for path in paths)
        if changes:
            note()

    def noted_flush(handle: int) -> None:
        note()
        flush(handle)

    sys.addaudithook(hook)
    os.fsync = noted_flush  # type: ignore[assignment]
    return lambda: count


def limit_file_sizes(most: int, *, kill: bool) -> None:
    """Let no file of this process grow beyond so many bytes: a write up to there succeeds in part, the next one fails.

    kill: the system then ends the process; otherwise the write raises an `OSError`, as on a full disk.
    """
    resource.setrlimit(resource.RLIMIT_FSIZE, (most, most))
    signal.signal(signal.SIGXFSZ, signal.SIG_DFL if kill else signal.SIG_IGN)
