"""Work shared among processes that each have a simulator of their own."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Sequence
from typing import Any

from tqdm import tqdm

#: Takes the jobs of one process and the queue of its results.
Work = Callable[[Sequence[Any], "multiprocessing.Queue[Any]"], None]


def share_among_processes(
    work: Work, jobs: Sequence[Any], workers: int, receive: Callable[[Any], None], progress: tqdm[Any]
) -> bool:
    """Give every process each `workers`-th job, and each result to `receive`; returns whether all ended well.

    work: a function of a module, or a partial of one, because processes begin anew: an OpenGL context does not survive
    a fork.
    """
    context = multiprocessing.get_context("spawn")
    results = context.Queue()
    shares = [jobs[first::workers] for first in range(workers)]
    processes = [context.Process(target=work, args=(share, results), daemon=True) for share in shares if share]
    for process in processes:
        process.start()
    while any(process.is_alive() for process in processes) or not results.empty():
        while not results.empty():
            receive(results.get())
            progress.update()
        for process in processes:
            process.join(0.2)
    return not any(process.exitcode for process in processes)
