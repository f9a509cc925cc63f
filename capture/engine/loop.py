"""The loop over episodes, one or many at a time, whatever their source: locks, policy calls, commits, faults.

Where episodes run in several processes, these, the policy and the writing overlap. With batches of 1 the policy is
called for one episode after the other: every call has the input that it has alone, and every episode is the same to the
bit. A larger batch changes the last bits of what the policy computes.

A fault of one episode (`faults.py`) drops that episode; the loop goes on with the others. SIGTERM drops the unfinished
ones.
"""

from __future__ import annotations

import contextlib
import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import partial
from multiprocessing import Pipe
from multiprocessing.connection import Connection, wait

from vla_attention.capture.effects.measurement import EpisodeEffectsMeasured
from vla_attention.capture.engine.call import Caller, PolicyCall, RecordedCall, record_of
from vla_attention.capture.engine.faults import EPISODE_FAULTS, Faults, SimulatorDied
from vla_attention.capture.engine.plumbing import look_at_words
from vla_attention.capture.engine.progress import EpisodeProgress, Progress, Unit
from vla_attention.capture.engine.source import Committed, Episode, EpisodeJob, Outcome, Source, SourceLost
from vla_attention.capture.engine.writing import EpisodeInBackground, WritingThread
from vla_attention.capture.jobs.worker_log import PlannedTask, WorkerLog
from vla_attention.capture.recording.finite_numbers import NumbersNotFinite
from vla_attention.capture.store.episode_writer import EpisodeTaken
from vla_attention.capture.store.store_writer import RunStore
from vla_attention.schemas.command_line import format_bytes
from vla_attention.schemas.errors import listing, plural
from vla_attention.schemas.plumbing import Plumbing
from vla_attention.schemas.stop_signals import Terminated, Termination
from vla_attention.schemas.stores.locks import Held, Holder
from vla_attention.schemas.stores.store_format import StoreExists
from vla_attention.schemas.stores.store_place import room_at

#: Seconds between two looks for an episode that another process is writing.
_LOOK_EVERY_S = 5.0
#: Seconds between two looks whether SIGTERM came, while all episodes wait.
_WAIT_S = 0.5
#: How often an episode is begun again after the end of what it ran in.
MOST_RESTARTS = 2

_WHY_KILLED = "Signal 9 mostly means that the memory was full; a smaller --num-envs needs less. "


@dataclass(eq=False)
class _Running:
    """An episode that is under way, or whose commit waits for the thread."""

    job: EpisodeJob
    progress: EpisodeProgress
    episode: Episode | None = None
    writer: EpisodeInBackground | None = None
    effects: EpisodeEffectsMeasured | None = None
    call: PolicyCall | None = None
    num_replans: int = 0
    begun_times: int = 1

    def close(self, error: Exception | None = None) -> None:
        """Give back what it runs in, and forget what was not committed."""
        episode, writer, self.episode, self.writer = self.episode, self.writer, None, None
        if episode is not None:
            episode.close(error)
        if writer is not None:
            writer.drop()


