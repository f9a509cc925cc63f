"""SIGTERM, which batch systems send before they kill a process (time limit, preemption, `scancel`).

Between episodes, for example while a model loads, the process stops at once. During an episode it stops at the next
environment step, so that nothing writes to the episode's folder during its removal. A commit in progress is completed.
A second signal stops the process at once, also during an episode.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

#: Exit code after SIGTERM: EX_TEMPFAIL of sysexits.h, "try again later". The program ends with this code for no other
#: reason.
EXIT_TERMINATED = 75


class Terminated(BaseException):
    """SIGTERM came. Like KeyboardInterrupt this is no `Exception`: handlers of ordinary errors do not catch it."""


class Termination:
    """Remembers whether SIGTERM came."""

    def __init__(self) -> None:
        self.requested = False
        self._guarded = 0

    def on_signal(self, _number: int, _frame: FrameType | None) -> None:
        """Handle the signal."""
        again, self.requested = self.requested, True
        if again or not self._guarded:
            raise Terminated

    def check(self) -> None:
        """Raise `Terminated` if SIGTERM came."""
        if self.requested:
            raise Terminated

    @contextmanager
    def only_at_checks(self) -> Iterator[None]:
        """Within this block the first signal raises `Terminated` at the next `check` or at the end of the block."""
        self._guarded += 1
        try:
            yield
        finally:
            self._guarded -= 1
        self.check()


@contextmanager
def listening_for_sigterm() -> Iterator[Termination]:
    """Handle SIGTERM within the block. Python allows this in the main thread only; elsewhere nothing changes."""
    termination = Termination()
    if threading.current_thread() is not threading.main_thread():
        yield termination
        return
    before = signal.signal(signal.SIGTERM, termination.on_signal)
    try:
        yield termination
    finally:
        signal.signal(signal.SIGTERM, before)
