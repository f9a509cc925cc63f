"""What a run says after its first episode: time, disk, and whether the time limit of its SLURM job suffices."""

from __future__ import annotations

import re

import pytest

from vla_attention.capture.engine.progress import describe_rest, duration, seconds_of_job


@pytest.mark.parametrize(("seconds", "text"), [(40, "40 s"), (720, "12 min"), (12600, "3.5 h")])
def test_durations_have_the_unit_that_fits(seconds: float, text: str):
    assert duration(seconds) == text


def test_time_and_disk_are_those_of_the_first_episode_times_what_is_left():
    line = describe_rest(60, 2_000_000, 0.5, left=40, at_a_time=4, room=10**9, job_seconds=None)
    assert re.search(r"\b60 s .*\b2 MB.*\b10 min .*\b20 min.*\b80 MB .*\b160 MB.*\b1 GB", line)
    assert "job" not in line
    assert "20 min" not in describe_rest(60, 2_000_000, 1.0, 40, 4, 10**9, None)


@pytest.mark.parametrize(
    ("job_seconds", "said"),
    [(1201, "suffices."), (601, "suffices unless"), (599, "does NOT suffice"), (-5, "does NOT suffice")],
)
def test_the_time_limit_of_a_job_is_held_against_the_likely_and_the_longest_time(job_seconds: float, said: str):
    assert said in describe_rest(60, 1, 0.5, left=40, at_a_time=4, room=1, job_seconds=job_seconds)


@pytest.mark.parametrize(
    ("environment", "left"),
    [({"SLURM_JOB_END_TIME": "1500"}, 500.0), ({"SLURM_JOB_END_TIME": "N/A"}, None), ({}, None)],
)
def test_the_time_limit_is_slurm_s(environment: dict[str, str], left: float | None):
    assert seconds_of_job(environment, 1000.0) == left
