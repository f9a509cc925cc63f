"""The record of each worker: the episodes that it plans, has committed and has dropped, in a file beside the store.

The files are `NAME.zarr.jobs/runs/*.json`. Each worker writes only its own file, and always the whole file.
`vla-capture status` reads from them how many episodes are expected, who committed each, and why one is missing. No
reader of a store needs them. They name machines and jobs, so a copy of a store omits them. Deleting them loses nothing
else.
"""

from __future__ import annotations

import json
import os
import warnings
from collections.abc import Set
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

from vla_attention.schemas.documents import decode_json
from vla_attention.schemas.errors import Note, listing, plural, shortened
from vla_attention.schemas.jsonable import MalformedDocument, from_json, to_json
from vla_attention.schemas.limit_checks import check_at_most
from vla_attention.schemas.limits import DOCUMENT_BYTES, PLANNED_EPISODES, RECORDS_BYTES
from vla_attention.schemas.regular_files import read_regular
from vla_attention.schemas.stores.claims import JOBS_SUFFIX, job_files, jobs_folder
from vla_attention.schemas.stores.partial_folders import no_link
from vla_attention.schemas.stores.store_format import StoreError
from vla_attention.schemas.stores.worker import Worker

#: Characters of a fault's sentence that are kept: the error of a simulator may hold a page of text, and a worker writes
#: its whole record after every episode.
REASON_CHARACTERS = 1000


@dataclass(frozen=True)
class PlannedTask:
    """A task and its planned episodes: so many, with these `indices`, or from 0 on where none are given."""

    task_id: int
    name: str
    instruction: str
    episodes: int
    indices: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        """Check the number, by which missing episodes are counted."""
        check_at_most(f"The number of episodes of task {self.task_id}", self.episodes, PLANNED_EPISODES)
        if self.indices and len(self.indices) != self.episodes:
            raise ValueError(f"task {self.task_id} has {len(self.indices)} indices for {self.episodes} episodes")

    @classmethod
    def of_episodes(cls, task_id: int, name: str, instruction: str, indices: Set[int]) -> PlannedTask:
        """Plan the episodes with these indices."""
        counted = indices == set(range(len(indices)))
        return cls(task_id, name, instruction, len(indices), () if counted else tuple(sorted(indices)))

    @property
    def wanted(self) -> Set[int]:
        """The indices of the planned episodes."""
        return set(self.indices or range(self.episodes))

    def with_those_of(self, other: PlannedTask) -> PlannedTask:
        """Return the task with the episodes of both plans; they are of one task."""
        if not self.indices and not other.indices:  # without counting, however many they are
            return max(self, other, key=lambda task: task.episodes)
        return PlannedTask.of_episodes(self.task_id, self.name, self.instruction, self.wanted | other.wanted)


@dataclass(frozen=True)
class Commit:
    """An episode that the worker committed, and the time (ISO 8601, UTC)."""

    episode: str
    at: str


@dataclass(frozen=True)
class Drop:
    """An episode that the worker left out after a fault, the time (ISO 8601, UTC), and the sentence of the fault."""

    episode: str
    at: str
    reason: str


@dataclass(frozen=True)
class WorkerRecord:
    """The record of one worker.

    store: `store_identity` of its store, which differs from that of a later store with the same name.
    dropped: each episode once, with its last fault.
    threads: number of processor threads that its policy computes with; 0 in a record that does not state it.
    """

    store: str
    worker: Worker
    plan: tuple[PlannedTask, ...]
    began: str
    state: Literal["running", "finished", "stopped", "failed"]
    committed: tuple[Commit, ...] = ()
    threads: int = 0
    dropped: tuple[Drop, ...] = ()


