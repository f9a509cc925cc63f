"""The same work on many episodes, several at once: the episode is the one unit of work everywhere.

Threads of this process unless `workers` or `episodes_with` says otherwise: one waits for its chunks while another is
computed. The functions that are handed over here are picklable: defined at the top of their module, or a
`functools.partial` of such a function with plain arguments. Any of them can then be computed in another process.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from contextvars import ContextVar
from functools import partial
from typing import Any, Protocol, TypeVar

from vla_attention.analyze.stores.blas import one_blas_thread
from vla_attention.analyze.stores.dask_scheduler import DaskScheduler
from vla_attention.analyze.stores.worker_processes import WorkerProcesses
from vla_attention.schemas.stop_signals import UNAWAITED
from vla_attention.schemas.threads import threads_of_this_process

Item = TypeVar("Item")
Result = TypeVar("Result")

#: More threads are not faster (decoding has its own), and each holds the rows of one layer in memory.
_MOST_AT_ONCE = 4
#: Episodes that are begun beyond the one whose result is waited for, for each thread or worker: results of later
#: episodes are kept until those of earlier ones are there.
_BEGUN_AHEAD = 2
#: Seconds after which a wait for a result looks whether the program was stopped.
_LOOK_UP_S = 0.2


class Engine(Protocol):
    """Computes a function of each item somewhere."""

    def results(self, function: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
        """Results in the order of the items; raises the error of the first item that fails."""


class Threads:
    """The engine of this process."""

    def results(self, function: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
        """See `Engine`."""
        number = min(_MOST_AT_ONCE, threads_of_this_process().number)
        with one_blas_thread(), stoppable_threads(number, "episodes") as executor:
            yield from in_order(lambda item: executor.submit(function, item), items, number * _BEGUN_AHEAD)


@contextmanager
def stoppable_threads(number: int, name: str) -> Iterator[ThreadPoolExecutor]:
    """Threads that the end of the block waits for, unless it is Ctrl-C or SIGTERM.

    One of them may wait a minute for a server that sends nothing; the end of the program does not wait either
    (`stop_signals.end_program`).
    """
    executor = ThreadPoolExecutor(number, thread_name_prefix=f"{UNAWAITED}-{name}")
    try:
        yield executor
    except (KeyboardInterrupt, GeneratorExit):  # the latter where the one who takes the results was interrupted
        executor.shutdown(wait=False, cancel_futures=True)
        raise
    except BaseException:
        executor.shutdown(wait=True, cancel_futures=True)
        raise
    executor.shutdown(wait=True)


_engine: ContextVar[Engine | None] = ContextVar("engine of episodes", default=None)


@contextmanager
def episodes_with(engine: Engine) -> Iterator[None]:
    """Within the block, `each_episode` and `map_episodes` hand episodes to this engine."""
    token = _engine.set(engine)
    try:
        yield
    finally:
        _engine.reset(token)


@contextmanager
def workers(where: int | str) -> Iterator[None]:
    """Within the block, episodes are worked on elsewhere; results are the same to the last bit.

    Args:
        where: a number of processes on this machine, or the address of a dask scheduler that runs.

    Raises:
        BadArgument: fewer than one process, or no scheduler answers.
        MissingDependency: dask is not installed.
    """
    engine: WorkerProcesses | DaskScheduler
    engine = DaskScheduler(where) if isinstance(where, str) else WorkerProcesses(where)
    with engine, episodes_with(engine):
        yield


def each_episode(
    function: Callable[[Item], Result], items: Iterable[Item], progress: Callable[[int], object] | None = None
) -> Iterator[Result]:
    """Results in the order of the items, one after the other: only a few are kept at once.

    The first error is raised, and no further item is started.

    Args:
        function: a function at the top of its module, or a `functools.partial` of one; raises `TypeError` otherwise.
        items: what it is called with, one at a time.
        progress: called with 1 after each item, in the caller's thread.
    """
    _refuse_local(function)
    for result in (_engine.get() or Threads()).results(function, items):
        yield result
        if progress is not None:
            progress(1)


def map_episodes(
    function: Callable[[Item], Result], items: Iterable[Item], progress: Callable[[int], object] | None = None
) -> list[Result]:
    """All results of `each_episode`."""
    return list(each_episode(function, items, progress))


def in_order(submit: Callable[[Item], Future[Result]], items: Iterable[Item], begun_at_once: int) -> Iterator[Result]:
    """Results of futures in the order of the items; at most so many are begun and not yet handed out."""
    begun: deque[Future[Result]] = deque()
    for item in items:
        if len(begun) >= begun_at_once:
            yield _awaited(begun.popleft())
        begun.append(submit(item))
    while begun:
        yield _awaited(begun.popleft())


def _awaited(future: Future[Result]) -> Result:
    """The future's result; the wait for it ends at Ctrl-C.

    It looks up now and then: where the system hands the signal to another thread, the one that waits sleeps on, and a
    server may send nothing for a minute.
    """
    while not future.done():
        wait([future], timeout=_LOOK_UP_S)
    return future.result()


def _refuse_local(function: Callable[..., Any]) -> None:
    """Raise `TypeError` for a function that another process could not find by its name."""
    inner = function
    while isinstance(inner, partial):
        inner = inner.func
    name = getattr(inner, "__qualname__", type(inner).__qualname__)
    if "<" in name:
        raise TypeError(f"{name} is defined inside of a function: episodes are handed to functions of a module only")
