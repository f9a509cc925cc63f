"""Jobs in processes of the engine: their results arrive, a mistake is raised here, and what fails is tried again."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import pytest
from tqdm import tqdm

from examples.cubes_policy.engine import WorkRefused, share_among_processes
from vla_attention.schemas.errors import BadArgument

Do = Callable[[int], Iterator[int]]


@contextmanager
def doubling(failing: Path) -> Iterator[Do]:
    """Give each number twice and doubled; those of files in `failing` fail between the two, and lose their file.

    2 ends its process, others raise.
    """

    def double(job: int) -> Iterator[int]:
        if job < 0:
            raise BadArgument(f"Cannot double {job}.")
        yield 2 * job
        if told := sorted(failing.glob(f"{job}_*")):
            told[0].unlink()
            if job == 2:
                os.kill(os.getpid(), signal.SIGKILL)
            raise ZeroDivisionError("no table")
        yield 2 * job

    yield double


def shared(failing: Path, jobs: list[int], workers: int) -> tuple[bool, list[int], int]:
    received: list[int] = []
    with tqdm(total=2 * len(jobs), file=open(os.devnull, "w")) as bar:
        complete = share_among_processes(partial(doubling, failing), jobs, workers, received.append, bar)
        return complete, sorted(received), bar.n


def test_every_job_gives_its_results(tmp_path) -> None:
    assert shared(tmp_path, [1, 2, 3], 2) == (True, [2, 2, 4, 4, 6, 6], 6)


def test_a_mistake_that_a_process_finds_is_raised_here(tmp_path) -> None:
    with pytest.raises(WorkRefused, match=r"^Cannot double -1\.$"):
        shared(tmp_path, [-1], 1)


def test_what_fails_is_done_once_more_and_then_left_out(tmp_path, capsys) -> None:
    for name in ("2_first", "3_first", "3_second"):
        (tmp_path / name).touch()
    assert shared(tmp_path, [1, 2, 3, 4], 2) == (False, [2, 2, 4, 4, 8, 8], 6)
    said = capsys.readouterr().err
    assert said.count("begins again") == 2
    assert said.count("is left out") == 1
    assert said.count("no table") == 2
    assert said.count("killed by signal 9") == 1