class RecordWriter:
    """Writes the record of this worker after every change, from the first on at which the store exists."""

    def __init__(self, store: Path, worker: Worker, plan: tuple[PlannedTask, ...], threads: int = 0) -> None:
        self.file = records_folder(store) / f"{datetime.now(UTC):%Y%m%dT%H%M%S}-{worker.tag}.json"
        self._store = store
        self.record = WorkerRecord("", worker, plan, now(), "running", threads=threads)
        self._write()

    @property
    def worker(self) -> Worker:
        """The process of the record."""
        return self.record.worker

    def add_commit(self, episode: str) -> None:
        """Record that the worker has committed an episode."""
        self.record = replace(self.record, committed=(*self.record.committed, Commit(episode, now())))
        self._write()

    def add_drop(self, episode: str, reason: str) -> None:
        """Record that the worker left an episode out after a fault."""
        others = (drop for drop in self.record.dropped if drop.episode != episode)
        drop = Drop(episode, now(), shortened(reason, REASON_CHARACTERS))
        self.record = replace(self.record, dropped=(*others, drop))
        self._write()

    def end(self, state: Literal["finished", "stopped", "failed"]) -> None:
        """Record how the worker ended."""
        self.record = replace(self.record, state=state)
        self._write()

    def _write(self) -> None:
        if not self.record.store:
            try:
                self.record = replace(self.record, store=store_identity(self._store))
            except FileNotFoundError:  # `va.record` makes a store with its first episode
                return
        self.file.parent.mkdir(parents=True, exist_ok=True)
        temporary = self.file.with_name(f".{self.file.name}.partial")
        temporary.write_text(json.dumps(to_json(self.record), indent=1), encoding="utf-8")
        os.replace(temporary, self.file)


def records_folder(store: Path) -> Path:
    """Return the folder of the records; raises `StoreError` where it is a link."""
    return no_link(jobs_folder(store) / "runs")


def read_records(store: Path) -> list[WorkerRecord]:
    """Return the records of this store, oldest first; without those of an earlier store with the same name.

    A record that cannot be read is no damage of the store: it is named in a `Note`.

    Raises:
        StoreError: there are more records, or more bytes in them, than captures write.
    """
    identity, folder, taken = store_identity(store), records_folder(store), 0
    records, unreadable = [], []
    for name in sorted(name for name in job_files(folder) if name.endswith(".json") and not name.startswith(".")):
        try:
            content = read_regular(folder / name, DOCUMENT_BYTES, follow=False)
            taken += len(content)
            if taken > RECORDS_BYTES:
                raise StoreError(
                    f"The records in {folder} have more than {RECORDS_BYTES:,} bytes, which is more than captures "
                    "write. Delete the folder when no capture runs; no reader of the store needs it."
                )
            record = from_json(WorkerRecord, decode_json(content))
        except StoreError:
            raise
        except (OSError, ValueError, MalformedDocument) as error:
            unreadable.append(f"{name} ({error.strerror or error})" if isinstance(error, OSError) else name)
            continue
        if record.store == identity:
            records.append(record)
    if unreadable:
        count = plural(len(unreadable), "record")
        warnings.warn(
            f"{count} in {folder} cannot be read and {'is' if len(unreadable) == 1 else 'are'} ignored: "
            f"{listing(unreadable, 3)}. What {'it says' if len(unreadable) == 1 else 'they say'} of plans and writers "
            "is missing here.",
            Note,
            stacklevel=2,
        )
    return records


def planned_tasks(records: list[WorkerRecord]) -> dict[int, PlannedTask]:
    """Return every planned task by its id, with all episodes that workers planned.

    Raises:
        StoreError: together they have more episodes than are counted one by one.
    """
    plan: dict[int, PlannedTask] = {}
    for task in (task for record in records for task in record.plan):
        plan[task.task_id] = plan[task.task_id].with_those_of(task) if task.task_id in plan else task
    if (planned := sum(task.episodes for task in plan.values())) > PLANNED_EPISODES:
        raise StoreError(
            f"The workers' records plan {planned:,} episodes; expected at most {PLANNED_EPISODES:,}. Delete "
            f"NAME{JOBS_SUFFIX} beside the store when no capture runs; no reader of the store needs it."
        )
    return plan


def store_identity(store: Path) -> str:
    """Return the time at which the root of the store was written. A later store with the same name has another."""
    # The root is written once, and moving or copying a store with its times keeps the time. Some file systems store
    # only microseconds.
    return str((store / "zarr.json").stat().st_mtime_ns // 1000)


def now() -> str:
    """Return the time, ISO 8601 in UTC."""
    return datetime.now(UTC).isoformat(timespec="seconds")
