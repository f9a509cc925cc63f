"""Files from elsewhere are read in a process with limits: whatever a file makes a library do, it ends there.

A few hundred bytes of a table, a video or a pickle can ask for gigabytes or hours. No check of ours foresees all of
that, and a limit of the system needs none: memory, time of the processor, and time in all.
"""

from __future__ import annotations

import os
import pickle
import resource
import signal
import subprocess
import sys
import threading
import traceback
import weakref
from collections.abc import Callable
from multiprocessing.connection import Connection, Pipe
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

from vla_attention.schemas.checked_files import Refuse
from vla_attention.schemas.errors import UserError

Given = ParamSpec("Given")
Result = TypeVar("Result")

#: Bytes of memory beyond what the libraries take, and the file itself, which some of them map. A table of 500 MB of
#: pictures takes two copies of itself.
MOST_BYTES = 4_000_000_000
#: Seconds of the processor for one call. A million episodes are read in 5.
PROCESSOR_SECONDS = 60
#: Seconds for one call in all: a file server that hangs gives no work to the processor.
SECONDS = 600
#: Polars and torch would start a thread, with memory of its own, for every processor.
_ONE_THREAD = {"POLARS_MAX_THREADS": "1", "OMP_NUM_THREADS": "1"}


class BoundedProcess:
    """A process that calls functions for this one. It starts at the first call, and again after it was ended.

    It is a new interpreter with the search path of this one, and imports what the functions need: they, what they are
    given and what they return are pickled. What they keep (an open table) is there at the next call. It ends with this
    object, or with this process, however that ends.

    Args:
        refuse: makes the error for a file that takes more than the limits allow.
        most_bytes: of memory that it may take beyond its libraries; a limit that only Linux knows.
        processor_seconds: of the processor, for one call.
        seconds: in all, for one call.
    """

    def __init__(
        self,
        refuse: Refuse,
        *,
        most_bytes: int = MOST_BYTES,
        processor_seconds: int = PROCESSOR_SECONDS,
        seconds: float = SECONDS,
    ) -> None:
        self._refuse = refuse
        self._most_bytes, self._processor_seconds, self._seconds = most_bytes, processor_seconds, seconds
        self._one_at_a_time = threading.Lock()
        self._owner = 0
        self._end: weakref.finalize[Any, Any] | None = None

    def call(self, path: Path, function: Callable[Given, Result], *given: Given.args, **named: Given.kwargs) -> Result:
        """Return what a function of a module returns. path: the file that it reads, for the sentence of an error.

        Raises:
            What `refuse` makes: the process took more than it may, or was ended by the file.
            UserError: the function raised it.
        """
        with self._one_at_a_time:
            while True:
                is_new = self._start()
                try:
                    value, error, ended = self._answer(path, function, given, named)
                except BaseException:  # Ctrl-C: the answer that still comes is not that of the next call
                    self.close()
                    raise
                if not ended:
                    break
                self.close()
                if is_new:  # else what was read before may have left too little memory
                    raise self._refuse(
                        f"'{path}' cannot be read with {self._most_bytes / 1e9:.3g} GB of memory and "
                        f"{self._processor_seconds} s of the processor, as files from elsewhere are: the process that "
                        f"reads it {ended}. Get the file again from its source."
                    )
        if error is not None:
            raise error
        result: Result = value
        return result

    def close(self) -> None:
        """End the process."""
        if self._end is not None:
            self._end()
            self._end = None

    def _start(self) -> bool:
        """Start the process unless it runs; a fork of this process starts its own. Returns whether it is new."""
        if self._end is not None and self._owner == os.getpid():
            return False
        self._connection, theirs = Pipe()
        limits = f"{theirs.fileno()}, {self._most_bytes}, {self._processor_seconds}"
        code = f"import sys; sys.path[:] = {[*map(str, sys.path)]!r}; from {__name__} import serve; serve({limits})"
        with theirs:
            # Not by multiprocessing, which runs the user's script again. What libraries print is not for the terminal.
            self._process = subprocess.Popen(
                [sys.executable, "-c", code],
                pass_fds=[theirs.fileno()],
                env=os.environ | _ONE_THREAD,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            )
        self._owner = os.getpid()
        self._end = weakref.finalize(self, _end, self._process, self._connection, self._owner)
        return True

    def _answer(
        self, path: Path, function: Callable[..., Any], given: Any, named: Any
    ) -> tuple[Any, BaseException | None, str]:
        """What a call returned or raised; or how the process ended."""
        try:
            self._connection.send((path, function, given, named))
            if not self._connection.poll(self._seconds):
                return None, None, f"gave no answer for {self._seconds:g} s"
            value, error = self._connection.recv()
        except (EOFError, OSError):
            code = self._process.wait()
            return None, None, f"was ended by {signal.Signals(-code).name}" if code < 0 else f"ended with code {code}"
        return value, error, "asked for more memory" if isinstance(error, MemoryError) else ""


def _end(process: subprocess.Popen[bytes], connection: Connection, owner: int) -> None:
    connection.close()
    if os.getpid() == owner:
        process.kill()
        process.wait()


def serve(handle: int, most_bytes: int, processor_seconds: int) -> None:
    """What the process does: answer calls until the other end is closed."""
    for number in (signal.SIGINT, signal.SIGTERM):  # for the other process, which may still want an answer
        signal.signal(number, signal.SIG_IGN)
    _limit(resource.RLIMIT_CORE, 0)
    libraries = largest = 0
    with Connection(handle) as connection:
        while True:
            try:
                asked = connection.recv_bytes()
            except (EOFError, OSError):
                return
            try:
                # This imports the function's module.
                path, function, given, named = pickle.loads(asked)  # noqa: S301 - of the process that started this one
                libraries, largest = libraries or _address_space(), max(largest, _stored_bytes(path))
                # Two files may be open at once.
                _limit(resource.RLIMIT_AS, libraries + most_bytes + 2 * largest)
                used = resource.getrusage(resource.RUSAGE_SELF)
                _limit(resource.RLIMIT_CPU, int(used.ru_utime + used.ru_stime) + 1 + processor_seconds)
                answer: tuple[Any, BaseException | None] = function(*given, **named), None
            except (UserError, MemoryError) as error:
                answer = None, error
            except Exception:  # a defect, with its traceback; a panic of a library in Rust ends the process
                answer = None, RuntimeError(traceback.format_exc())
            try:
                connection.send(answer)
            except ConnectionError:
                return
            except MemoryError as error:
                connection.send((None, error))


def _address_space() -> int:
    """Bytes of addresses of this process; 2^62 where the system does not say it, and has no such limit."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    except OSError:
        return 2**62


def _stored_bytes(path: Path) -> int:
    """Bytes that a file takes on its disk: without its holes. 0 for none."""
    try:
        return path.stat().st_blocks * 512
    except OSError:
        return 0


def _limit(kind: int, most: int) -> None:
    _, hard = resource.getrlimit(kind)
    resource.setrlimit(kind, (most if hard == resource.RLIM_INFINITY else min(most, hard), hard))
