"""Functions in processes that are there at once: forks of a process that has imported everything and has no threads.

Importing torch takes seconds, and a capture that is killed two hundred times would spend its time on that. The process
that forks must not have used zarr, polars or a simulator yet: their threads do not survive a fork.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import signal
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

Answer = TypeVar("Answer")


def start(function: Callable[..., int | None], *arguments: Any, log: Path) -> int:
    """Start a function in a process of its own, with its output in a file; returns the process's number.

    The exit code is what the function returns; 1 after an exception, whose traceback is in the file.
    """
    process = os.fork()
    if process:
        return process
    code = 1
    try:
        output = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        for stream in (1, 2):
            os.dup2(output, stream)
        # Python ignores it where the parent does; a child of a shell's background job would ignore Ctrl-C.
        signal.signal(signal.SIGINT, signal.default_int_handler)
        code = function(*arguments) or 0
    except BaseException:
        traceback.print_exc()
    finally:
        with contextlib.suppress(Exception):
            import sys

            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(code)


def wait(process: int, seconds: float = 300) -> int:
    """Wait for the end of a process; returns its exit code, negative for a signal. One that hangs is an error."""
    until = time.monotonic() + seconds
    while True:
        found, status = os.waitpid(process, os.WNOHANG)
        if found:
            return os.waitstatus_to_exitcode(status)
        if time.monotonic() > until:
            os.kill(process, signal.SIGKILL)
            os.waitpid(process, 0)
            raise AssertionError(f"process {process} hung for {seconds} seconds")
        time.sleep(0.005)


def ended(process: int) -> bool:
    """Whether a child has ended; it stays to be waited for."""
    return os.waitid(os.P_PID, process, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None


def answer_of(function: Callable[..., Answer], *arguments: Any) -> Answer:
    """What a function gives, called in a process of its own, so that its threads are not in this one.

    Raises:
        AssertionError: the function raised; with its traceback.
    """
    reading, writing = os.pipe()
    process = os.fork()
    if not process:
        with os.fdopen(writing, "wb") as pipe:
            try:
                pipe.write(pickle.dumps((True, function(*arguments))))
            except BaseException:
                pipe.write(pickle.dumps((False, traceback.format_exc())))
        os._exit(0)
    os.close(writing)
    with os.fdopen(reading, "rb") as pipe:
        content = pipe.read()
    os.waitpid(process, 0)
    fine, found = pickle.loads(content) if content else (False, "the process died")
    if not fine:
        raise AssertionError(found)
    answer: Answer = found
    return answer
