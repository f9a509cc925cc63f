"""The loop over episodes: it locks, records and commits one after another. SIGTERM drops the unfinished one.

Where the policy calls of an episode come from is the source's: a simulator (`simulator_source.py`), the calls of a
store (`rerun/`), the frames of a data set (`replay/`). A fault of one episode (`episode_faults.py`) drops that episode;
the loop goes on with the others.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import torch

from vla_attention.capture.environments.base import Task
from vla_attention.capture.jobs.termination import Terminated, Termination
from vla_attention.capture.jobs.worker_log import PlannedTask, WorkerLog
from vla_attention.capture.rollout.episode_faults import EPISODE_FAULTS, Faults, MachineBroken
from vla_attention.capture.rollout.progress import EpisodeProgress, Progress, Unit
from vla_attention.capture.store.replan_records import EpisodeStart
from vla_attention.capture.store.store_writer import RunStore
from vla_attention.schemas.command_line import format_bytes
from vla_attention.schemas.errors import listing, plural
from vla_attention.schemas.groupings.vocabulary import SceneObject
from vla_attention.schemas.stores.locks import Holder, Locks
from vla_attention.schemas.stores.store_format import StoreExists, episode_name
from vla_attention.schemas.stores.store_place import room_at

#: Seconds between two looks for an episode that another process is writing.
_LOOK_EVERY_S = 5.0


@dataclass(frozen=True)
class EpisodeJob:
    """An episode that is to be recorded. size: most units of it, for the progress; title: its name there."""

    task: Task
    episode_index: int
    size: int
    title: str

    @property
    def name(self) -> str:
        """The episode's name in the store."""
        return episode_name(self.task.task_id, self.episode_index)


def episode_start(
    task: Task,
    episode_index: int,
    machine: Mapping[str, str],
    *,
    state_digest: str,
    objects: tuple[SceneObject, ...],
    state_index: int | None = None,
) -> EpisodeStart:
    """Return what is known of an episode before its first replan.

    machine: provenance of this process. state_digest, state_index: of the initial state, whose index is the episode's
    where none is given.
    """
    return EpisodeStart(
        task_id=task.task_id,
        task_name=task.name,
        instruction=task.instruction,
        episode_index=episode_index,
        initial_state_index=episode_index if state_index is None else state_index,
        initial_state_digest=state_digest,
        objects=objects,
        provenance=dict(machine),
        task_family=task.task_family,
    )


@dataclass(frozen=True)
class EpisodeResult:
    """How an episode ended, and its folder in the store. success: None where it is not known."""

    task_id: int
    episode_index: int
    success: bool | None
    num_steps: int
    num_replans: int
    folder: Path


#: Called after each replan with (units of the episode done, replans done).
StepReport = Callable[[int, int], None]


class EpisodeSource(ABC):
    """Where the policy calls of episodes come from."""

    def begin(self, job: EpisodeJob) -> str | None:  # noqa: B027
        """Make ready for an episode; returns a line to print."""

    @abstractmethod
    def record(self, job: EpisodeJob, report: StepReport) -> EpisodeResult:
        """Make the calls of an episode, and commit it. An exception drops it."""

    def close(self) -> None:  # noqa: B027
        """Free what was made ready."""


def plan_of(jobs: Sequence[EpisodeJob]) -> tuple[PlannedTask, ...]:
    """Return the tasks of the jobs with the indices of their episodes, for the records of workers."""
    indices: dict[int, set[int]] = {}
    for job in jobs:
        indices.setdefault(job.task.task_id, set()).add(job.episode_index)
    tasks = {job.task.task_id: job.task for job in reversed(jobs)}
    return tuple(
        PlannedTask.of_episodes(number, tasks[number].name, tasks[number].instruction, indices[number])
        for number in sorted(indices)
    )


