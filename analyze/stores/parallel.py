"""The same work on many episodes, several at once: the episode is the one unit of work everywhere.

Threads of this process unless `workers` says otherwise: one waits for its chunks while another is computed. The
functions that are handed over here can be pickled: they are defined at the top of their module, or are a
`functools.partial` of such a function with plain arguments. Stores and episodes travel as their places.
"""

from __future__ import annotations

import ctypes
import logging
import multiprocessing
import os
import signal
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import CancelledError, Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import replace
from functools import cache, partial
from itertools import product
from multiprocessing.connection import wait as wait_for_end
from types import ModuleType
from typing import Any, TypeVar

import numpy as np

from vla_attention.schemas.errors import BadArgument, MissingDependency, UserError
from vla_attention.schemas.install_line import install_line
from vla_attention.schemas.stop_signals import UNAWAITED, stops_kept_from_children
from vla_attention.schemas.stores.reader import Store, StoredEpisode
from vla_attention.schemas.stores.store_url import StoreUrl
from vla_attention.schemas.stores.verify import Depth, EpisodeReport, episode_report
from vla_attention.schemas.threads import threads_of_this_process, use_threads

Item = TypeVar("Item")
Result = TypeVar("Result")

#: More threads are not faster (decoding has its own), and each holds the rows of one layer in memory.
_MOST_AT_ONCE = 4
#: Episodes that are begun beyond the one whose result is waited for, for each thread or worker: results of later
#: episodes are kept until those of earlier ones are there.
_BEGUN_AHEAD = 2
#: So many are begun at least on a cluster: one that grows with its work starts workers for waiting episodes.
_BEGUN_AT_LEAST = 16
#: Episodes of a store that is elsewhere that are opened at once.
_AHEAD = 16
#: Seconds after which a wait for a result looks whether the program was stopped, and within which a scheduler answers.
_LOOK_UP_S, _ANSWER_WITHIN = 0.2, 15
#: The number of threads belongs to the library, so there is one limit for the process: how many there were when each
#: block that is open began.
_LIMIT_LOCK, _LIMITS_BEFORE = threading.Lock(), list[int]()


class WorkersLost(UserError, RuntimeError):
    """Worker processes ended, or a scheduler does not answer any more; or they have another version of the package."""


#: Where episodes are worked on instead of in threads, and how many are begun at once.
_elsewhere: ContextVar[tuple[Executor, int] | None] = ContextVar("executor of episodes", default=None)


@contextmanager
def workers(where: int | str) -> Iterator[None]:
    """Within the block, episodes are worked on elsewhere; results are the same to the last bit.

    Args:
        where: a number of processes on this machine, or the address of a dask scheduler that runs.

    Raises:
        BadArgument: fewer than one process, or no scheduler answers.
        MissingDependency: dask.distributed is not installed.
        WorkersLost: the cluster's workers have another version of this package.
    """
    with _cluster(where) if isinstance(where, str) else _processes(where) as executor:
        token = _elsewhere.set(executor)
        try:
            yield
        finally:
            _elsewhere.reset(token)


def each_episode(
    function: Callable[[Item], Result], items: Iterable[Item], progress: Callable[[int], object] | None = None
) -> Iterator[Result]:
    """Results in the order of the items, one after the other: only a few are kept at once.

    The first error is raised, and no further item is started.

    Args:
        function: a function at the top of its module, or a `functools.partial` of one.
        items: what it is called with, one at a time.
        progress: called with 1 after each item, in the caller's thread.

    Raises:
        WorkersLost: see there.
    """
    elsewhere = _elsewhere.get()
    for result in _in_threads(function, items) if elsewhere is None else _by(*elsewhere, function, items):
        yield result
        if progress is not None:
            progress(1)


