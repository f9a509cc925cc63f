"""The loop over episodes: it claims, records and commits one after another. SIGTERM drops the unfinished one."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field

from vla_attention.capture.environments.base import Environment, EnvironmentSettings, Suite, Task
from vla_attention.capture.environments.suites import make_environment
from vla_attention.capture.jobs.claims import Claims, Holder
from vla_attention.capture.jobs.termination import Terminated, Termination
from vla_attention.capture.jobs.worker import Worker
from vla_attention.capture.jobs.worker_records import RecordWriter
from vla_attention.capture.rollout.episode import EpisodeResult, EpisodeRun, record_episode
from vla_attention.capture.rollout.progress import Progress
from vla_attention.schemas.command_line import format_bytes
from vla_attention.schemas.errors import listing
from vla_attention.schemas.stores.store_format import StoreExists, episode_name

#: A task and the index of one of its episodes.
TaskEpisode = tuple[Task, int]

#: Seconds between two looks for an episode that another process is writing.
_LOOK_EVERY_S = 5.0


@dataclass
class EpisodeLoop:
    """Records the missing episodes of a store. Other processes may fill the same store at the same time."""

    suite: Suite
    environment_settings: EnvironmentSettings
    run: EpisodeRun
    worker: Worker
    record: RecordWriter
    termination: Termination
    results: list[EpisodeResult] = field(default_factory=list, init=False)
    _environment: Environment | None = field(default=None, init=False)
    _task_id: int | None = field(default=None, init=False)
    #: The current episode and its step, for the message after SIGTERM; None between episodes.
    _position: str | None = field(default=None, init=False)

    def record_all(self, missing: Sequence[TaskEpisode]) -> list[EpisodeResult]:
        """Record the missing episodes, and return those that this process committed.

        After the return the store holds every episode of `missing`: the loop waits for an episode that another process
        is writing, and takes it over if that process dies.

        Raises:
            Terminated: after SIGTERM; the current episode was dropped.
        """
        with ExitStack() as stack:
            self._claims = stack.enter_context(Claims(self.run.store.path, self.worker))
            self._progress = Progress(len(missing), self.run.store.attributes.protocol.max_steps)
            stack.callback(self._progress.close)
            stack.callback(self._close_environment)
            try:
                self._record_until_complete(missing)
            except BaseException as error:
                self.record.end("stopped" if isinstance(error, (Terminated, KeyboardInterrupt)) else "failed")
                if isinstance(error, Terminated):
                    self._progress.say(self._describe_stop(missing))
                raise
        self.record.end("finished")
        return self.results

    def _record_until_complete(self, missing: Sequence[TaskEpisode]) -> None:
        left = [(episode, holder) for episode in missing if (holder := self._attempt(*episode)) is not None]
        announced: set[str] = set()
        while left:
            new = [holder for _, holder in left if holder.episode not in announced]
            if new:
                described = listing([holder.describe() for holder in new], 4)
                self._progress.say(f"Waiting for episodes that other processes are writing: {described}.")
                announced.update(holder.episode for holder in new)
            time.sleep(_LOOK_EVERY_S)
            left = [(episode, holder) for episode, _ in left if (holder := self._attempt(*episode)) is not None]

    def _attempt(self, task: Task, episode: int) -> Holder | None:
        """Record an episode unless the store has it. If another process has claimed it, return that claim's holder."""
        name = episode_name(task.task_id, episode)
        self.termination.check()
        # Check before and after claiming: another process may commit the episode at any time before our claim.
        if self.run.store.has(task.task_id, episode):
            self._progress.skip(name)
            return None
        holder = self._claims.acquire(name)
        if holder is not None:
            return holder
        try:
            if self.run.store.has(task.task_id, episode):
                self._progress.skip(name)
            else:
                self._record(task, episode)
        except StoreExists as error:
            self._progress.say(f"{error} This process's copy was dropped.")
        finally:
            self._claims.release(name)
        self.termination.check()
        return None

    def _record(self, task: Task, episode: int) -> None:
        environment = self._environment_of(task)
        name = episode_name(task.task_id, episode)
        self._progress.begin(task.task_id, episode)

        def report(step: int, replans: int) -> None:
            self._position = f"{name} at step {step}"
            self._progress.update(step, replans)

        missing = environment.missing_resets(episode, self.run.store.attributes.protocol.seed)
        if missing:
            self._progress.say(
                f"{name}: the published furniture depends on the resets of earlier episodes; making {missing} first."
            )
        self._position = f"{name} at step 0"
        with self.termination.only_at_checks():
            result = record_episode(self.run, environment, task, episode, report)
            self._position = None
            self.results.append(result)
            self.record.add_commit(result.folder.name)
        size = sum(file.stat().st_size for file in result.folder.rglob("*") if file.is_file())
        outcome = "success" if result.success else "no success"
        self._progress.end(
            f"{outcome} after {result.num_steps} steps, {result.num_replans} replans, {format_bytes(size)}",
            task.instruction,
        )

    def _environment_of(self, task: Task) -> Environment:
        if self._environment is None or self._task_id != task.task_id:
            self._close_environment()
            self._environment = make_environment(self.suite, task.task_id, self.environment_settings)
            self._task_id = task.task_id
        return self._environment

    def _close_environment(self) -> None:
        if self._environment is not None:
            self._environment.close()
            self._environment = None

    def _describe_stop(self, missing: Sequence[TaskEpisode]) -> str:
        committed = listing([result.folder.name for result in self.results], 40)
        left = sum(not self.run.store.has(task.task_id, episode) for task, episode in missing)
        dropped = f"dropped {self._position}" if self._position else "no episode was in progress"
        return (
            f"Stopped by SIGTERM: {dropped}; committed {len(self.results)} episodes ({committed}); "
            f"{left} of this process's {len(missing)} are missing."
        )