@dataclass
class EpisodeLoop(ABC):
    """Records the missing episodes of a store. Other processes may fill the same store at the same time.

    plan: for the log of this worker. unit: what is counted of an episode. With steps, the line of every episode says
    how it ended; where no environment runs, that was known before.
    """

    store: RunStore
    plan: tuple[PlannedTask, ...]
    termination: Termination
    unit: Unit
    log: WorkerLog = field(init=False)
    results: list[EpisodeResult] = field(default_factory=list, init=False)
    faults: Faults = field(default_factory=Faults, init=False)
    locks: Locks = field(init=False)
    progress: Progress = field(init=False)
    #: The episodes in progress and their units, for the message after SIGTERM.
    positions: dict[str, int] = field(default_factory=dict, init=False)

    def __post_init__(self) -> None:
        """Begin the log of this worker."""
        self.locks = self.store.locks
        self.log = WorkerLog(self.store.path, self.locks.worker, self.plan, torch.get_num_threads())

    def record_all(self, missing: Sequence[EpisodeJob]) -> list[EpisodeResult]:
        """Record the missing episodes, and return those that this process committed.

        After the return the store holds every episode of `missing` but those that `faults` names as dropped: the loop
        waits for an episode that another process is writing, and takes it over if that process dies.

        Raises:
            Terminated: after SIGTERM; the episodes in progress were dropped.
            MachineBroken: episode after episode met the same fault.
        """
        with ExitStack() as stack:
            stack.enter_context(self.locks)
            self.progress = Progress(len(missing), sum(job.size for job in missing), self.unit)
            stack.callback(self.progress.close)
            try:
                with self.opened():
                    self._record_until_complete(missing)
            except BaseException as error:
                self.log.end("stopped" if isinstance(error, (Terminated, KeyboardInterrupt)) else "failed")
                if isinstance(error, Terminated):
                    self.progress.say(self._describe_stop(missing))
                raise
        self.log.end("failed" if self.faults.dropped else "finished")
        return self.results

    @abstractmethod
    def opened(self) -> AbstractContextManager[None]:
        """Free what makes the calls at the end of the block."""

    @abstractmethod
    def attempt_all(self, missing: Sequence[EpisodeJob]) -> list[tuple[EpisodeJob, Holder]]:
        """Record every episode that nobody has; return those that other processes are writing."""

    def _record_until_complete(self, missing: Sequence[EpisodeJob]) -> None:
        left = self.attempt_all(missing)
        announced: set[str] = set()
        while left:
            new = [holder for _, holder in left if holder.name not in announced]
            if new:
                described = listing([holder.describe() for holder in new], 4)
                self.progress.say(f"Waiting for episodes that other processes are writing: {described}.")
                announced.update(holder.name for holder in new)
            time.sleep(_LOOK_EVERY_S)
            left = self.attempt_all([job for job, _ in left])

    def lock(self, job: EpisodeJob) -> bool | Holder:
        """Lock an episode: True if it is to be recorded, False if the store has it, else the holder of the lock."""
        # Check before and after locking: another process may commit the episode at any time before our lock.
        if self._has(job):
            self.progress.skip(job.name)
            return False
        holder = self.locks.acquire(job.name)
        if holder is not None:
            return holder
        if self._has(job):
            self.progress.skip(job.name)
            self.locks.release(job.name)
            return False
        return True

    def _has(self, job: EpisodeJob) -> bool:
        return self.store.has(job.task.task_id, job.episode_index)

    def note_commit(self, result: EpisodeResult) -> None:
        """Note that this process has committed an episode."""
        self.positions.pop(result.folder.name, None)
        self.results.append(result)
        self.log.add_commit(result.folder.name)
        self.faults.note_recorded()

    def show_end(self, job: EpisodeJob, progress: EpisodeProgress, result: EpisodeResult, num_bytes: int) -> None:
        """Show that an episode is committed, and after the first one what the others will take."""
        seconds, share = progress.seconds, 1.0
        if self.unit == "call":
            progress.drop()
        else:
            share = min(1.0, max(1, result.num_steps) / job.size)
            outcome = "success" if result.success else "no success"
            size = f"{result.num_replans} replans, {format_bytes(num_bytes)}"
            progress.end(f"{outcome} after {result.num_steps} steps, {size}", job.task.instruction)
        if len(self.results) == 1:
            self.progress.say_rest(seconds, num_bytes, share, self.at_a_time, room_at(self.store.path).bytes)

    @property
    def at_a_time(self) -> int:
        """Episodes that run at a time."""
        return 1

    def note_fault(self, name: str, progress: EpisodeProgress, error: Exception) -> bool:
        """Note that an episode was dropped after a fault; returns whether it shall be tried again.

        Raises:
            MachineBroken: episode after episode met the same fault.
        """
        self.positions.pop(name, None)
        try:
            again = self.faults.note(name, error)
        except MachineBroken:
            self.log.add_drop(name, str(error))
            raise
        if again:
            progress.put_back()
        else:
            progress.drop()
            self.log.add_drop(name, str(error))
        what_next = "The episode begins again." if again else "The episode is left out, and the run goes on."
        self.progress.say(f"{name}: {error} {what_next}")
        return again

    def note_refused(self, job: EpisodeJob, progress: EpisodeProgress, error: StoreExists) -> bool:
        """Note that another process has committed or taken an episode while this one recorded it.

        Returns whether it is to be looked at again: the other process has not committed it yet.
        """
        self.positions.pop(job.name, None)
        self.progress.say(f"{error} This process's copy was dropped.")
        again = not self._has(job)
        if again:
            progress.put_back()
        else:
            progress.drop()
        return again

    def _describe_stop(self, missing: Sequence[EpisodeJob]) -> str:
        committed = listing([result.folder.name for result in self.results], 40)
        left = sum(not self._has(job) for job in missing)
        running = [f"{name} at {self.unit} {done}" for name, done in sorted(self.positions.items())]
        dropped = f"dropped {listing(running, 40)}" if running else "no episode was in progress"
        return (
            f"Stopped by SIGTERM: {dropped}; committed {plural(len(self.results), 'episode')} ({committed}); "
            f"{left} of this process's {len(missing)} are missing."
        )


