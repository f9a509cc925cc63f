"""Reruns are runs like others: processes share a store, `status` counts it, and SIGTERM drops one episode."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from tests.capture.jobs.test_status import NODE
from vla_attention.capture.__main__ import main
from vla_attention.capture.jobs.termination import EXIT_TERMINATED, Terminated, Termination
from vla_attention.capture.jobs.worker_records import read_records
from vla_attention.schemas.stores.claims import Claims
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.verify import verify_store

EPISODES = ["task000_episode000", "task000_episode001", "task001_episode000", "task001_episode001"]


def names(store: Path) -> list[str]:
    return sorted(folder.name for folder in (store / "episodes").glob("task*"))


def status(store: Path, capsys: pytest.CaptureFixture[str]) -> dict:
    capsys.readouterr()
    main(["status", str(store), "--json"])
    [found] = json.loads(capsys.readouterr().out)
    return found


def test_a_rerun_waits_for_what_another_process_has_claimed(pi_store, tmp_path, monkeypatch, capsys):
    store = tmp_path / "again.zarr"
    words = ["rerun", str(pi_store), "--output", str(store), "--check", "0"]
    assert main([*words, "--num-episodes", "1"]) == 0
    other = Claims(store, NODE)
    assert other.acquire(EPISODES[1]) is None
    monkeypatch.setattr("vla_attention.capture.rollout.episode_loop._LOOK_EVERY_S", 0.05)
    seen: list[list[str]] = []

    def release_when_the_rest_is_done() -> None:
        until = time.monotonic() + 60
        while len(names(store)) < 3 and time.monotonic() < until:
            time.sleep(0.05)
        seen.append(names(store))
        other.release(EPISODES[1])

    thread = threading.Thread(target=release_when_the_rest_is_done)
    thread.start()
    assert main([*words, "--resume"]) == 0
    thread.join()
    assert seen == [[EPISODES[0], *EPISODES[2:]]]
    assert f"Waiting for episodes that other processes are writing: {EPISODES[1]} by node7" in capsys.readouterr().out
    assert names(store) == EPISODES


#: A rerun that makes the calls of its first episode when another process has committed the three others of the store.
WAITS = """
import sys, time
from pathlib import Path
from vla_attention.capture.__main__ import main
from vla_attention.capture.rerun.rerun_store import StoredCallsSource

record, begun = StoredCallsSource.record, Path(sys.argv[1])

def wait_and_record(self, job, report):
    if not begun.exists():
        begun.touch()
        until = time.monotonic() + 120
        while len(list((self.store.path / "episodes").glob("task*"))) < 3 and time.monotonic() < until:
            time.sleep(0.05)
    return record(self, job, report)

StoredCallsSource.record = wait_and_record
sys.exit(main(sys.argv[2:]))
"""


@pytest.mark.thorough
def test_two_processes_share_the_episodes_of_a_series(pi_store, tmp_path):
    """Every episode of every store is recorded once, by one of them, and both end when all is there."""
    folder = tmp_path / "series"
    grouping = tmp_path / "upper.toml"
    grouping.write_text('[groups]\nupper = "patch:base_0_rgb[0:1,0:2]"\nrest = "*"\n')
    begun = tmp_path / "begun"
    words = ["rerun", str(pi_store), "--series", str(grouping)]
    words += ["--output-dir", str(folder), "--check", "0", "--threads", "1"]
    commands = (
        [sys.executable, "-c", WAITS, str(begun), *words],
        [sys.executable, "-m", "vla_attention.capture", *words],
    )
    processes = []
    for command in commands:
        processes.append(subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT))
        while not begun.exists() and processes[0].poll() is None:
            time.sleep(0.05)
    said = [process.communicate()[0] for process in processes]
    assert [process.returncode for process in processes] == [0, 0], said
    stores = sorted(folder.glob("*.zarr"))
    assert len(stores) >= 3
    shared = set()
    for store in stores:
        assert names(store) == EPISODES
        assert verify_store(open_store(store)) == []
        records = read_records(store)
        committed = [commit.episode for record in records for commit in record.committed]
        assert sorted(committed) == EPISODES
        shared |= {record.worker.process for record in records if record.committed}
    assert len(shared) == 2


def test_status_counts_what_a_rerun_was_asked_for(pi_store, tmp_path, capsys):
    store = tmp_path / "again.zarr"
    words = ["rerun", str(pi_store), "--output", str(store), "--check", "0", "--task-id", "1"]
    assert main(words) == 0
    found = status(store, capsys)
    assert found["complete"] is True
    assert [(task["task_id"], task["expected"], task["committed"]) for task in found["tasks"]] == [(1, 2, 2)]
    shutil.rmtree(store / "episodes" / EPISODES[3])
    found = status(store, capsys)
    assert (found["complete"], found["tasks"][0]["missing"]) == (False, [1])
    assert main([*words, "--resume"]) == 0
    assert status(store, capsys)["complete"] is True


def test_sigterm_drops_the_episode_in_progress(pi_store, tmp_path, monkeypatch, capsys):
    store = tmp_path / "again.zarr"
    checks = iter(range(1_000_000))

    def check(termination: Termination) -> None:
        if len(list((store / "episodes").glob("task*"))) == 1 and next(checks) == 4:
            raise Terminated

    monkeypatch.setattr(Termination, "check", check)
    assert main(["rerun", str(pi_store), "--output", str(store), "--check", "0"]) == EXIT_TERMINATED
    said = capsys.readouterr().out
    assert f"Stopped by SIGTERM: dropped {EPISODES[1]} at call" in said
    assert f"committed 1 episode ({EPISODES[0]}); 3 of this process's 4 are missing." in said
    assert names(store) == EPISODES[:1]
    assert [record.state for record in read_records(store)] == ["stopped"]
    monkeypatch.undo()
    assert main(["rerun", str(pi_store), "--output", str(store), "--check", "0", "--resume"]) == 0
    assert names(store) == EPISODES
