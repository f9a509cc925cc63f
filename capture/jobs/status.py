"""`vla-attention capture status`: the episodes of a store, the missing ones, and their writers. Reads only."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

from vla_attention.capture.environments.suites import SUITES
from vla_attention.capture.jobs.worker_log import Event, planned_episodes, read_logs
from vla_attention.schemas.command_line import format_bytes
from vla_attention.schemas.errors import BadArgument, listing, plural
from vla_attention.schemas.jsonable import to_json
from vla_attention.schemas.libero_physics import SimulatedScenes
from vla_attention.schemas.safe_text import visible
from vla_attention.schemas.stores.locks import Holder, episode_locks
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.store_format import is_episode_name, parse_episode_name
from vla_attention.schemas.stores.store_place import bytes_below
from vla_attention.schemas.stores.store_url import local_path
from vla_attention.schemas.stores.verify import DamagedEpisode, look_at


@dataclass
class TaskStatus:
    """One task.

    expected: number of episodes; None if neither the user nor a log gives it.
    committed, success, bytes: of the episodes that are not damaged. unknown: how many of them have no known outcome.
    last_at, last_by: time of the last commit (ISO 8601, UTC), and the worker; empty if no log names it.
    missing: indices of the expected episodes that the store lacks.
    damaged: episodes that are in the store, but cannot be used.
    dropped: missing episodes that a capture left out after a fault, each with the last one.
    """

    task_id: int
    instruction: str = ""
    expected: int | None = None
    committed: int = 0
    success: int = 0
    unknown: int = 0
    bytes: int = 0
    last_at: str = ""
    last_by: str = ""
    missing: list[int] = field(default_factory=list)
    damaged: list[DamagedEpisode] = field(default_factory=list)
    dropped: list[Event] = field(default_factory=list)

    def cells(self) -> tuple[str, ...]:
        """Return what the table has of it."""
        known = self.committed - self.unknown
        solved = f"{self.success} of {known}" if self.unknown else str(self.success)
        return (
            str(self.task_id),
            f"{self.committed} of {'?' if self.expected is None else self.expected}",
            solved if known else "-",
            format_bytes(self.bytes) if self.committed else "-",
            _plain_time(self.last_at) or "-",
            visible(self.last_by) or ("unknown" if self.committed else "-"),
            visible(self.instruction),
        )


@dataclass(frozen=True)
class StoreStatus:
    """A store. `writing`: who is writing which of its episodes. `scenes`: how they differ from the published ones, of
    `libero_physics`; empty where they do not.
    `told_later`: of how many episodes the outcome was told after the recording."""

    store: str
    suite: str
    policy: str
    tasks: tuple[TaskStatus, ...]
    writing: tuple[Holder, ...]
    scenes: str
    told_later: int = 0

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
        dropped = [
            f"dropped: {one.episode} by {one.by}, {_plain_time(one.at)}: {one.reason}"
            for task in self.tasks
            for one in task.dropped
        ]
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
    root, events = store.attributes, read_logs(path)
    planned = planned_episodes(events)
    # Of several events of one episode the last one counts.
    commits = {event.episode: event for event in events if event.event == "committed"}
    drops = {event.episode: event for event in events if event.event == "dropped" and is_episode_name(event.episode)}
    present = {stored.name: parse_episode_name(stored.name) for stored in store.episodes}
    drops = {name: drops[name] for name in sorted(drops) if name not in present}
    ids = {*planned, *(task for task, _ in present.values()), *(parse_episode_name(name)[0] for name in drops)}
    if expected is not None and not planned:
        ids |= set(range(next((suite.num_tasks for suite in SUITES if suite.name == root.protocol.suite), 0)))
    instructions = {task.task_id: task.instruction for event in events for task in event.plan}
    tasks = {task_id: TaskStatus(task_id, instructions.get(task_id, "")) for task_id in sorted(ids)}
    for task in tasks.values():
        wanted = planned.get(task.task_id) if expected is None else set(range(expected))
        if wanted is not None:
            task.expected = len(wanted)
            task.missing = sorted(wanted - {index for task_id, index in present.values() if task_id == task.task_id})
    for name, event in drops.items():
        tasks[parse_episode_name(name)[0]].dropped.append(event)
    scenes, told_later = SimulatedScenes(), 0
    for stored in store.episodes:
        task, folder = tasks[present[stored.name][0]], local_path(stored.folder)
        fault = look_at(store, stored, verify)
        if fault is not None:
            task.damaged.append(fault)
            continue
        scenes.add(root.protocol, stored.attributes)
        task.instruction = stored.attributes.instruction
        task.committed += 1
        task.success += stored.attributes.success is True
        task.unknown += stored.attributes.success is None
        told_later += stored.is_told
        task.bytes += bytes_below(folder)
        commit = commits.get(stored.name)
        at = commit.at if commit else datetime.fromtimestamp(folder.stat().st_mtime, UTC).isoformat(timespec="seconds")
        if at > task.last_at:
            task.last_at, task.last_by = at, commit.by if commit else ""
    writing = tuple(episode_locks(path).holders())
    told = scenes.describe(path.name)
    return StoreStatus(
        str(path), root.protocol.suite, root.policy.name, tuple(tasks.values()), writing, told, told_later
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


def _plain_time(at: str) -> str:
    """A time of the logs without its offset, which is that of UTC."""
    return at.removesuffix("+00:00").replace("T", " ")


def _text(status: StoreStatus) -> str:
    tasks = status.tasks
    committed, size = sum(task.committed for task in tasks), sum(task.bytes for task in tasks)
    begun = sum(task.committed > 0 for task in tasks)
    lines = [
        f"{status.store}: {status.suite}, policy {status.policy}, {plural(committed, 'episode')} of "
        f"{plural(begun, 'task')}, {format_bytes(size)}",
        *filter(None, [status.scenes]),
    ]
    rows: list[tuple[str, ...]] = [("task", "episodes", "solved", "size", "last written (UTC)", "by", "instruction")]
    rows += [task.cells() for task in tasks]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines += ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
    if status.told_later:
        lines.append(f"The outcomes of {plural(status.told_later, 'episode')} were told after the recording.")
    lines += status.lacking_lines()
    if any(task.damaged for task in tasks):
        lines.append(f"Damaged episodes are moved aside by: vla-attention capture verify {status.store} --repair")
    if status.complete is None:
        lines.append("The expected number of episodes is unknown; give it with --expected N.")
    elif status.complete:
        lines.append("complete: the store has every expected episode.")
    lines += [
        f"left unfinished (its process ended or is silent; a run with --resume begins it anew): {holder.name}"
        if holder.is_dead
        else f"being written: {holder.describe()}"
        for holder in status.writing
    ]
    return "\n".join(map(visible, lines))
