"""The log of each worker: the episodes that it plans, has committed and has dropped, in a file beside the store.

The files are `NAME.zarr.log/HOST-JOB-PROCESS.jsonl`, with a line for each event; a worker adds lines to its own file.
`vla-attention capture status` reads from them how many episodes are expected, who committed each, and why one is
missing. No reader of a store needs them, and a lost line changes no number. They name machines and jobs, so a copy of a
store omits them. Deleting them loses nothing else.
"""

from __future__ import annotations

import json
import os
import re
import warnings
from collections.abc import Mapping, Set
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

from msgspec.structs import replace

from vla_attention.schemas.errors import Note, listing, plural, shortened
from vla_attention.schemas.jsonable import Document, MalformedDocument, decode_json, from_json, to_json
from vla_attention.schemas.stores.worker import Worker

#: Ending of the folder of logs. It may be deleted while no capture runs.
LOG_SUFFIX = ".log"
#: Characters of a fault's sentence that are kept: the error of a simulator may hold a page of text.
REASON_CHARACTERS = 1000


class PlannedTask(Document, frozen=True):
    """A task and its planned episodes: so many, with these `indices`, or from 0 on where none are given."""

    task_id: int
    name: str
    instruction: str
    episodes: int
    indices: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        """Check the number, by which missing episodes are counted."""
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


class Drop(Document, frozen=True):
    """An episode that a worker left out after a fault, the time (ISO 8601, UTC), and the sentence of the fault."""

    episode: str
    at: str
    reason: str


class WorkerRecord(Document, frozen=True):
    """What a worker has logged.

    store: `store_identity` of its store, which differs from that of a later store with the same name.
    began: time (ISO 8601, UTC). committed: episode -> time. dropped: in their order.
    """

    store: str
    worker: Worker
    plan: tuple[PlannedTask, ...]
    began: str
    state: str = "running"
    committed: tuple[tuple[str, str], ...] = ()
    dropped: tuple[Drop, ...] = ()

    def after(self, event: Mapping[str, Any]) -> WorkerRecord:
        """Return the record after one more line of the log."""
        match event:
            case {"event": "committed", "episode": str(episode), "at": str(at)}:
                return replace(self, committed=(*self.committed, (episode, at)))
            case {"event": "dropped", "episode": str(episode), "at": str(at), "reason": str(reason)}:
                return replace(self, dropped=(*self.dropped, Drop(episode, at, reason)))
            case {"event": "ended", "state": str(state)}:
                return replace(self, state=state)
        raise ValueError("a line of another kind")


class WorkerLog:
    """Writes the log of this worker, from the first event on at which the store exists."""

    def __init__(self, store: Path, worker: Worker, plan: tuple[PlannedTask, ...]) -> None:
        job = re.sub(r"[^0-9A-Za-z_]", "_", worker.job_name)
        self.file = log_folder(store) / f"{worker.host}-{job or 'none'}-{worker.process}.jsonl"
        self.worker = worker
        self._store = store
        self._began: dict[str, Any] | None = {"worker": to_json(worker), "plan": to_json(plan), "began": now()}
        self._begin()

    def add_commit(self, episode: str) -> None:
        """Log that the worker has committed an episode."""
        self._add({"event": "committed", "episode": episode, "at": now()})

    def add_drop(self, episode: str, reason: str) -> None:
        """Log that the worker left an episode out after a fault."""
        self._add({"event": "dropped", "episode": episode, "at": now(), "reason": shortened(reason, REASON_CHARACTERS)})

    def end(self, state: Literal["finished", "stopped", "failed"]) -> None:
        """Log how the worker ended."""
        self._add({"event": "ended", "at": now(), "state": state})

    def _begin(self) -> None:
        if self._began is None:
            return
        try:
            began = {"event": "began", "store": store_identity(self._store), **self._began}
        except FileNotFoundError:  # `va.record` makes a store with its first episode
            return
        self.file.parent.mkdir(exist_ok=True)
        self._began = None
        # An earlier process with the same number may have been killed inside of a line.
        self._write(began, before="\n")

    def _add(self, event: Mapping[str, Any]) -> None:
        self._begin()
        if self._began is None:
            self._write(event)

    def _write(self, event: Mapping[str, Any], before: str = "") -> None:
        with self.file.open("a", encoding="utf-8") as file:
            file.write(f"{before}{json.dumps(event)}\n")


def log_folder(store: Path) -> Path:
    """Return the folder of the logs. It is beside the store, so that a copy of the store omits it."""
    return store.with_name(store.name + LOG_SUFFIX)


def read_logs(store: Path) -> list[WorkerRecord]:
    """Return what the workers of this store have logged, oldest first; not those of an earlier store of the same name.

    A line that cannot be read is no damage of the store: its file is named in a `Note`. The last line of a killed
    process may be half a line.
    """
    identity, folder = store_identity(store), log_folder(store)
    records: list[WorkerRecord] = []
    unreadable: list[str] = []
    for file in _log_files(folder):
        try:
            content = file.read_bytes()
        except OSError as error:
            unreadable.append(f"{file.name} ({error.strerror or error})")
            continue
        found, whole = _read_log(content)
        records += [record for record in found if record.store == identity]
        unreadable += [] if whole else [file.name]
    if unreadable:
        count = plural(len(unreadable), "log")
        warnings.warn(
            f"{count} in {folder} cannot be read in full: {listing(unreadable, 3)}. Something of what "
            f"{'it says' if len(unreadable) == 1 else 'they say'} of plans and writers is missing here.",
            Note,
            stacklevel=2,
        )
    return sorted(records, key=lambda record: record.began)


def _log_files(folder: Path) -> list[Path]:
    with suppress(FileNotFoundError, NotADirectoryError), os.scandir(folder) as entries:
        return sorted(Path(entry.path) for entry in entries if entry.name.endswith(".jsonl"))
    return []


def _read_log(content: bytes) -> tuple[list[WorkerRecord], bool]:
    """The records of a log, and whether every whole line of it could be read."""
    records: list[WorkerRecord] = []
    whole = True
    *lines, _ = content.split(b"\n")  # after the last line end there is nothing, or half a line
    for line in filter(None, lines):
        try:
            event = decode_json(line)
            if isinstance(event, dict) and event.get("event") == "began":
                records.append(from_json(WorkerRecord, {name: event[name] for name in event if name != "event"}))
            else:
                records[-1] = records[-1].after(event)
        except (ValueError, IndexError, MalformedDocument):
            whole = False
    return records, whole


def planned_tasks(records: list[WorkerRecord]) -> dict[int, PlannedTask]:
    """Return every planned task by its id, with all episodes that workers planned."""
    plan: dict[int, PlannedTask] = {}
    for task in (task for record in records for task in record.plan):
        plan[task.task_id] = plan[task.task_id].with_those_of(task) if task.task_id in plan else task
    return plan


def store_identity(store: Path) -> str:
    """Return the time at which the root of the store was written. A later store with the same name has another."""
    # The root is written once, and moving or copying a store with its times keeps the time. Some file systems store
    # only microseconds.
    return str((store / "zarr.json").stat().st_mtime_ns // 1000)


def now() -> str:
    """Return the time, ISO 8601 in UTC."""
    return datetime.now(UTC).isoformat(timespec="seconds")
