"""`vla-attention capture status`: the episodes of a store, the missing ones, and their writers. Reads only."""

from __future__ import annotations

import json
from collections.abc import Sequence, Set
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from vla_attention.capture.environments.suites import SUITES
from vla_attention.capture.jobs.worker_log import REASON_CHARACTERS, WorkerRecord, planned_tasks, read_logs
from vla_attention.schemas.command_line import format_bytes
from vla_attention.schemas.errors import BadArgument, listing, plural, shortened
from vla_attention.schemas.jsonable import to_json
from vla_attention.schemas.safe_text import visible
from vla_attention.schemas.stores.locks import Holder, episode_locks
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.store_format import is_episode_name, parse_episode_name
from vla_attention.schemas.stores.store_url import local_path
from vla_attention.schemas.stores.verify import DamagedEpisode, look_at


@dataclass(frozen=True)
class EpisodeStatus:
    """One committed episode that is whole, as far as was looked.

    at: time of the commit (ISO 8601, UTC).
    by: the worker; empty if no log names it.
    """

    episode: int
    success: bool | None
    bytes: int
    at: str
    by: str


@dataclass(frozen=True)
class DroppedEpisode:
    """An episode that the store lacks, because a worker left it out after a fault.

    at: time of the last such fault (ISO 8601, UTC). by: the worker. reason: the sentence of the fault.
    """

    name: str
    at: str
    by: str
    reason: str

    def describe(self) -> str:
        """Return the episode and what happened as one line."""
        return f"{self.name} by {self.by}, {_plain_time(self.at)}: {self.reason}"


@dataclass(frozen=True)
class TaskStatus:
    """One task.

    expected: number of episodes; None if neither the user nor a log gives it.
    committed, success, bytes: of the episodes that are not damaged. unknown: how many of them have no known outcome.
    missing: indices of the expected episodes that the store lacks.
    damaged: episodes that are in the store, but cannot be used.
    dropped: missing episodes that a capture left out after a fault, with the reason.
    """

    task_id: int
    instruction: str
    committed: int
    expected: int | None
    success: int
    bytes: int
    last_at: str
    last_by: str
    missing: tuple[int, ...]
    damaged: tuple[DamagedEpisode, ...]
    unknown: int = 0
    dropped: tuple[DroppedEpisode, ...] = ()


@dataclass(frozen=True)
class StoreStatus:
    """A store. `writing`: who is writing which of its episodes."""

    store: str
    suite: str
    policy: str
    tasks: tuple[TaskStatus, ...]
    writing: tuple[Holder, ...]

    @property
    def complete(self) -> bool | None:
        """Whether the store has all expected episodes, undamaged; None if their number is unknown for a task."""
        if any(task.missing or task.damaged for task in self.tasks):
            return False
        return None if any(task.expected is None for task in self.tasks) or not self.tasks else True

    def lacking_lines(self) -> list[str]:
        """Return a line for every task with missing episodes, and for every dropped and every damaged episode."""
        missing = [
            f"missing: task {task.task_id} lacks {len(task.missing)} of {task.expected} episodes: "
            f"{listing(task.missing, 20)}"
            for task in self.tasks
            if task.missing
        ]
        dropped = [f"dropped: {episode.describe()}" for task in self.tasks for episode in task.dropped]
        return missing + dropped + [f"damaged: {episode.describe()}" for task in self.tasks for episode in task.damaged]


def store_status(path: Path, expected: int | None = None, verify: bool = False) -> StoreStatus:
    """Return the status of a store.

    expected: episodes per task; None takes the numbers that the workers planned.
    verify: read every byte to find damaged episodes, instead of seals, presence and sizes only.

    Raises:
        BadArgument: `expected` is below 1.
        StoreNotFound: nothing exists at `path`.
        StoreError: something other than a store exists there.
    """
    if expected is not None and expected < 1:
        raise BadArgument(f"Cannot use --expected {expected}; expected at least 1.")
    store = open_store(path)
    root = store.attributes
    records = read_logs(path)
    plan = planned_tasks(records)
    writers = {episode: (at, record.worker) for record in records for episode, at in record.committed}
    episodes: dict[int, list[EpisodeStatus]] = {}
    damaged: dict[int, list[DamagedEpisode]] = {}
    instructions: dict[int, str] = {task.task_id: task.instruction for task in plan.values()}
    for stored in store.episodes:
        task_id, index = parse_episode_name(stored.name)
        fault = look_at(store, stored, verify)
        if fault is not None:
            damaged.setdefault(task_id, []).append(fault)
            continue
        at, worker = writers.get(stored.name, ("", None))
        instructions[task_id] = stored.attributes.instruction
        episodes.setdefault(task_id, []).append(
            EpisodeStatus(
                episode=index,
                success=stored.attributes.success,
                bytes=sum(file.stat().st_size for file in local_path(stored.folder).rglob("*") if file.is_file()),
                at=at or _time_of(local_path(stored.folder)),
                by=worker.describe() if worker else "",
            )
        )
    dropped = _dropped(records, {stored.name for stored in store.episodes})
    ids = set(plan) | set(episodes) | set(damaged) | set(dropped)
    if expected is not None and not plan:
        ids |= set(range(next((suite.num_tasks for suite in SUITES if suite.name == root.protocol.suite), 0)))
    tasks = []
    for task_id in sorted(ids):
        committed = episodes.get(task_id, [])
        planned = plan[task_id].wanted if task_id in plan else None
        wanted = planned if expected is None else set(range(expected))
        faulty = damaged.get(task_id, [])
        present = {parse_episode_name(episode.name)[1] for episode in faulty} | {
            episode.episode for episode in committed
        }
        last = max(committed, key=lambda episode: episode.at, default=None)
        tasks.append(
            TaskStatus(
                task_id=task_id,
                instruction=instructions.get(task_id, ""),
                committed=len(committed),
                expected=None if wanted is None else len(wanted),
                success=sum(episode.success is True for episode in committed),
                bytes=sum(episode.bytes for episode in committed),
                last_at=last.at if last else "",
                last_by=last.by if last else "",
                missing=tuple(sorted((wanted or set()) - present)),
                damaged=tuple(faulty),
                unknown=sum(episode.success is None for episode in committed),
                dropped=tuple(dropped.get(task_id, ())),
            )
        )
    return StoreStatus(
        str(path), root.protocol.suite, root.policy.name, tuple(tasks), tuple(episode_locks(path).holders())
    )


