"""Claims: one holder per episode, also after the death of a holder and with several processes at once."""

from __future__ import annotations

import hashlib
import os
import subprocess
import threading
import time
from dataclasses import replace
from pathlib import Path

import pytest

from vla_attention.schemas.stores.claims import Claims, Holder, holders, jobs_folder
from vla_attention.schemas.stores.partial_folders import partial_of
from vla_attention.schemas.stores.worker import Worker, is_known_dead, this_worker

NAME = "task000_episode003"


def worker(number: int, **changes: object) -> Worker:
    """A worker of another machine. This machine cannot determine whether it lives."""
    made = Worker(f"node{number}-{number}-aa", f"node{number}", number, "1", "pid:[1]")
    return replace(made, **changes)


def mark(space: str) -> str:
    """What the names of partial folders have of the space of a process."""
    return f"n{hashlib.sha256(space.encode()).hexdigest()[:16]}"


def claims(tmp_path: Path, who: Worker, **keywords: float) -> Claims:
    return Claims(tmp_path / "a.zarr", who, **keywords)


def age(tmp_path: Path, seconds: float) -> None:
    """Set the last touch of every claim to so many seconds ago."""
    for file in jobs_folder(tmp_path / "a.zarr").rglob("owner.json"):
        os.utime(file, (time.time() - seconds,) * 2)


def listed(tmp_path: Path) -> list[str]:
    return sorted(entry.name for entry in (jobs_folder(tmp_path / "a.zarr") / "claims").glob("*"))


def test_a_second_process_gets_the_holder(tmp_path):
    first, second = claims(tmp_path, worker(1, slurm_job="7", job_name="5_2")), claims(tmp_path, worker(2))
    assert first.acquire(NAME) is None
    holder = second.acquire(NAME)
    assert isinstance(holder, Holder)
    assert holder.worker == first.worker
    assert holder.describe() == f"{NAME} by node1 (job 5_2), last active 0 s ago"
    assert second.acquire("task000_episode004") is None
    assert [found.episode for found in holders(tmp_path / "a.zarr")] == [NAME, "task000_episode004"]
    first.release(NAME)
    assert second.acquire(NAME) is None
    second.release(NAME)
    second.release("task000_episode004")
    assert holders(tmp_path / "a.zarr") == []
    assert listed(tmp_path) == []


def test_a_silent_holder_is_replaced_and_its_partial_episode_removed(tmp_path):
    first, second, third = (claims(tmp_path, worker(number)) for number in (1, 2, 3))
    assert first.acquire(NAME) is None
    mine = f"{NAME}-node1-1-0123abcd{mark('pid:[1]')}"
    changes = [("node1", "node9"), ("-1-", "-11-"), ("003", "0030"), (mark("pid:[1]"), ""), (mark("pid:[1]"), "n1")]
    others = [mine.replace(*change) for change in changes]
    for folder in (mine, *others):
        (tmp_path / "a.zarr.partial" / folder).mkdir(parents=True)
    age(tmp_path, 240)
    assert second.acquire(NAME) is not None
    age(tmp_path, 301)
    assert second.acquire(NAME) is None
    assert sorted(entry.name for entry in (tmp_path / "a.zarr.partial").iterdir()) == sorted(others)
    held = third.acquire(NAME)
    assert held is not None
    assert held.worker == second.worker
    # The first holder was only slow. It does not delete the claim of its successor.
    first.release(NAME)
    assert third.acquire(NAME) is not None
    second.release(NAME)
    assert listed(tmp_path) == []
    assert third.acquire(NAME) is None


@pytest.mark.parametrize("host", ["x/../../precious/*", "*", "**", "[!x]*", "../..", "/", "", "node1-1-0123abcdn1"])
@pytest.mark.parametrize("episode", [NAME, f"{NAME}-x"])
def test_nothing_in_a_dead_claim_is_part_of_a_path_or_a_pattern(tmp_path, host, episode):
    """Whoever gives away a store can put any claim beside it."""
    kept = [tmp_path / "precious" / "thesis-1-final", tmp_path / "a.zarr.partial" / f"{episode}-x" / "deep-1-a"]
    kept += [tmp_path / "a.zarr.partial" / f"{NAME}-node1-1-0123abcdn1"]
    for folder in kept:
        folder.mkdir(parents=True)
    assert claims(tmp_path, worker(1, host=host, process_space="x")).acquire(NAME) is None
    age(tmp_path, 1000)
    assert claims(tmp_path, worker(2)).acquire(NAME) is None
    assert all(folder.is_dir() for folder in kept)


