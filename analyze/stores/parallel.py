"""The same work on many episodes in a few threads: one waits for its chunks while another is computed."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from vla_attention.analyze.stores.blas import one_blas_thread
from vla_attention.schemas.threads import threads_of_this_process

Item = TypeVar("Item")
Result = TypeVar("Result")

#: More threads are not faster (decoding has its own), and each holds the rows of one layer in memory.
_MOST_AT_ONCE = 4


def map_episodes(
    function: Callable[[Item], Result], items: Iterable[Item], progress: Callable[[int], object] | None = None
) -> list[Result]:
    """Results in the order of the items. The first error is raised, and no further item is started.

    `progress` is called with 1 after each, in the caller's thread.
    """
    results: list[Result] = []
    executor = ThreadPoolExecutor(min(_MOST_AT_ONCE, threads_of_this_process().number))
    with one_blas_thread():
        try:
            for result in executor.map(function, items):
                results.append(result)
                if progress is not None:
                    progress(1)
        finally:
            executor.shutdown(wait=True, cancel_futures=True)
    return results
