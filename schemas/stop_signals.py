"""Ctrl-C and SIGTERM: a program that is told to stop says so in one sentence, whatever it is doing.

This module imports little, so that it works while everything else is still being imported.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from types import FrameType
from typing import Any, NoReturn

#: The exit code of a stopped program is this and the number of the signal, as shells have it.
EXIT_SIGNALLED = 128
#: How names of threads begin that a stopped program leaves alone: they may wait for a server that sends nothing.
UNAWAITED = "unawaited"
#: After so many signals the process ends at once: what it does after the first of them does not end.
_MOST_SIGNALS = 5
#: Seconds until a signal is given again whose exception Python could not pass on.
_AGAIN_AFTER_S = 0.05


class _Stop:
    """What a program knows of the signals that told it to stop."""

    def __init__(self, program: str, if_stopped: str) -> None:
        self.number = 0
        self._times = 0
        self._program = program
        self._if_stopped = if_stopped

    def on_signal(self, number: int, _frame: FrameType | None) -> None:
        """Handle SIGINT or SIGTERM."""
        self.number = self.number or number
        self._times += 1
        if self._times > _MOST_SIGNALS:
            os.write(2, self._sentence().encode())
            os._exit(EXIT_SIGNALLED + self.number)
        raise KeyboardInterrupt

    def on_unraisable(self, unraisable: Any, before: Callable[[Any], Any]) -> None:
        """Take the place of `sys.unraisablehook`: give a signal again that interrupted a destructor or a callback."""
        if issubclass(unraisable.exc_type, (Exception, GeneratorExit, SystemExit)):
            before(unraisable)
            return
        number = signal.SIGINT if issubclass(unraisable.exc_type, KeyboardInterrupt) else signal.SIGTERM
        main = threading.main_thread().ident
        assert main is not None
        again = threading.Timer(_AGAIN_AFTER_S, signal.pthread_kill, (main, number))
        again.daemon = True
        again.start()

    def say(self) -> int:
        """Print the sentence; returns the exit code."""
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                signal.signal(number, signal.SIG_IGN)
        print(self._sentence(), end="", file=sys.stderr, flush=True)
        return EXIT_SIGNALLED + (self.number or signal.SIGINT)

    def _sentence(self) -> str:
        # A terminal shows ^C without a line end.
        begin, how = ("", " by SIGTERM") if self.number == signal.SIGTERM else ("\n", "")
        return f"{begin}{self._program}: stopped{how}; {self._if_stopped}\n"


def run_until_stopped(program: str, command: Callable[[], int], if_stopped: str) -> int:
    """Run a program; returns its exit code, 130 after Ctrl-C and 143 after SIGTERM, with one sentence on stderr.

    SIGTERM is left to whoever handles it already, and Ctrl-C is ignored where it was ignored before (`nohup`). In
    another than the main thread, Python allows no handlers, and nothing changes.

    Args:
        program: its name in the sentence.
        command: does the work; after a signal it is interrupted by KeyboardInterrupt.
        if_stopped: the end of the sentence: what is kept, how to go on.
    """
    stop = _Stop(program, if_stopped)
    with _listening(stop):
        try:
            try:
                return command()
            except Exception:
                # A library may make an error of its own out of the interruption, for instance of an import.
                if not stop.number:
                    raise
            except KeyboardInterrupt:
                pass
        except KeyboardInterrupt:  # a second signal at this moment
            pass
        return stop.say()


@contextmanager
def _listening(stop: _Stop) -> Iterator[None]:
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    hook = sys.unraisablehook
    before: dict[int, Any] = {}
    try:
        number: int
        for number in (signal.SIGINT, signal.SIGTERM):
            handler = signal.getsignal(number)
            ours = isinstance(getattr(handler, "__self__", None), _Stop)
            if ours or handler in (signal.SIG_DFL, signal.default_int_handler):
                before[number] = handler
                signal.signal(number, stop.on_signal)
        sys.unraisablehook = lambda unraisable: stop.on_unraisable(unraisable, hook)
        yield
    finally:
        sys.unraisablehook = hook
        for number, handler in before.items():
            signal.signal(number, handler)


def end_program(code: int) -> NoReturn:
    """Exit with a code. What a program does, it has done and said: from here on Ctrl-C ends it without a word.

    A program that was stopped does not wait for threads called `UNAWAITED`.
    """
    waiting = any(thread.name.startswith(UNAWAITED) for thread in threading.enumerate())
    if code >= EXIT_SIGNALLED and waiting:
        for stream in (sys.stdout, sys.stderr):
            with suppress(OSError, ValueError):
                stream.flush()
        os._exit(code)
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    sys.exit(code)


@contextmanager
def stops_kept_from_children() -> Iterator[None]:
    """Processes that are started within the block never get Ctrl-C, which a terminal sends to all of a program.

    They inherit the mask of the thread that starts them. Here Ctrl-C and SIGTERM come at the end of the block only: a
    process whose start is interrupted is told nothing of its work, and ends with a traceback.
    """
    came: list[int] = []

    def give_again() -> None:
        for number in came:
            signal.raise_signal(number)

    with ExitStack() as stack:  # undone in reverse order, all of it, whatever is raised
        stack.callback(give_again)
        if threading.current_thread() is threading.main_thread():
            number: int
            for number in (signal.SIGINT, signal.SIGTERM):
                handler = signal.getsignal(number)
                if callable(handler):
                    stack.callback(signal.signal, number, handler)
                    # The mask does not suffice: a signal that another thread gets is handled in this one, too.
                    signal.signal(number, lambda number, _frame: came.append(number))
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        stack.callback(signal.pthread_sigmask, signal.SIG_SETMASK, before)
        yield


#: Exit code after SIGTERM: EX_TEMPFAIL of sysexits.h, "try again later". The program ends with this code for no other
#: reason.
EXIT_TERMINATED = 75


class Terminated(BaseException):
    """SIGTERM came. Like KeyboardInterrupt this is no `Exception`: handlers of ordinary errors do not catch it."""


class Termination:
    """Remembers whether SIGTERM came, which batch systems send before they kill a capture (time limit, `scancel`).

    Between episodes, for example while a model loads, the process stops at once. During an episode it stops at the next
    environment step, so that nothing writes to the episode's folder during its removal. A commit in progress is
    completed. A second signal stops the process at once, also during an episode.
    """

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
