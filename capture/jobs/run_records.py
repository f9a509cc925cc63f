"""What each capture process plans and has done, in a small file of its own beside the store.

`NAME.zarr.jobs/runs/*.json`: one file per process, which alone writes it, whole each time. From these `vla-capture status` knows how
many episodes are expected and who wrote the last one. They are notes for people: no reader of a store needs them, they name
machines and jobs, and they stay behind when a store is copied. Deleting them loses nothing but these notes.
"""

from __future__ import annotations

import json
import os
import shutil
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

from vla_attention.capture.jobs.claims import jobs_folder
from vla_attention.capture.jobs.job import Worker
from vla_attention.schemas.jsonable import MalformedDocument, from_json, to_json


@dataclass(frozen=True)
class PlannedTask:
    """A task and how many episodes of it are wanted: those with the indices 0 to `episodes` - 1."""

    task_id: int
    name: str
    instruction: str
    episodes: int


@dataclass(frozen=True)
class Commit:
    """An episode that the process committed, and when (ISO 8601, UTC)."""

    episode: str
    at: str


@dataclass(frozen=True)
class RunRecord:
    """The notes of one process. `store` tells a store from one that was made later under the same name."""

    store: str
    worker: Worker
    plan: tuple[PlannedTask, ...]
    began: str
    state: Literal["running", "finished", "stopped", "failed"]
    committed: tuple[Commit, ...] = ()


class RecordKeeper:
    """Keeps the record of this process up to date on disk."""

    def __init__(self, store: Path, worker: Worker, plan: tuple[PlannedTask, ...]) -> None:
        self.file = runs_folder(store) / f"{datetime.now(UTC):%Y%m%dT%H%M%S}-{worker.tag}.json"
        self.record = RunRecord(store_identity(store), worker, plan, now(), "running")
        self._write()

    def committed(self, episode: str) -> None:
        """Note an episode."""
        self.record = replace(self.record, committed=(*self.record.committed, Commit(episode, now())))
        self._write()

    def ended(self, state: Literal["finished", "stopped", "failed"]) -> None:
        """Note how the process ended."""
        self.record = replace(self.record, state=state)
        self._write()

    def _write(self) -> None:
        self.file.parent.mkdir(parents=True, exist_ok=True)
        temporary = self.file.with_name(f".{self.file.name}.partial")
        temporary.write_text(json.dumps(to_json(self.record), indent=1), encoding="utf-8")
        os.replace(temporary, self.file)


def runs_folder(store: Path) -> Path:
    """Where the records are."""
    return jobs_folder(store) / "runs"


def read_records(store: Path) -> list[RunRecord]:
    """The records of this very store, oldest first; those of an earlier one under the same name are left out."""
    identity, records = store_identity(store), []
    for file in sorted(runs_folder(store).glob("*.json")):
        try:
            record = from_json(RunRecord, json.loads(file.read_text(encoding="utf-8")))
        except (OSError, ValueError, MalformedDocument):
            continue  # a note that cannot be read is no fault of the store
        if record.store == identity:
            records.append(record)
    return records


def planned_tasks(records: list[RunRecord]) -> dict[int, PlannedTask]:
    """Every planned task by its id, with the most episodes that any process planned."""
    plan: dict[int, PlannedTask] = {}
    for task in (task for record in records for task in record.plan):
        known = plan.get(task.task_id)
        if known is None or task.episodes > known.episodes:
            plan[task.task_id] = task
    return plan


def forget_runs(store: Path) -> None:
    """Remove every record and claim: the store is about to be replaced."""
    shutil.rmtree(jobs_folder(store), ignore_errors=True)


def store_identity(store: Path) -> str:
    """What a store made later under the same name does not share: when its root was written."""
    # Set once, and kept when a store is moved or copied with its times; microseconds, because not every file system keeps more.
    return str((store / "zarr.json").stat().st_mtime_ns // 1000)


def now() -> str:
    """The time, ISO 8601 in UTC."""
    return datetime.now(UTC).isoformat(timespec="seconds")
