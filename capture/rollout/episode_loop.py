"""The loop over episodes: it claims, records and commits one after another. SIGTERM drops the unfinished one.

A fault of one episode (`episode_faults.py`) drops that episode; the loop goes on with the others.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field

from vla_attention.capture.environments.base import Environment, EnvironmentSettings, Suite, Task
from vla_attention.capture.environments.suites import make_environment
from vla_attention.capture.jobs.termination import Terminated, Termination
from vla_attention.capture.jobs.worker_records import RecordWriter
from vla_attention.capture.rollout.episode import EpisodeResult, EpisodeRun, episode_title, record_episode
from vla_attention.capture.rollout.episode_faults import EPISODE_FAULTS, Faults, MachineBroken
from vla_attention.capture.rollout.progress import EpisodeProgress, Progress
from vla_attention.capture.rollout.simulation import SimulationFailed, naming_the_simulator
from vla_attention.schemas.command_line import format_bytes
from vla_attention.schemas.errors import listing
from vla_attention.schemas.plurals import plural
from vla_attention.schemas.stores.claims import Claims, Holder
from vla_attention.schemas.stores.store_format import StoreExists, episode_name
from vla_attention.schemas.stores.worker import Worker

#: A task and the index of one of its episodes.
TaskEpisode = tuple[Task, int]

#: Seconds between two looks for an episode that another process is writing.
_LOOK_EVERY_S = 5.0


@dataclass
class EpisodeLoop:
    """Records the missing episodes of a store. Other processes may fill the same store at the same time.

    Here the simulator is in this process and one episode follows the other; `pipeline.py` has the loop with simulators
    in processes of their own.
    """

    suite: Suite
    environment_settings: EnvironmentSettings
    run: EpisodeRun
    worker: Worker
    record: RecordWriter
    termination: Termination
    results: list[EpisodeResult] = field(default_factory=list, init=False)
    faults: Faults = field(default_factory=Faults, init=False)
    claims: Claims = field(init=False)
    progress: Progress = field(init=False)
    #: The episodes in progress and their steps, for the message after SIGTERM.
    positions: dict[str, int] = field(default_factory=dict, init=False)
    _environment: Environment | None = field(default=None, init=False)
    _task_id: int | None = field(default=None, init=False)

    def record_all(self, missing: Sequence[TaskEpisode]) -> list[EpisodeResult]:
        """Record the missing episodes, and return those that this process committed.

        After the return the store holds every episode of `missing` but those that `faults` names as dropped: the loop
        waits for an episode that another process is writing, and takes it over if that process dies.

        Raises:
            Terminated: after SIGTERM; the episodes in progress were dropped.
            MachineBroken: a fault came again and again that every episode would meet.
        """
        with ExitStack() as stack:
            self.claims = stack.enter_context(Claims(self.run.store.path, self.worker))
            self.progress = Progress(len(missing), self.run.store.attributes.protocol.max_steps)
            stack.callback(self.progress.close)
            try:
                with self.simulators():
                    self._record_until_complete(missing)
            except BaseException as error:
                self.record.end("stopped" if isinstance(error, (Terminated, KeyboardInterrupt)) else "failed")
                if isinstance(error, Terminated):
                    self.progress.say(self._describe_stop(missing))
                raise
        self.record.end("failed" if self.faults.dropped else "finished")
        return self.results

    @contextmanager
    def simulators(self) -> Iterator[None]:
        """Free what simulates at the end of the block."""
        try:
            yield
        finally:
            self._close_environment()

    def _record_until_complete(self, missing: Sequence[TaskEpisode]) -> None:
        left = self.attempt_all(missing)
        announced: set[str] = set()
        while left:
            new = [holder for _, holder in left if holder.episode not in announced]
            if new:
                described = listing([holder.describe() for holder in new], 4)
                self.progress.say(f"Waiting for episodes that other processes are writing: {described}.")
                announced.update(holder.episode for holder in new)
            time.sleep(_LOOK_EVERY_S)
            left = self.attempt_all([episode for episode, _ in left])

    def attempt_all(self, missing: Sequence[TaskEpisode]) -> list[tuple[TaskEpisode, Holder]]:
        """Record every episode that nobody has; return those that other processes have claimed."""
        return [(episode, holder) for episode in missing if (holder := self._attempt(*episode)) is not None]

    def claim(self, task: Task, episode: int) -> bool | Holder:
        """Claim an episode: True if it is to be recorded, False if the store has it, else the holder of the claim."""
        name = episode_name(task.task_id, episode)
        # Check before and after claiming: another process may commit the episode at any time before our claim.
        if self.run.store.has(task.task_id, episode):
            self.progress.skip(name)
            return False
        holder = self.claims.acquire(name)
        if holder is not None:
            return holder
        if self.run.store.has(task.task_id, episode):
            self.progress.skip(name)
            self.claims.release(name)
            return False
        return True

    def _attempt(self, task: Task, episode: int) -> Holder | None:
        """Record an episode unless the store has it, or drop it after a fault.

        If another process has claimed it, return that claim's holder.
        """
        self.termination.check()
        claimed = self.claim(task, episode)
        if isinstance(claimed, Holder):
            return claimed
        again = False
        if claimed:
            try:
                again = self._record(task, episode)
            finally:
                self.claims.release(episode_name(task.task_id, episode))
        self.termination.check()
        return self._attempt(task, episode) if again else None

    def _record(self, task: Task, episode: int) -> bool:
        """Record an episode; returns whether it shall be tried again after a fault."""
        progress = self.progress.begin(task.task_id, episode)
        try:
            self._record_once(task, episode, progress)
        except EPISODE_FAULTS as error:
            if isinstance(error, SimulationFailed):  # what it has left is not to be trusted
                with suppress(Exception):
                    self._close_environment()
            return self.note_fault(episode_name(task.task_id, episode), progress, error)
        return False

    def _record_once(self, task: Task, episode: int, progress: EpisodeProgress) -> None:
        name = episode_name(task.task_id, episode)
        with naming_the_simulator(episode_title(self.run.store, task, episode)):
            environment = self._environment_of(task)
            missing = environment.missing_resets(episode, self.run.store.attributes.protocol.seed)

        def report(step: int, replans: int) -> None:
            self.positions[name] = step
            progress.update(step, replans)

        if missing:
            self.say_resets(name, missing)
        self.positions[name] = 0
        with self.termination.only_at_checks():
            try:
                result = record_episode(self.run, environment, task, episode, report)
            except StoreExists as error:
                self.note_refused(name, progress, error)
                return
            self.note_commit(result)
        size = sum(file.stat().st_size for file in result.folder.rglob("*") if file.is_file())
        progress.end(describe_result(result, size), task.instruction)

    def say_resets(self, name: str, missing: int) -> None:
        """Say that an episode needs resets of other episodes first."""
        self.progress.say(
            f"{name}: the published furniture depends on the resets of earlier episodes; making {missing} first."
        )

    def note_commit(self, result: EpisodeResult) -> None:
        """Note that this process has committed an episode."""
        self.positions.pop(result.folder.name, None)
        self.results.append(result)
        self.record.add_commit(result.folder.name)
        self.faults.note_recorded()

    def note_fault(self, name: str, progress: EpisodeProgress, error: Exception) -> bool:
        """Note that an episode was dropped after a fault; returns whether it shall be tried again.

        Raises:
            MachineBroken: the fault came again and again, and every episode would meet it.
        """
        self.positions.pop(name, None)
        try:
            again = self.faults.note(name, error)
        except MachineBroken:
            self.record.add_drop(name, str(error))
            raise
        if again:
            progress.put_back()
        else:
            progress.drop()
            self.record.add_drop(name, str(error))
        what_next = "The episode begins again." if again else "The episode is left out, and the run goes on."
        self.progress.say(f"{name}: {error} {what_next}")
        return again

    def note_refused(self, name: str, progress: EpisodeProgress, error: StoreExists) -> None:
        """Note that another process has committed an episode while this one recorded it."""
        self.positions.pop(name, None)
        progress.drop()
        self.progress.say(f"{error} This process's copy was dropped.")

    def _environment_of(self, task: Task) -> Environment:
        if self._environment is None or self._task_id != task.task_id:
            self._close_environment()
            self._environment = make_environment(self.suite, task.task_id, self.environment_settings)
            self._task_id = task.task_id
        return self._environment

    def _close_environment(self) -> None:
        if self._environment is not None:
            environment, self._environment = self._environment, None
            environment.close()

    def _describe_stop(self, missing: Sequence[TaskEpisode]) -> str:
        committed = listing([result.folder.name for result in self.results], 40)
        left = sum(not self.run.store.has(task.task_id, episode) for task, episode in missing)
        running = [f"{name} at step {step}" for name, step in sorted(self.positions.items())]
        dropped = f"dropped {listing(running, 40)}" if running else "no episode was in progress"
        return (
            f"Stopped by SIGTERM: {dropped}; committed {plural(len(self.results), 'episode')} ({committed}); "
            f"{left} of this process's {len(missing)} are missing."
        )


def describe_result(result: EpisodeResult, num_bytes: int) -> str:
    """Return how an episode ended as text."""
    outcome = "success" if result.success else "no success"
    return f"{outcome} after {result.num_steps} steps, {result.num_replans} replans, {format_bytes(num_bytes)}"
