"""Episodes in processes of this machine. A process that dies is replaced, and its episodes are begun again."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing.connection import wait
from types import ModuleType
from typing import Any

from vla_attention.schemas.errors import BadArgument, UserError, listing
from vla_attention.schemas.stop_signals import stops_kept_from_children
from vla_attention.schemas.threads import use_threads

#: Episodes that are begun beyond the one whose result is waited for, for each process.
_BEGUN_AHEAD = 2
#: An episode is begun again so often after a process died with it.
_BEGUN_AGAIN = 2


class WorkersDied(UserError, RuntimeError):
    """Processes ended again and again while they worked on the same episodes."""


class WorkerProcesses:
    """The engine (`parallel.Engine`) of processes on this machine, started at the first work and kept for the next.

    A context manager: at its end the processes have ended. Raises `BadArgument` for fewer than one.
    """

    def __init__(self, number: int) -> None:
        if number < 1:
            raise BadArgument(f"Cannot use --workers {number}; expected at least 1.")
        self._number = number
        self._executor: ProcessPoolExecutor | None = None

    def __enter__(self) -> WorkerProcesses:
        return self

    def __exit__(self, *_: object) -> None:
        self._end()

    def results(self, function: Callable[[Any], Any], items: Iterable[Any]) -> Iterator[Any]:
        """Results in the order of the items; raises the error of the first item that fails.

        Raises:
            WorkersDied: processes died with the same episodes three times.
        """
        from vla_attention.analyze.stores.parcels import Parcel

        begun: deque[tuple[Parcel, Future[bytes]]] = deque()
        ended = 0
        left = iter(items)
        try:
            while True:
                while len(begun) < self._number * _BEGUN_AHEAD and (item := next(left, _NONE)) is not _NONE:
                    parcel = Parcel.of(function, item)
                    begun.append((parcel, self._submit(parcel)))
                if not begun:
                    return
                parcel, future = begun[0]
                try:
                    answer = future.result()
                except BrokenProcessPool:
                    ended += 1
                    if ended > _BEGUN_AGAIN:
                        raise WorkersDied(_died(ended, [one for one, of_one in begun if not _done(of_one)])) from None
                    self._end()
                    begun = deque(
                        (parcel, future if _done(future) else self._submit(parcel)) for parcel, future in begun
                    )
                    continue
                begun.popleft()
                ended = 0
                yield parcel.result(answer)
        finally:
            for _, future in begun:
                future.cancel()

    def _submit(self, parcel: Any) -> Future[bytes]:
        from vla_attention.analyze.stores.parcels import package_version, work

        if self._executor is None:
            # Forked copies of a process with threads may wait for locks that nobody holds.
            context = multiprocessing.get_context("spawn")
            self._executor = ProcessPoolExecutor(self._number, context, initializer=prepare_process)
        try:
            with main_module_hidden(), stops_kept_from_children():  # here the executor starts processes
                return self._executor.submit(work, parcel.content, package_version())
        except BrokenProcessPool as error:  # a process died between two submissions
            future: Future[bytes] = Future()
            future.set_exception(error)
            return future

    def _end(self) -> None:
        if self._executor is not None:
            self._executor.shutdown(wait=True, cancel_futures=True)
            self._executor = None


_NONE = object()


@contextmanager
def main_module_hidden() -> Iterator[None]:
    """Processes that are started within the block do not run the user's script again.

    `multiprocessing` runs `__main__` in every new process, for functions that are defined there. Episodes are handed to
    functions of this package only, and a script without `if __name__ == "__main__"` would start workers of its own.
    """
    main = sys.modules["__main__"]
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main


def _done(future: Future[bytes]) -> bool:
    """Whether a future has its answer, or the function's own error."""
    return future.done() and not future.cancelled() and not isinstance(future.exception(), BrokenProcessPool)


def _died(times: int, parcels: list[Any]) -> str:
    from vla_attention.analyze.stores.parcels import names_of

    return (
        f"Worker processes ended {times} times without a result, the last time at {listing(names_of(parcels), 4)}: the "
        "system may have ended them for lack of memory; give fewer --workers."
    )


def prepare_process() -> None:
    """Called in each process before it imports a numerical library.

    One thread each; Ctrl-C is for the process that asks; a process whose asker has ended ends too.
    """
    use_threads(1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    asker = multiprocessing.parent_process()
    if asker is not None:
        threading.Thread(target=_end_after, args=(asker.sentinel,), daemon=True).start()


def _end_after(sentinel: int) -> None:
    wait([sentinel])
    os._exit(1)
