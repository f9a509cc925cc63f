"""The loop over episodes, with a source that is made up: what other processes have, faults, and the worker's record."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import pytest

from tests.kit.stores import StoreSpec, root_attributes, write_episode
from vla_attention.capture.engine.loop import EpisodeLoop
from vla_attention.capture.engine.progress import Unit
from vla_attention.capture.engine.simulation import SimulationFailed
from vla_attention.capture.engine.source import Committed, Episode, EpisodeJob, Outcome, Source
from vla_attention.capture.environments.base import Task
from vla_attention.capture.jobs.worker_log import plan_of, read_logs
from vla_attention.capture.recording.finite_numbers import NumbersNotFinite
from vla_attention.capture.store.store_writer import RunStore, open_run
from vla_attention.schemas.stop_signals import Terminated, Termination
from vla_attention.schemas.stores.locks import episode_locks
from vla_attention.schemas.stores.reader import open_store

SPEC = StoreSpec(tasks=(0, 1), episodes=3, replans=1, layers=(0,), heads=(0,), frames=False)
TASKS = [Task("made_up", number, f"task_{number}", f"lift cube {number}", 0) for number in range(2)]
JOBS = [EpisodeJob(task, index, 4, f"task {task.task_id} episode {index}") for task in TASKS for index in range(2)]


@dataclass
class MadeUpEpisode(Episode):
    """Is committed at the second look; its first one is one step."""

    source: MadeUpSource
    job: EpisodeJob
    done: int = 0

    def poll(self) -> Committed | None:
        if not self.done:
            self.done = 2
            return None
        self.source.before(self.job.name)
        folder = write_episode(self.source.store, SPEC, self.job.task.task_id, self.job.episode_index)
        return Committed(Outcome(True, 4), 1, folder)

    def close(self, error: Exception | None = None) -> None:
        self.source.tried.append(f"{self.job.name} closed")


class MadeUpSource(Source):
    """Writes made-up episodes. before: called before each is written, with its name."""

    caller = None

    def __init__(self, store: RunStore, before: Callable[[str], object] = lambda name: None) -> None:
        self.store, self.before = store, before
        self.tried: list[str] = []

    def open(self, job: EpisodeJob) -> MadeUpEpisode:
        self.tried.append(job.name)
        if job is JOBS[0]:
            self.say(f"{job.name} begins")
        return MadeUpEpisode(self, job)

    def close(self) -> None:
        self.tried.append("closed")


@pytest.fixture
def store(tmp_path: Path) -> RunStore:
    return open_run(tmp_path / "a.zarr", root_attributes(SPEC), "new", durable=False)


def loop_of(store: RunStore, source: MadeUpSource, unit: Unit = "step") -> EpisodeLoop:
    return EpisodeLoop(store, plan_of((job.task, job.episode_index) for job in JOBS), Termination(), unit, source)


def test_every_episode_is_recorded_and_noted(store: RunStore, capsys: pytest.CaptureFixture[str]) -> None:
    source = MadeUpSource(store)
    results = loop_of(store, source).record_all(JOBS)
    names = [job.name for job in JOBS]
    assert [result.folder.name for result in results] == names
    assert source.tried == [*(word for name in names for word in (name, f"{name} closed")), "closed"]
    events = [(event.event, event.episode) for event in read_logs(store.path)]
    assert events == [("began", ""), *(("committed", name) for name in names), ("finished", "")]
    assert not (store.path / ".writing").exists()
    said = capsys.readouterr().out
    assert said.count(f"{names[0]} begins") == 1
    assert len(re.findall("success .*4 steps, 1 replan", said)) == 4


@pytest.mark.parametrize("unit", ["step", "call"])
def test_what_is_left_is_said_once_and_not_of_one_episode(store: RunStore, capsys, monkeypatch, unit: Unit) -> None:
    monkeypatch.setenv("SLURM_JOB_END_TIME", "1")
    loop_of(store, MadeUpSource(store), unit).record_all(JOBS[:1])
    assert "first episode" not in capsys.readouterr().out
    loop_of(store, MadeUpSource(store), unit).record_all(JOBS[1:])
    said = capsys.readouterr().out
    assert said.count("first episode took") == 1
    assert re.search("2 more episodes, 1 at", said)
    assert "NOT" in said


def test_what_another_process_commits_meanwhile_is_refused(store: RunStore, capsys) -> None:
    source = MadeUpSource(store, lambda name: name == JOBS[2].name and write_episode(store, SPEC, 1, 0))
    loop = loop_of(store, source)
    assert len(loop.record_all(JOBS)) == 3
    assert loop.faults.dropped == {}
    assert "dropped" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("error", "tries"),
    [
        (SimulationFailed("it broke."), 2),
        (NumbersNotFinite("NaN.", passing=True), 2),
        (NumbersNotFinite("NaN.", passing=False), 1),
    ],
)
def test_a_fault_costs_its_episode(store: RunStore, capsys, error: Exception, tries: int) -> None:
    def fail(name: str) -> None:
        if name == JOBS[1].name:
            assert [holder.name for holder in episode_locks(store.path).holders()] == [name]
            raise error

    source = MadeUpSource(store, fail)
    loop = loop_of(store, source)
    assert len(loop.record_all(JOBS)) == 3
    assert source.tried.count(JOBS[1].name) == tries
    assert loop.faults.dropped == {JOBS[1].name: str(error)}
    events = read_logs(store.path)
    assert [event.episode for event in events if event.event == "dropped"] == [JOBS[1].name]
    assert events[-1].event == "failed"
    said = capsys.readouterr().out
    assert said.count("begins again") == tries - 1
    assert said.count("left out") == 1
    assert not (store.path / ".writing").exists()


def test_sigterm_drops_one_episode_and_says_what_is_missing(store: RunStore, capsys) -> None:
    def stop(name: str) -> None:
        if name == JOBS[1].name:
            raise Terminated

    source = MadeUpSource(store, stop)
    with pytest.raises(Terminated):
        loop_of(store, source, "call").record_all(JOBS)
    assert source.tried[-1] == "closed"
    said = capsys.readouterr().out
    assert re.search(rf"SIGTERM: .*{JOBS[1].name} .* 2; .* 1 episode \({JOBS[0].name}\); 3 of", said)
    assert read_logs(store.path)[-1].event == "stopped"
    assert not (store.path / ".writing").exists()


@pytest.mark.parametrize("committed", [True, False])
def test_an_episode_that_another_process_took_over_is_looked_at_again(
    store: RunStore, capsys, monkeypatch, committed: bool
) -> None:
    """This process stood still in the second episode; the other one commits it at once, or gives it up later."""
    other, name = open_run(store.path, root_attributes(SPEC), "resume", durable=False), JOBS[1].name

    def stand_still(of: str) -> None:
        if of == name and not taken:
            taken.append(name)
            os.utime(store.path / ".writing" / f"{name}.lock", (1000, 1000))
            assert other.locks.acquire(name) is None
            if committed:
                write_episode(other, SPEC, 0, 1)

    taken: list[str] = []
    monkeypatch.setattr(
        "vla_attention.capture.engine.loop.time",
        SimpleNamespace(sleep=lambda seconds: other.locks.release(name)),
    )
    source = MadeUpSource(store, stand_still)
    loop = loop_of(store, source)
    loop.record_all(JOBS)
    other.locks.release(name)
    assert sorted(result.folder.name for result in loop.results) == sorted(
        job.name for job in JOBS if job.name != name or not committed
    )
    assert [episode.name for episode in open_store(store.path).episodes] == sorted(job.name for job in JOBS)
    assert loop.faults.dropped == {}
    said = capsys.readouterr().out
    assert said.count("copy was dropped") == 1
    assert ("Waiting" in said) is not committed
