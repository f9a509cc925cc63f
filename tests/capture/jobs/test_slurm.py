"""Requests to SLURM, answered by a script in place of scontrol."""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest

from vla_attention.capture.jobs.slurm import array_task_ids, ask_for_requeue
from vla_attention.schemas.stores.worker import Worker

NODE = Worker("node7-11-ab", "node7", 11, "1", "pid:[1]", "99", "98_2")


@pytest.fixture
def scontrol(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A program `scontrol` that appends its arguments to the file `calls` and prints the state in the file `state`."""
    script = tmp_path / "scontrol"
    script.write_text(
        f'#!/bin/sh\necho "$@" >> {tmp_path}/calls\n'
        f'[ "$1" = show ] && echo "JobId=9 JobState=$(cat {tmp_path}/state) X=1"\nexit 0\n'
    )
    script.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    return script


def calls_of(script: Path) -> list[str]:
    return script.with_name("calls").read_text().splitlines()


def test_a_running_job_is_requeued(scontrol: Path) -> None:
    scontrol.with_name("state").write_text("RUNNING")
    assert "98_2" in ask_for_requeue(NODE, 1)
    assert calls_of(scontrol) == ["show job 98_2", "requeue 98_2"]


def test_a_cancelled_job_is_not_requeued(scontrol: Path) -> None:
    scontrol.with_name("state").write_text("CANCELLED")
    assert re.search("98_2 .*CANCELLED", ask_for_requeue(NODE, 1))
    assert calls_of(scontrol) == ["show job 98_2"]


def test_requeues_are_limited(scontrol: Path) -> None:
    assert " 0 times" in ask_for_requeue(NODE, 0)
    assert not scontrol.with_name("calls").exists()


@pytest.mark.parametrize(
    ("variables", "indices"),
    [
        (("0", "3", "1", "4"), (0, 1, 2, 3)),
        (("2", "8", "3", "3"), (2, 5, 8)),
        (("0", "7", "1", "3"), ()),  # a list such as 0,3,7, which these four numbers do not determine
        (("", "", "", ""), ()),
    ],
)
def test_array_indices(monkeypatch: pytest.MonkeyPatch, variables: tuple[str, ...], indices: tuple[int, ...]) -> None:
    for name, value in zip(("MIN", "MAX", "STEP", "COUNT"), variables, strict=True):
        monkeypatch.setenv(f"SLURM_ARRAY_TASK_{name}", value)
    assert array_task_ids() == indices