@dataclass
class EpisodeLoop:
    """Records the missing episodes of a store. Other processes may fill the same store at the same time.

    plan: for the log of this worker. unit: what is counted of an episode. With steps, the line of every episode says
    how it ended; where no environment runs, that was known before. policy_batch: most calls that are made as one batch;
    what is ready is taken, without waiting for more.
    """

    store: RunStore
    plan: tuple[PlannedTask, ...]
    termination: Termination
    unit: Unit
    source: Source
    policy_batch: int = 1
    log: WorkerLog = field(init=False)
    results: list[Committed] = field(default_factory=list, init=False)
    faults: Faults = field(default_factory=Faults, init=False)
    progress: Progress = field(init=False)
    #: Episodes that are to be recorded and have not begun.
    _left: list[EpisodeJob] = field(default_factory=list, init=False)
    _running: list[_Running] = field(default_factory=list, init=False)
    #: Those of them that have a policy call, in the order in which it came.
    _ready: deque[_Running] = field(default_factory=deque, init=False)
    _committing: list[_Running] = field(default_factory=list, init=False)
    #: What was said of instructions that do not get through.
    _said_of_words: set[str] = field(default_factory=set, init=False)

    def __post_init__(self) -> None:
        """Begin the log of this worker."""
        #: The first planned episode of each task: at its first call it is looked at whether the instruction gets
        #: through, so that an episode is the same whichever process recorded it, and however often it was begun.
        self._of_words = {(task.task_id, task.indices[0]) for task in self.plan if task.indices}
        self.log = WorkerLog(self.store.path, self.store.locks.worker, self.plan)

    def record_all(self, missing: Sequence[EpisodeJob]) -> list[Committed]:
        """Record the missing episodes, and return what this process committed.

        After the return the store holds every episode of `missing` but those that `faults` names as dropped: the loop
        waits for an episode that another process is writing, and takes it over if that process dies.

        Raises:
            Terminated: after SIGTERM; the episodes in progress were dropped.
            MachineBroken: episode after episode met the same fault.
        """
        with ExitStack() as stack:
            stack.enter_context(self.store.locks)
            self.progress = Progress(len(missing), sum(job.size for job in missing), self.unit)
            stack.callback(self.progress.close)
            self.source.say = self.progress.say
            try:
                with self._opened():
                    self._record_until_complete(missing)
            except BaseException as error:
                self.log.add("stopped" if isinstance(error, (Terminated, KeyboardInterrupt)) else "failed")
                if isinstance(error, Terminated):
                    self.progress.say(self._describe_stop(missing))
                raise
        self.log.add("failed" if self.faults.dropped else "finished")
        return self.results

    @contextmanager
    def _opened(self) -> Iterator[None]:
        """Start the thread that writes; end it and all episodes at the end of the block."""
        self._woken, wake = Pipe(duplex=False)
        with ExitStack() as stack:
            stack.enter_context(self._woken)
            stack.enter_context(wake)
            stack.callback(self._note_commits)  # those that were completed while the thread ended
            self._thread = stack.enter_context(WritingThread(partial(_wake, wake), self.termination.check))
            stack.callback(self.source.close)
            stack.callback(self._close_episodes)
            yield

    def _close_episodes(self) -> None:
        for running in self._running:
            running.close()

    def _record_until_complete(self, missing: Sequence[EpisodeJob]) -> None:
        left = self._attempt_all(missing)
        announced: set[str] = set()
        while left:
            new = [holder for _, holder in left if holder.name not in announced]
            if new:
                described = listing([holder.describe() for holder in new], 4)
                self.progress.say(f"Waiting for episodes that other processes are writing: {described}.")
                announced.update(holder.name for holder in new)
            time.sleep(_LOOK_EVERY_S)
            left = self._attempt_all([job for job, _ in left])

    def _attempt_all(self, missing: Sequence[EpisodeJob]) -> list[tuple[EpisodeJob, Holder]]:
        """Record every episode that nobody has; return those that other processes are writing."""
        self.termination.check()
        self._left = list(missing)
        elsewhere: list[tuple[EpisodeJob, Holder]] = []
        with self.termination.only_at_checks():
            while self._left or self._running or self._committing:
                self.termination.check()
                self._note_written()
                # Before the policy computes: simulators reset and step meanwhile.
                self._begin(elsewhere)
                if self._running or self._committing:
                    self._poll()
                    self._call_policy()
        self.termination.check()
        return elsewhere

    def _begin(self, elsewhere: list[tuple[EpisodeJob, Holder]]) -> None:
        """Begin as many episodes as the source has room for; adds to `elsewhere`."""
        while self._left and len(self._running) < self.source.capacity:
            place = self.source.choose(self._left)
            if place is None:
                return
            job = self._left.pop(place)
            locked = self._lock(job)
            if isinstance(locked, Holder):
                elsewhere.append((job, locked))
            elif locked:
                running = _Running(job, self.progress.begin(job.title, job.size))
                self._running.append(running)
                self._open(running)
                self.termination.check()

    def _lock(self, job: EpisodeJob) -> bool | Holder:
        """Lock an episode: True if it is to be recorded, False if the store has it, else the holder of the lock."""
        # Check before and after locking: another process may commit the episode at any time before our lock.
        if self._has(job):
            self.progress.skip(job.name)
            return False
        # `va.record`, which calls for such a source, makes the store with its first call.
        if self.source.caller is None and not self.store.path.exists():
            return True
        holder = self.store.locks.acquire(job.name)
        if holder is not None:
            return holder
        if self._has(job):
            self.progress.skip(job.name)
            self.store.locks.release(job.name)
            return False
        return True

    def _has(self, job: EpisodeJob) -> bool:
        return self.store.has(job.task.task_id, job.episode_index)

    def _open(self, running: _Running) -> None:
        with self._dropping_faults(running):
            running.episode = self.source.open(running.job)

    def _poll(self) -> None:
        """Let every episode go on that has no policy call; if all of them wait, wait for one of them."""
        waiting = [running for running in self._running if running.call is None]
        if not self._ready and all(running.episode and running.episode.connection for running in waiting):
            heard = [running.episode.connection for running in waiting if running.episode]
            wait([each for each in (*heard, self._woken) if each is not None], _WAIT_S)
        while self._woken.poll():
            self._woken.recv_bytes()
        for running in waiting:
            with self._dropping_faults(running):
                self._go_on(running)

    def _go_on(self, running: _Running) -> None:
        if running.episode is None:
            return
        match running.episode.poll():
            case PolicyCall() as call:
                running.call = call
                self._ready.append(running)
            case Outcome() as outcome:
                self._commit(running, outcome)
                return
            case Committed() as committed:
                self._running.remove(running)
                running.close()
                self._note_commit(running, committed)
                return
            case None:
                if (how := running.episode.overdue()) is not None:
                    raise SourceLost(how)
        if (done := running.episode.done) != running.progress.done:
            running.progress.update(done, running.num_replans)

    def _commit(self, running: _Running, outcome: Outcome) -> None:
        if running.writer is None or running.episode is None:
            raise ValueError("an episode without replans cannot be committed")
        self._running.remove(running)
        self._committing.append(running)
        running.episode.close()
        running.episode = None
        running.writer.commit(outcome)

    def _call_policy(self) -> None:
        """Make the next policy calls, and let their episodes go on before the calls are stored."""
        if not self._ready:
            return
        caller = self.source.caller
        assert caller is not None, "this source makes its own calls"
        batch = [self._ready.popleft() for _ in range(min(self.policy_batch, len(self._ready)))]
        calls = [running.call for running in batch if running.call is not None]
        made = caller.make(calls)
        looked = [self._look_at_words(caller, running, calls, made, row) for row, running in enumerate(batch)]
        recorded: list[tuple[_Running, PolicyCall, RecordedCall, Plumbing | None]] = []
        for running, call, result, plumbing in zip(batch, calls, made, looked, strict=True):
            running.call = None
            with self._dropping_faults(running):
                if isinstance(result, NumbersNotFinite):
                    raise result
                assert running.episode is not None
                running.episode.advance(result.actions)
                recorded.append((running, call, result, plumbing))
        for each in recorded:
            self._keep(caller, *each)

    def _look_at_words(
        self,
        caller: Caller,
        running: _Running,
        calls: Sequence[PolicyCall],
        made: Sequence[RecordedCall | NumbersNotFinite],
        row: int,
    ) -> Plumbing | None:
        """Return whether the instruction gets through, of the call that is in this row; None where it is not asked."""
        of = (running.job.task.task_id, running.job.episode_index)
        if not caller.looks_at_words or of not in self._of_words or running.num_replans:
            return None
        found = look_at_words(caller, calls, made, row)
        if found is not None and (said := found.problem) and said not in self._said_of_words:
            self._said_of_words.add(said)
            self.progress.say(f"WARNING: {said}")
        return found

    def _keep(
        self, caller: Caller, running: _Running, call: PolicyCall, made: RecordedCall, plumbing: Plumbing | None
    ) -> None:
        """Store a policy call that has been made, with its effects. A simulator elsewhere goes on meanwhile."""
        assert running.episode is not None
        if running.writer is None:
            running.writer = self._thread.episode(self.store, running.episode.start, caller.denoise_times())
            running.effects = None if caller.effects is None else caller.effects.begin()
        running.num_replans += 1
        recording, effects = caller.recording, running.effects
        running.writer.append(record_of(call, made.rows, made.actions, recording, effects, call.noise_seed, plumbing))

    @contextmanager
    def _dropping_faults(self, running: _Running) -> Iterator[None]:
        """Drop an episode after a fault of its own, and begin it again where what it ran in has ended."""
        try:
            yield
        except SourceLost as lost:
            self._begin_again(running, str(lost))
        except (StoreExists, *EPISODE_FAULTS) as error:
            self._fail(running, error)

    def _begin_again(self, running: _Running, how: str) -> None:
        if running.begun_times > MOST_RESTARTS:
            why = _WHY_KILLED if "signal 9" in how else ""
            title = f"episode {running.job.name} of {self.store.path}"
            died = f"The simulator of {title} ended {running.begun_times} times, the last time {how}."
            self._fail(running, SimulatorDied(f"{died} {why}Nothing of this episode was kept."))
            return
        running.close(SourceLost(how))
        self.progress.say(f"{running.job.name}: its simulator ended ({how}); the episode begins again.")
        running.begun_times += 1
        running.num_replans = 0
        running.progress.update(0, 0)
        self._open(running)

    def _fail(self, running: _Running, error: Exception) -> None:
        """Drop an episode after a fault, or because another process has it. Tried again, it is the next one to begin.

        Raises:
            MachineBroken: episode after episode met the same fault.
        """
        for kept in (self._running, self._ready, self._committing):
            if running in kept:
                kept.remove(running)
        running.close(error)
        name = running.job.name
        self.store.locks.release(name)
        if isinstance(error, StoreExists):
            # It is looked at again where the other process has not committed it yet.
            again = isinstance(error, (EpisodeTaken, Held)) and not self._has(running.job)
            said = f"{error} This process's copy was dropped."
        else:
            again = False
            try:
                again = self.faults.note(name, error)
            finally:
                if not again:
                    self.log.add("dropped", name, str(error))
            what_next = "The episode begins again." if again else "The episode is left out, and the run goes on."
            said = f"{name}: {error} {what_next}"
        self.progress.end(running.progress, again=again)
        self.progress.say(said)
        if again:
            self._left.insert(0, running.job)

    def _note_written(self) -> None:
        """Note what the thread has committed, and what it could not store.

        Raises:
            StoreWriteFailed, and whatever is no fault of one episode.
        """
        self._note_commits()
        for running in [*self._committing, *self._running]:
            error = None if running.writer is None else running.writer.error
            if isinstance(error, (StoreExists, *EPISODE_FAULTS)):
                self._fail(running, error)
            elif error is not None:
                raise error

    def _note_commits(self) -> None:
        for running in list(self._committing):
            if running.writer is not None and running.writer.committed is not None:
                self._committing.remove(running)
                self._note_commit(running, running.writer.committed)

    def _note_commit(self, running: _Running, result: Committed) -> None:
        """Note and show that an episode is committed, and after the first one what the others will take."""
        self.results.append(result)
        self.log.add("committed", running.job.name)
        self.faults.note_recorded()
        self.store.locks.release(running.job.name)
        job, seconds, share, num_bytes = running.job, running.progress.seconds, 1.0, result.num_bytes
        if self.unit == "call":
            self.progress.end(running.progress)
        else:
            num_steps = result.outcome.num_steps
            share = min(1.0, max(1, num_steps) / job.size)
            ended = "success" if result.outcome.success else "no success"
            size = f"{result.num_replans} replans, {format_bytes(num_bytes)}"
            took = f"{seconds:.0f} s ({job.task.instruction})"
            self.progress.end(running.progress, f"{ended} after {num_steps} steps, {size}, {took}")
        if len(self.results) == 1:
            room = room_at(self.store.path).bytes
            self.progress.say_rest(seconds, num_bytes, share, self.source.capacity, room)

    def _describe_stop(self, missing: Sequence[EpisodeJob]) -> str:
        committed = listing([result.folder.name for result in self.results], 40)
        left = sum(not self._has(job) for job in missing)
        left_at = {one.job.name: one.progress.done for one in (*self._running, *self._committing)}
        running = [f"{name} at {self.unit} {done}" for name, done in sorted(left_at.items())]
        dropped = f"dropped {listing(running, 40)}" if running else "no episode was in progress"
        return (
            f"Stopped by SIGTERM: {dropped}; committed {plural(len(self.results), 'episode')} ({committed}); "
            f"{left} of this process's {len(missing)} are missing."
        )


def _wake(connection: Connection) -> None:
    with contextlib.suppress(OSError):  # nobody waits any more
        connection.send_bytes(b".")