def _in_threads(function: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
    number = min(_MOST_AT_ONCE, threads_of_this_process().number)
    with one_blas_thread(), stoppable_threads(number, "episodes") as executor:
        yield from in_order(lambda item: executor.submit(function, item), items, number * _BEGUN_AHEAD)


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Compute matrix products with one thread each within the block; afterwards with as many as before.

    Threads of OpenBLAS that wait keep a core busy. Beside other work they make a scan ten times slower, and the
    episodes have threads of their own. Blocks of several threads may overlap. Nothing changes where numpy uses a
    library that offers no such call (Apple's Accelerate).

    threadpoolctl does the same, but lets only the first thread of a process that limits OpenBLAS do so from then on
    (3.8); scans may begin in any thread.
    """
    functions = _thread_functions()
    if functions is None:
        yield
        return
    get, limit = functions
    with _LIMIT_LOCK:
        _LIMITS_BEFORE.append(get())
        limit(1)
    try:
        yield
    finally:
        with _LIMIT_LOCK:
            limit(_LIMITS_BEFORE.pop())  # 1, unless it is the last block


@cache
def _thread_functions() -> tuple[Callable[[], int], Callable[[int], None]] | None:
    """Return (number of threads, set it) of the BLAS library that numpy is linked with."""
    # A symbol is searched in a library and in what it is linked with, so numpy's own extension leads to its BLAS.
    library = ctypes.CDLL(np.linalg._umath_linalg.__file__)
    names = [
        (f"{prefix}openblas_get_num_threads{suffix}", f"{prefix}openblas_set_num_threads{suffix}")
        for prefix, suffix in product(("scipy_", ""), ("64_", ""))
    ]
    for get, limit in [*names, ("MKL_Get_Max_Threads", "MKL_Set_Num_Threads")]:
        if hasattr(library, limit):
            return getattr(library, get), getattr(library, limit)
    return None


def _by(
    executor: Executor, begun_at_once: int, function: Callable[[Item], Result], items: Iterable[Item]
) -> Iterator[Result]:
    def submit(item: Item) -> Future[Result]:
        with _main_module_hidden(), stops_kept_from_children():  # here a pool starts its processes
            return executor.submit(_alone, function, item)

    try:
        yield from in_order(submit, items, begun_at_once)
    except BrokenProcessPool:
        raise WorkersLost(
            "A worker process ended without a result; the system may have ended it for lack of memory: give fewer "
            "--workers. What was measured is kept; the same command goes on from there."
        ) from None
    except (CancelledError, TimeoutError) as error:
        raise WorkersLost(
            f"The connection to the scheduler was lost ({type(error).__name__}); start it again, then the same command."
        ) from None
    except Exception as error:
        if type(error).__name__ != "KilledWorker":  # of dask, which may not be installed
            raise
        raise WorkersLost(
            f"Workers of the cluster died with an episode ({error}): give them more memory, look at their logs."
        ) from None


def _alone(function: Callable[[Item], Result], item: Item) -> Result:
    """In another process; matrix products take one thread, as everywhere."""
    with one_blas_thread():
        return function(item)


@contextmanager
def _processes(number: int) -> Iterator[tuple[Executor, int]]:
    """Processes on this machine."""
    if number < 1:
        raise BadArgument(f"Cannot use --workers {number}; expected at least 1.")
    # Forked copies of a process with threads may wait for locks that nobody holds.
    executor = ProcessPoolExecutor(number, multiprocessing.get_context("spawn"), initializer=_prepare)
    try:
        yield executor, number * _BEGUN_AHEAD
    finally:
        executor.shutdown(wait=True, cancel_futures=True)


def _prepare() -> None:
    """Called in each process before it imports a numerical library.

    One thread each; Ctrl-C is for the process that asks; a process whose asker has ended ends too.
    """
    use_threads(1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    asker = multiprocessing.parent_process()
    if asker is not None:
        threading.Thread(target=_end_after, args=(asker.sentinel,), daemon=True).start()


def _end_after(sentinel: int) -> None:
    wait_for_end([sentinel])
    os._exit(1)


@contextmanager
def _main_module_hidden() -> Iterator[None]:
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


@contextmanager
def _cluster(address: str) -> Iterator[tuple[Executor, int]]:
    """The workers of a dask scheduler at an address that its `Client` takes. Where one dies, another does its work."""
    try:
        from distributed import Client
        from distributed.comm.addressing import get_address_host_port
    except ImportError:
        raise MissingDependency(
            f"--scheduler needs dask.distributed, which is not installed: {install_line('dask')}, on the workers too."
        ) from None
    # What it says of lost connections stands in our own sentence.
    for name in ("distributed.client", "distributed.core", "distributed.comm", "distributed.batched"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    try:
        # A client made with what is no address waits half a minute at its end, and then prints a traceback.
        check: Any = get_address_host_port
        check(address)
        connect: Any = Client  # dask's own signature has no types
        client = connect(address, timeout=_ANSWER_WITHIN, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        raise BadArgument(
            f"No scheduler answers at '{address}' ({str(error) or type(error).__name__}); expected the address of a "
            "running dask scheduler, as tcp://HOST:8786: start one with `dask scheduler` (docs/my-cluster.md)."
        ) from None
    try:
        others = {str(one) for one in client.run(_package_version).values()} - {_package_version()}
        if others:
            raise WorkersLost(
                f"The workers of {address} have vla-attention {', '.join(sorted(others))} and this process "
                f"{_package_version()}: install the same on both."
            )
        number = max(_BEGUN_AT_LEAST, sum(client.nthreads().values()) * _BEGUN_AHEAD)
        with client.get_executor(pure=False) as executor:
            yield executor, number
    finally:
        client.close(timeout=5)


def _package_version() -> str:
    from vla_attention import __version__

    return __version__


@contextmanager
def stoppable_threads(number: int, name: str) -> Iterator[ThreadPoolExecutor]:
    """Threads that the end of the block waits for, unless it is Ctrl-C or SIGTERM.

    One of them may wait a minute for a server that sends nothing; the end of the program does not wait either
    (`stop_signals.end_program`).
    """
    executor = ThreadPoolExecutor(number, thread_name_prefix=f"{UNAWAITED}-{name}")
    waits = True
    try:
        yield executor
    except (KeyboardInterrupt, GeneratorExit):  # the latter where the one who takes the results was interrupted
        waits = False
        raise
    finally:
        executor.shutdown(wait=waits, cancel_futures=True)


def in_order(submit: Callable[[Item], Future[Result]], items: Iterable[Item], begun_at_once: int) -> Iterator[Result]:
    """Results of futures in the order of the items; at most so many are begun and not yet handed out."""
    begun: deque[Future[Result]] = deque()
    try:
        for item in items:
            if len(begun) >= begun_at_once:
                yield _awaited(begun.popleft())
            begun.append(submit(item))
        while begun:
            yield _awaited(begun.popleft())
    finally:
        for future in begun:
            future.cancel()


def _awaited(future: Future[Result]) -> Result:
    """The future's result; the wait for it ends at Ctrl-C.

    It looks up now and then: where the system hands the signal to another thread, the one that waits sleeps on, and a
    server may send nothing for a minute.
    """
    while not future.done():
        wait([future], timeout=_LOOK_UP_S)
    return future.result()


def read_ahead(episodes: Iterable[StoredEpisode]) -> Iterator[StoredEpisode]:
    """The same episodes in their order; what cannot be read raises where the caller reads it.

    Opening an episode that is elsewhere is a request, most of whose time is waiting: some are opened ahead. Hundreds of
    them, one after the other, would take a minute.
    """
    with stoppable_threads(_AHEAD, "ahead") as executor:
        yield from in_order(lambda episode: _begun(executor, episode), episodes, _AHEAD)


def _begun(executor: ThreadPoolExecutor, episode: StoredEpisode) -> Future[StoredEpisode]:
    if isinstance(episode.folder, StoreUrl):
        return executor.submit(_opened, episode)
    here: Future[StoredEpisode] = Future()
    here.set_result(episode)
    return here


def _opened(episode: StoredEpisode) -> StoredEpisode:
    with suppress(UserError):
        _ = episode.attributes
    return episode


def episode_reports(
    episodes: Iterable[tuple[Store, StoredEpisode]], depth: Depth, progress: Callable[[int], object] | None = None
) -> Iterator[EpisodeReport]:
    """What `verify` says of each episode, in their order; keeps nothing that was read."""
    return each_episode(partial(_report, depth=depth), ((store, replace(one)) for store, one in episodes), progress)


def _report(pair: tuple[Store, StoredEpisode], depth: Depth) -> EpisodeReport:
    return episode_report(*pair, depth)
