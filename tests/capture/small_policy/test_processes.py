"""Work shared among processes: results arrive, and a mistake found by a process is raised where work was shared."""

from __future__ import annotations

import pytest
from tqdm import tqdm

from vla_attention.capture.small_policy.processes import WorkRefused, share_among_processes
from vla_attention.schemas.errors import BadArgument


def double(jobs, results) -> None:
    for job in jobs:
        if job < 0:
            raise BadArgument(f"Cannot double {job}.")
        results.put(2 * job)


def test_every_job_gives_its_result() -> None:
    received: list[int] = []
    with tqdm(total=3, disable=True) as bar:
        assert share_among_processes(double, [1, 2, 3], 2, received.append, bar)
    assert sorted(received) == [2, 4, 6]


def test_a_mistake_that_a_process_finds_is_raised_here() -> None:
    with tqdm(total=1, disable=True) as bar, pytest.raises(WorkRefused, match=r"^Cannot double -1\.$"):
        share_among_processes(double, [-1], 1, print, bar)
