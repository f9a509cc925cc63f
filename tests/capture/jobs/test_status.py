"""The output of `vla-attention capture status`: counts, missing episodes, and their writers."""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest
from msgspec.structs import replace

from tests.kit.stores import StoreSpec, write_store
from tests.kit.tokens import INSTRUCTIONS
from vla_attention.capture.__main__ import main
from vla_attention.capture.jobs.status import store_status
from vla_attention.capture.jobs.worker_log import (
    PlannedTask,
    WorkerLog,
    log_folder,
    planned_episodes,
    read_logs,
)
from vla_attention.schemas.errors import Note
from vla_attention.schemas.stores.locks import episode_locks
from vla_attention.schemas.stores.worker import Worker

SPEC = StoreSpec(tasks=(0, 2), episodes=2, replans=1, layers=(0,), heads=(0,), frames=False)
NODE = Worker("node7-11-ab", "node7", 11, "1", "pid:[1]", "99", "98_2", 0)


def planned(task: int, episodes: int) -> PlannedTask:
    return PlannedTask(task, INSTRUCTIONS[task], tuple(range(episodes)))


@pytest.fixture
def store(tmp_path) -> Path:
    return write_store(tmp_path / "a.zarr", spec=SPEC)


def test_without_logs_the_expected_number_is_unknown(store, capsys):
    status = store_status(store)
    assert [(task.task_id, task.committed, task.success, task.expected) for task in status.tasks] == [
        (0, 2, 1, None),
        (2, 2, 1, None),
    ]
    assert status.complete is None
    for task in status.tasks:
        folders = store.glob(f"episodes/task{task.task_id:03d}_*")
        assert task.bytes == sum(
            file.stat().st_size for folder in folders for file in folder.rglob("*") if file.is_file()
        )
    assert main(["status", str(store), "--check"]) == 0
    printed = capsys.readouterr().out
    assert "2 of ?" in printed
    assert "--expected" in printed


def test_an_episode_whose_process_has_ended_is_not_being_written(store, capsys):
    locks = episode_locks(store, NODE)
    for name in ("task000_episode007", "task000_episode008"):
        assert locks.acquire(name) is None
    os.utime(store / ".writing/task000_episode008.lock", (1000, 1000))
    assert main(["status", str(store)]) == 0
    lines = capsys.readouterr().out.splitlines()
    (writing,) = [line for line in lines if line.startswith("being written: ")]
    assert "task000_episode007 by node7 (job 98_2)" in writing
    (left,) = [line for line in lines if "task000_episode008" in line]
    assert "--resume" in left


def test_the_expected_number_can_be_given(store, capsys):
    status = store_status(store, expected=3)
    assert [task.missing for task in status.tasks] == [[2], [2]]
    assert main(["status", str(store), "--expected", "3", "--check"]) == 1
    assert re.search("task 0 .*1 of 3 .*: 2", capsys.readouterr().out)
    assert main(["status", str(store), "--expected", "3"]) == 0
    assert main(["status", str(store), "--expected", "2", "--check"]) == 0
    assert "complete" in capsys.readouterr().out


def test_plans_of_several_processes_add_up(store, capsys):
    first = WorkerLog(store, NODE, (planned(0, 2), planned(1, 2)))
    first.add("committed", "task000_episode001")
    first.add("stopped")
    WorkerLog(store, replace(NODE, tag="node8-5-cd", host="node8", job_name="98_0"), (planned(0, 4),))
    assert planned_episodes(read_logs(store)) == {0: {0, 1, 2, 3}, 1: {0, 1}}
    status = store_status(store)
    by_id = {task.task_id: task for task in status.tasks}
    assert by_id[0].missing == [2, 3]
    assert by_id[1].missing == [0, 1]
    assert (by_id[1].instruction, by_id[1].committed, by_id[1].last_by) == (INSTRUCTIONS[1], 0, "")
    assert by_id[2].expected is None  # in the store, but in no plan
    os.utime(store / "episodes/task000_episode000", (0, 0))
    assert store_status(store).tasks[0].last_by == "node7 (job 98_2)"
    assert main(["status", str(store)]) == 0
    assert "node7 (job 98_2)" in capsys.readouterr().out


def test_logs_of_an_earlier_store_with_the_same_name_are_ignored(store):
    WorkerLog(store, NODE, (planned(0, 50),))
    assert store_status(store).complete is False
    os.utime(store / "zarr.json", (1, 1))
    assert read_logs(store) == []
    assert store_status(store).complete is None


def test_damaged_logs_are_named_and_ignored(store):
    WorkerLog(store, NODE, (planned(0, 2), planned(2, 2)))
    (file,) = log_folder(store).iterdir()
    file.write_text(file.read_text() + '{"event": "committed", "epis')  # killed inside of a line
    assert store_status(store).complete
    WorkerLog(store, NODE, (planned(0, 3),)).add(
        "committed", "task000_episode000"
    )  # the next process has the same number
    file.write_text("{\n" + file.read_text())
    with pytest.warns(Note, match=f"2 lines|1 log .*{file.name}"):
        assert store_status(store).tasks[0].missing == [2]
