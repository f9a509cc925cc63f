"""Work that the command need not wait for, in a second process: pictures are drawn while tables are written.

Both are mostly Python, of which one process runs one thread at a time.
"""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from importlib import import_module
from typing import ParamSpec, TypeVar

from vla_attention.analyze.stores.worker_processes import main_module_hidden, prepare_process
from vla_attention.schemas.stop_signals import stops_kept_from_children
from vla_attention.schemas.threads import threads_of_this_process

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")


class SecondProcess:
    """A context manager; at its end the process has ended.

    There is none where this process is to use one thread (`--threads 1`), or where the system allows none: the work is
    then done here.

    Args:
        modules: what the process imports at once, while this one does something else; without any there is no process.
    """

    def __init__(self, modules: Sequence[str]) -> None:
        self._executor: ProcessPoolExecutor | None = None
        if not modules or threads_of_this_process().number == 1:
            return
        try:
            # Forked copies of a process with threads may wait for locks that nobody holds.
            context = multiprocessing.get_context("spawn")
            self._executor = ProcessPoolExecutor(1, context, initializer=prepare_process)
            with main_module_hidden(), stops_kept_from_children():
                self._executor.submit(_load, modules)
        except (ImportError, OSError):  # no semaphores, no further process
            self._executor = None

    def __enter__(self) -> SecondProcess:
        return self

    def __exit__(self, *_: object) -> None:
        if self._executor is not None:
            self._executor.shutdown(wait=True, cancel_futures=True)

    def begin(
        self, function: Callable[Parameters, Result], *args: Parameters.args, **kwargs: Parameters.kwargs
    ) -> Callable[[], Result]:
        """Begin a function at the top of its module; returns a function that waits for its result, or its error."""
        future: Future[Result] | None = None
        if self._executor is not None:
            try:
                future = self._executor.submit(function, *args, **kwargs)
            except BrokenProcessPool:
                future = None

        def result() -> Result:
            try:
                return function(*args, **kwargs) if future is None else future.result()
            except BrokenProcessPool:  # the system ended it, for instance for lack of memory
                return function(*args, **kwargs)

        return result


def _load(modules: Sequence[str]) -> None:
    for name in modules:
        import_module(name)
