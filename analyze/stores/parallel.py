"""The same work on many episodes in a few threads: one waits for its chunks while another is computed."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

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
    workers = max(1, min(_MOST_AT_ONCE, os.cpu_count() or 1))
    results: list[Result] = []
    executor = ThreadPoolExecutor(workers)
    try:
        for result in executor.map(function, items):
            results.append(result)
            if progress is not None:
                progress(1)
    finally:
        executor.shutdown(wait=True, cancel_futures=True)
    return results
