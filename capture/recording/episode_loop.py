"""Running episodes one after another: claimed, rolled out, committed, reported; and stopped without a trace of the unfinished one."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field

from tqdm import tqdm

from vla_attention.capture.environments.base import Environment, EnvironmentSettings, Task
from vla_attention.capture.environments.suites import Suite, make_environment
from vla_attention.capture.jobs.claims import Claims, Holder
from vla_attention.capture.jobs.job import Worker
from vla_attention.capture.jobs.run_records import RecordKeeper
from vla_attention.capture.jobs.termination import Terminated, Termination
from vla_attention.capture.policies.policy import Policy
from vla_attention.capture.recording.rollout import EpisodeResult, run_episode
from vla_attention.capture.store.store_writer import RunStore
from vla_attention.schemas.command_line import format_bytes
from vla_attention.schemas.errors import listing
from vla_attention.schemas.stores.store_format import StoreExists, episode_name

#: A task and the index of an episode of it.
Item = tuple[Task, int]

#: In a log file, how often an episode in progress is heard of. A GPU makes several replans a second.
_LOG_EVERY_S = 30.0
#: How often to look whether an episode that another process was writing is there.
_LOOK_EVERY_S = 5.0


def say(line: str) -> None:
    """Print one line at once, also when the output is a file that somebody follows."""
    print(line, flush=True)


@dataclass
class EpisodeLoop:
    """Runs what is missing into a store that other processes may be filling as well."""

    suite: Suite
    environment_settings: EnvironmentSettings
    policy: Policy
    store: RunStore
    worker: Worker
    record: RecordKeeper
    #: goes into every episode
    machine: dict[str, str]
    termination: Termination
    results: list[EpisodeResult] = field(default_factory=list, init=False)
    _number: int = field(default=0, init=False)
    _total: int = field(default=0, init=False)
    _environment: Environment | None = field(default=None, init=False)
    _task_id: int | None = field(default=None, init=False)
    #: the episode in flight and how far it is
    _at: str | None = field(default=None, init=False)

    def run(self, todo: Sequence[Item]) -> list[EpisodeResult]:
        """Run all of `todo`, and return what this process committed. When it returns, every episode of `todo` is in the store.

        Episodes that another process is writing are waited for, and taken over if it dies.

        Raises:
            Terminated: SIGTERM came; the episode in flight was dropped.
        """
        self._total = len(todo)
        with ExitStack() as stack:
            self._claims = stack.enter_context(Claims(self.store.path, self.worker))
            self._bar = tqdm(
                total=len(todo) * self.store.attributes.protocol.max_steps, unit="step", disable=not sys.stderr.isatty()
            )
            stack.callback(self._bar.close)
            stack.callback(self._close_environment)
            try:
                self._run_all(todo)
            except BaseException as error:
                self.record.ended("stopped" if isinstance(error, (Terminated, KeyboardInterrupt)) else "failed")
                if isinstance(error, Terminated):
                    self._say(self._stopped(todo))
                raise
        self.record.ended("finished")
        return self.results

    def _run_all(self, todo: Sequence[Item]) -> None:
        left = [(item, holder) for item in todo if (holder := self._attempt(item)) is not None]
        announced: set[str] = set()
        while left:
            news = [holder for _, holder in left if holder.episode not in announced]
            if news:
                self._say(
                    f"Waiting for what others are writing: {listing([holder.described() for holder in news], 4)}."
                )
                announced.update(holder.episode for holder in news)
            time.sleep(_LOOK_EVERY_S)
            left = [(item, holder) for item, _ in left if (holder := self._attempt(item)) is not None]

    def _attempt(self, item: Item) -> Holder | None:
        """Run an episode unless it is there; returns who has claimed it when somebody has."""
        task, episode = item
        name = episode_name(task.task_id, episode)
        self.termination.check()
        # Looked at before and after claiming: another process may have committed it since `todo` was made, or just now.
        if self.store.has(task.task_id, episode):
            self._skip(name)
            return None
        holder = self._claims.acquire(name)
        if holder is not None:
            return holder
        try:
            if self.store.has(task.task_id, episode):
                self._skip(name)
            else:
                self._run(task, episode)
        except StoreExists as error:
            self._say(f"{error} This process's copy was dropped.")
        finally:
            self._claims.release(name)
        self.termination.check()
        return None

    def _skip(self, name: str) -> None:
        self._number += 1
        self._say(f"[{self._number}/{self._total}] {name}: committed by another process.")

    def _run(self, task: Task, episode: int) -> None:
        environment = self._environment_of(task)
        protocol = self.store.attributes.protocol
        self._number += 1
        self._bar.set_description(f"task {task.task_id} episode {episode}")
        begun, steps_before = time.monotonic(), self._bar.n
        heard = begun

        def report(step: int, replans: int) -> None:
            nonlocal heard
            self._bar.update(steps_before + step - self._bar.n)
            now = time.monotonic()
            self._at = f"{episode_name(task.task_id, episode)} at step {step}"
            if self._bar.disable and now - heard >= _LOG_EVERY_S:
                heard = now
                say(
                    f"[{self._number}/{self._total}] task {task.task_id} episode {episode}: step {step} of at most "
                    f"{protocol.max_steps}, {replans} replans, {now - begun:.0f} s"
                )

        self._at = f"{episode_name(task.task_id, episode)} at step 0"
        with self.termination.only_at_checks():
            result = run_episode(
                environment, self.policy, self.store, task, episode, self.machine, report, self.termination.check
            )
            self._at = None
            self.results.append(result)
            self.record.committed(result.folder.name)
        self._bar.update(steps_before + protocol.max_steps - self._bar.n)
        size = sum(file.stat().st_size for file in result.folder.rglob("*") if file.is_file())
        self._say(
            f"[{self._number}/{self._total}] task {task.task_id} episode {episode}: "
            f"{'success' if result.success else 'no success'} after {result.num_steps} steps, {result.num_replans} replans, "
            f"{format_bytes(size)}, {time.monotonic() - begun:.0f} s ({task.instruction})"
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

    def _stopped(self, todo: Sequence[Item]) -> str:
        committed = listing([result.folder.name for result in self.results], 40)
        missing = sum(not self.store.has(task.task_id, episode) for task, episode in todo)
        dropped = f"dropped {self._at}" if self._at else "no episode was in flight"
        return (
            f"Stopped by SIGTERM: {dropped}; committed {len(self.results)} episodes ({committed}); "
            f"{missing} of this process's {len(todo)} are missing."
        )

    def _say(self, line: str) -> None:
        say(line) if self._bar.disable else self._bar.write(line)