def print_status(stores: Sequence[Path], expected: int | None, as_json: bool, check: bool, verify: bool = False) -> int:
    """Print the status of stores, as text or as JSON.

    Returns:
        The exit code: 1 if `check` is set and an expected episode is missing or one is damaged, else 0.
    """
    statuses = [store_status(store, expected, verify) for store in stores]
    if as_json:
        print(json.dumps([to_json(status) | {"complete": status.complete} for status in statuses], indent=1))
    else:
        print("\n\n".join(_text(status) for status in statuses))
    return 1 if check and any(status.complete is False for status in statuses) else 0


def _dropped(records: Sequence[WorkerRecord], present: Set[str]) -> dict[int, list[DroppedEpisode]]:
    """The episodes that workers dropped and that the store lacks, by task, each with its last fault."""
    last: dict[str, DroppedEpisode] = {}
    for record in records:
        for drop in record.dropped:
            known, reason = last.get(drop.episode), shortened(drop.reason, 2 * REASON_CHARACTERS)
            if drop.episode not in present and is_episode_name(drop.episode) and (known is None or known.at <= drop.at):
                last[drop.episode] = DroppedEpisode(drop.episode, drop.at, record.worker.describe(), reason)
    by_task: dict[int, list[DroppedEpisode]] = {}
    for name in sorted(last):
        by_task.setdefault(parse_episode_name(name)[0], []).append(last[name])
    return by_task


def _plain_time(at: str) -> str:
    """A time of the logs without its offset, which is that of UTC."""
    return at.removesuffix("+00:00").replace("T", " ")


def _time_of(folder: Path) -> str:
    return datetime.fromtimestamp(folder.stat().st_mtime, UTC).isoformat(timespec="seconds")


def _solved(task: TaskStatus) -> str:
    """Number of solved episodes, and of how many where not every outcome is known."""
    known = task.committed - task.unknown
    if not known:
        return "-"
    return f"{task.success} of {known}" if task.unknown else str(task.success)


def _cells(task: TaskStatus) -> tuple[str, ...]:
    return (
        str(task.task_id),
        f"{task.committed} of {'?' if task.expected is None else task.expected}",
        _solved(task),
        format_bytes(task.bytes) if task.committed else "-",
        _plain_time(task.last_at) or "-",
        visible(task.last_by) or ("unknown" if task.committed else "-"),
        visible(task.instruction),
    )


def _text(status: StoreStatus) -> str:
    tasks = status.tasks
    committed, size = sum(task.committed for task in tasks), sum(task.bytes for task in tasks)
    begun = sum(task.committed > 0 for task in tasks)
    lines = [
        f"{status.store}: {status.suite}, policy {status.policy}, {plural(committed, 'episode')} of "
        f"{plural(begun, 'task')}, {format_bytes(size)}"
    ]
    rows = [("task", "episodes", "solved", "size", "last written (UTC)", "by", "instruction"), *map(_cells, tasks)]
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    lines += ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
    lines += status.lacking_lines()
    if any(task.damaged for task in tasks):
        lines.append(f"Damaged episodes are moved aside by: vla-attention capture verify {status.store} --repair")
    if status.complete is None:
        lines.append("The expected number of episodes is unknown; give it with --expected N.")
    elif status.complete:
        lines.append("complete: the store has every expected episode.")
    lines += [f"being written: {holder.describe()}" for holder in status.writing]
    return "\n".join(map(visible, lines))