@dataclass
class OneByOneLoop(EpisodeLoop):
    """Records one episode after the other; `pipeline.py` has the loop with simulators in processes of their own."""

    source: EpisodeSource

    @contextmanager
    def opened(self) -> Iterator[None]:
        """Close the source at the end of the block."""
        try:
            yield
        finally:
            self.source.close()

    def attempt_all(self, missing: Sequence[EpisodeJob]) -> list[tuple[EpisodeJob, Holder]]:
        """Record every episode that nobody has; return those that other processes are writing."""
        return [(job, holder) for job in missing if (holder := self._attempt(job)) is not None]

    def _attempt(self, job: EpisodeJob) -> Holder | None:
        """Record an episode unless the store has it, or drop it after a fault.

        If another process is writing it, return who it is.
        """
        self.termination.check()
        locked = self.lock(job)
        if isinstance(locked, Holder):
            return locked
        again = False
        if locked:
            progress = self.progress.begin(job.title, job.size)
            try:
                again = self._record_once(job, progress)
            except EPISODE_FAULTS as error:
                again = self.note_fault(job.name, progress, error)
            finally:
                self.locks.release(job.name)
        self.termination.check()
        return self._attempt(job) if again else None

    def _record_once(self, job: EpisodeJob, progress: EpisodeProgress) -> bool:
        """Record an episode; returns whether another process took it and has not committed it."""
        if (line := self.source.begin(job)) is not None:
            self.progress.say(line)

        def report(done: int, replans: int) -> None:
            self.positions[job.name] = done
            progress.update(done, replans)

        self.positions[job.name] = 0
        with self.termination.only_at_checks():
            try:
                result = self.source.record(job, report)
            except StoreExists as error:
                return self.note_refused(job, progress, error)
            self.note_commit(result)
        size = sum(file.stat().st_size for file in result.folder.rglob("*") if file.is_file())
        self.show_end(job, progress, result, size)
        return False
