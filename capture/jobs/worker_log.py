"""The log of each worker: the episodes that it plans, has committed and has dropped, in a file beside the store.

The files are `NAME.zarr.log/HOST-JOB-PROCESS.jsonl`, with a line for each event; a worker adds lines to its own file.
`vla-attention capture status` reads from them how many episodes are expected, who committed each, and why one is
missing. No reader of a store needs them, and a lost line changes no number. They name machines and jobs, so a copy of a
store omits them. Deleting them loses nothing else.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterable
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

import msgspec

from vla_attention.capture.environments.base import Task
from vla_attention.schemas.errors import Note, listing, plural, shortened
from vla_attention.schemas.foreign_files import read_regular
from vla_attention.schemas.jsonable import Document
from vla_attention.schemas.stores.worker import Worker

#: Ending of the folder of logs. It may be deleted while no capture runs.
LOG_SUFFIX = ".log"
#: Characters of a fault's sentence that are kept: the error of a simulator may hold a page of text.
REASON_CHARACTERS = 1000

EventName = Literal["began", "committed", "dropped", "finished", "stopped", "failed"]


class PlannedTask(Document, frozen=True):
    """A task and the indices of its planned episodes, ascending."""

    task_id: int
    instruction: str
    indices: tuple[int, ...]


class Event(Document, frozen=True, omit_defaults=True):
    """One line of a log.

    at: time (ISO 8601, UTC). store: `store_identity`, which differs from that of a later store with the same name.
    by: the worker. plan: of `began`. episode: of `committed` and `dropped`. reason: the fault of a dropped one.
    """

    event: EventName
    at: str
    store: str
    by: str
    episode: str = ""
    reason: str = ""
    plan: tuple[PlannedTask, ...] = ()


class WorkerLog:
    """Writes the log of this worker, from the first event on at which the store exists."""

    def __init__(self, store: Path, worker: Worker, plan: tuple[PlannedTask, ...]) -> None:
        job = re.sub(r"[^0-9A-Za-z_]", "_", worker.job_name)
        self.file = log_folder(store) / f"{worker.host}-{job or 'none'}-{worker.process}.jsonl"
        self._store, self._by, self._plan, self._began = store, worker.describe(), plan, False
        self.add("began")

    def add(self, event: EventName, episode: str = "", reason: str = "") -> None:
        """Log an event."""
        try:
            store = store_identity(self._store)
        except FileNotFoundError:  # `va.record` makes a store with its first episode
            return
        written, at = "", datetime.now(UTC).isoformat(timespec="seconds")
        if not self._began:
            self._began = True
            self.file.parent.mkdir(exist_ok=True)
            # An earlier process with the same number may have been killed inside of a line.
            written = f"\n{_line(Event('began', at, store, self._by, plan=self._plan))}"
        if event != "began":
            written += _line(Event(event, at, store, self._by, episode, shortened(reason, REASON_CHARACTERS)))
        with self.file.open("a", encoding="utf-8") as file:
            file.write(written)


def _line(event: Event) -> str:
    return f"{msgspec.json.encode(event).decode()}\n"


def log_folder(store: Path) -> Path:
    """Return the folder of the logs. It is beside the store, so that a copy of the store omits it."""
    return store.with_name(store.name + LOG_SUFFIX)


def read_logs(store: Path) -> list[Event]:
    """Return what the workers of this store have logged, oldest first; not those of an earlier store of the same name.

    A line that cannot be read is no damage of the store: its file is named in a `Note`. The last line of a killed
    process may be half a line.
    """
    identity, folder = store_identity(store), log_folder(store)
    events: list[Event] = []
    unreadable: dict[str, str] = {}
    for file in sorted(folder.glob("*.jsonl")):
        try:
            *lines, _ = read_regular(file).split(b"\n")  # after the last line end there is nothing, or half a line
        except OSError as error:
            unreadable[file.name] = f" ({error.strerror or error})"
            continue
        for line in filter(None, lines):
            try:
                events.append(msgspec.json.decode(line, type=Event))
            except ValueError:
                unreadable[file.name] = ""
    if unreadable:
        named = listing([name + why for name, why in unreadable.items()], 3)
        warnings.warn(
            f"{plural(len(unreadable), 'log')} in {folder} cannot be read in full: {named}. Something of what "
            f"{'it says' if len(unreadable) == 1 else 'they say'} of plans and writers is missing here.",
            Note,
            stacklevel=2,
        )
    return sorted((event for event in events if event.store == identity), key=lambda event: event.at)


def plan_of(episodes: Iterable[tuple[Task, int]]) -> tuple[PlannedTask, ...]:
    """Return the tasks of episodes, each a task and an index, for the log of a worker."""
    tasks: dict[int, Task] = {}
    indices: dict[int, set[int]] = {}
    for task, index in episodes:
        tasks.setdefault(task.task_id, task)
        indices.setdefault(task.task_id, set()).add(index)
    return tuple(
        PlannedTask(number, tasks[number].instruction, tuple(sorted(indices[number]))) for number in sorted(tasks)
    )


def planned_episodes(events: Iterable[Event]) -> dict[int, set[int]]:
    """Return the indices of all episodes that workers planned, by task id."""
    planned: dict[int, set[int]] = {}
    for task in (task for event in events for task in event.plan):
        planned.setdefault(task.task_id, set()).update(task.indices)
    return planned


def store_identity(store: Path) -> str:
    """Return the time at which the root of the store was written. A later store with the same name has another."""
    # The root is written once, and moving or copying a store with its times keeps the time. Some file systems store
    # only microseconds.
    return str((store / "zarr.json").stat().st_mtime_ns // 1000)
