"""Being told to stop: SIGTERM, which batch systems send before they kill (time limit, preemption, `scancel`).

Between episodes, while a model loads for instance, there is nothing to lose and the process stops at once. Inside an episode
it stops at the next environment step, so that nothing is written to the episode's folder while that is removed; an episode that is
just being committed is committed. A second signal stops at once wherever the process is.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

#: Exit code after SIGTERM: sysexits.h's EX_TEMPFAIL, "try again later". Nothing else of this program ends with it.
EXIT_TERMINATED = 75


class Terminated(BaseException):
    """The process was told to stop. Like KeyboardInterrupt, no handler of ordinary errors swallows it."""


class Termination:
    """Remembers a SIGTERM. `begin` and `end` enclose what must not be interrupted just anywhere."""

    def __init__(self) -> None:
        self.requested = False
        self._guarded = 0

    def on_signal(self, _number: int, _frame: FrameType | None) -> None:
        """Handle the signal."""
        again, self.requested = self.requested, True
        if again or not self._guarded:
            raise Terminated

    def check(self) -> None:
        """Raise `Terminated` when the process has been told to stop."""
        if self.requested:
            raise Terminated

    @contextmanager
    def only_at_checks(self) -> Iterator[None]:
        """Within this block the first signal takes effect at the next `check`, and at the latest when the block ends."""
        self._guarded += 1
        try:
            yield
        finally:
            self._guarded -= 1
        self.check()


@contextmanager
def listening_for_sigterm() -> Iterator[Termination]:
    """Handle SIGTERM within the block; outside of the main thread signals cannot be handled, and nothing changes."""
    termination = Termination()
    if threading.current_thread() is not threading.main_thread():
        yield termination
        return
    before = signal.signal(signal.SIGTERM, termination.on_signal)
    try:
        yield termination
    finally:
        signal.signal(signal.SIGTERM, before)
