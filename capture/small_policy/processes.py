"""Work shared among processes that each have a simulator of their own."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tqdm import tqdm

from vla_attention.schemas.errors import BadArgument, UserError
from vla_attention.schemas.stop_signals import stops_kept_from_children
from vla_attention.schemas.stores.store_place import refuse_in_store

#: Takes the jobs of one process and the queue of its results.
Work = Callable[[Sequence[Any], "multiprocessing.Queue[Any]"], None]


def new_folder(folder: Path, content: str) -> None:
    """Make a folder if there is none; raises `BadArgument`, which says for what it was meant."""
    refuse_in_store(folder, f"make a folder for the {content} at")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BadArgument(
            f"Cannot make the folder '{folder}' for the {content} ({error.strerror}); give another one."
        ) from error


class WorkRefused(UserError):
    """A process found a mistake of the user in its work; the message is its own."""


@dataclass(frozen=True)
class _Refusal:
    """What a process sends in place of a result when it finds a mistake of the user."""

    sentence: str


def share_among_processes(
    work: Work, jobs: Sequence[Any], workers: int, receive: Callable[[Any], None], progress: tqdm[Any]
) -> bool:
    """Give every process each `workers`-th job, and each result to `receive`; returns whether all ended well.

    work: a function of a module, or a partial of one, because processes begin anew: an OpenGL context does not survive
    a fork.

    Raises:
        WorkRefused: a process raised a `UserError`; the others are ended.
    """
    context = multiprocessing.get_context("spawn")
    results = context.Queue()
    shares = [jobs[first::workers] for first in range(workers)]
    processes = [context.Process(target=_run, args=(work, share, results), daemon=True) for share in shares if share]
    with stops_kept_from_children():
        for process in processes:
            process.start()
    while any(process.is_alive() for process in processes) or not results.empty():
        while not results.empty():
            result = results.get()
            if isinstance(result, _Refusal):
                for process in processes:
                    process.terminate()
                raise WorkRefused(result.sentence)
            receive(result)
            progress.update()
        for process in processes:
            process.join(0.2)
    return not any(process.exitcode for process in processes)


def _run(work: Work, share: Sequence[Any], results: multiprocessing.Queue[Any]) -> None:
    try:
        work(share, results)
    except UserError as error:
        results.put(_Refusal(str(error)))