def test_what_a_running_process_of_this_machine_writes_stays(tmp_path):
    """A claim is as old as somebody says that it is."""
    me = this_worker()
    with partial_of(tmp_path / "a.zarr", NAME) as folder:
        assert claims(tmp_path, me).acquire(NAME) is None
        age(tmp_path, 1000)
        assert claims(tmp_path, worker(2)).acquire(NAME) is None
        assert folder.is_dir()


def test_of_two_that_saw_no_holder_one_gets_the_claim(tmp_path, monkeypatch):
    first, second = claims(tmp_path, worker(1)), claims(tmp_path, worker(2))

    def after_the_other(building: Path, target: Path, rename=Path.rename) -> Path:
        monkeypatch.undo()
        assert first.acquire(NAME) is None
        return rename(building, target)

    monkeypatch.setattr(Path, "rename", after_the_other)
    held = second.acquire(NAME)
    assert held is not None
    assert held.worker == first.worker


@pytest.mark.parametrize("silent", [False, True])
def test_of_several_processes_one_gets_the_claim(tmp_path, silent):
    if silent:
        assert claims(tmp_path, worker(99)).acquire(NAME) is None
        age(tmp_path, 1000)
    everybody = [claims(tmp_path, worker(number)) for number in range(8)]
    barrier, won = threading.Barrier(len(everybody)), []

    def run(mine: Claims) -> None:
        barrier.wait()
        if mine.acquire(NAME) is None:
            won.append(mine)

    threads = [threading.Thread(target=run, args=(mine,)) for mine in everybody]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(won) == 1
    (holder,) = holders(tmp_path / "a.zarr")
    assert holder.worker == won[0].worker
    won[0].release(NAME)
    assert listed(tmp_path) == []


def test_a_living_holder_touches_its_claim(tmp_path):
    with claims(tmp_path, worker(1), touch_every_s=0.05) as first:
        assert first.acquire(NAME) is None
        age(tmp_path, 1000)
        until = time.monotonic() + 5
        while holders(tmp_path / "a.zarr")[0].silent_s > 10 and time.monotonic() < until:
            time.sleep(0.01)
        assert claims(tmp_path, worker(2)).acquire(NAME) is not None
    assert holders(tmp_path / "a.zarr") == []  # leaving the context releases all claims


def test_a_process_of_this_machine_that_has_ended_is_known_to_be_dead(tmp_path):
    me = this_worker()
    assert not is_known_dead(me, me)
    child = subprocess.Popen(["sleep", "60"])
    start = Path(f"/proc/{child.pid}/stat").read_text().rpartition(")")[2].split()[19]
    other = replace(me, tag="x", process=child.pid, process_start=start)
    assert not is_known_dead(other, me)
    assert is_known_dead(replace(other, process_start="1"), me)  # another process has its number now
    assert not is_known_dead(replace(other, process_start="1", process_space="pid:[0]"), me)
    assert not is_known_dead(replace(other, process_start="1", host="elsewhere"), me)
    child.kill()
    child.wait()
    assert is_known_dead(other, me)
    assert claims(tmp_path, other).acquire(NAME) is None
    assert claims(tmp_path, me).acquire(NAME) is None


def test_a_requeued_job_replaces_its_own_claim_at_once(tmp_path):
    before = worker(1, slurm_job="7")
    assert claims(tmp_path, before).acquire(NAME) is None
    assert claims(tmp_path, worker(2, slurm_job="8")).acquire(NAME) is not None
    assert claims(tmp_path, worker(3, slurm_job="7")).acquire(NAME) is not None
    assert claims(tmp_path, worker(3, slurm_job="7", restarts=1)).acquire(NAME) is None
