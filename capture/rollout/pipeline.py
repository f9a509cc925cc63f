"""The loop over episodes with simulators in processes of their own: they, the policy and the writing overlap.

This process has the policy. With batches of 1 it calls the policy for one simulator after the other: every call has the
input that it has in the loop with one simulator, and every episode is the same to the bit. A larger batch changes the
last bits of what the policy computes. A thread writes (`background_writing.py`).
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

from vla_attention.capture.environments.base import EnvironmentSettings, Suite
from vla_attention.capture.recording.finite_numbers import NumbersNotFinite
from vla_attention.capture.rollout.background_writing import BackgroundWriting, Committed, EpisodeInBackground
from vla_attention.capture.rollout.episode import (
    EpisodeRecording,
    EpisodeRun,
    episode_title,
    max_replans,
    policy_cameras,
    recorded_times,
    simulated_start,
)
from vla_attention.capture.rollout.episode_faults import SimulatorDied
from vla_attention.capture.rollout.episode_loop import EpisodeJob, EpisodeLoop, EpisodeResult
from vla_attention.capture.rollout.policy_call import record_calls
from vla_attention.capture.rollout.progress import EpisodeProgress
from vla_attention.capture.rollout.simulation import Advanced, Begun, Seen, SimulationFailed
from vla_attention.capture.rollout.simulator_process import (
    BeginEpisode,
    Execute,
    Failed,
    KnownResets,
    ResetsFirst,
    SimulatorProcess,
    SimulatorSetup,
)
from vla_attention.capture.rollout.simulator_source import resets_line
from vla_attention.schemas.errors import UserError
from vla_attention.schemas.stores.locks import Holder
from vla_attention.schemas.stores.store_format import StoreExists

#: How often an episode is begun again after the end of its simulator.
MOST_RESTARTS = 2
#: Seconds between two looks whether SIGTERM came, while no simulator answers.
_LOOK_EVERY_S = 0.5
#: A simulator that gives no answer is ended after so many times the slowest answer of this run so far, but not before
#: so many seconds: after actions, and while it begins an episode, for which it may read a scene from a slow disk.
NO_ANSWER_TIMES = 10
NO_ANSWER_S = 120.0
NO_BEGINNING_S = 1200.0

_WHY_KILLED = "Signal 9 mostly means that the memory was full; a smaller --num-envs needs less. "


class SimulatorRefused(UserError):
    """No simulator can do the work: what is needed is missing, or no process can be started."""


@dataclass(eq=False)
class Simulator:
    """A process, and the episode that runs in it; `recording` and `writer` from its reset on."""

    process: SimulatorProcess
    job: EpisodeJob
    progress: EpisodeProgress
    begun_times: int = 1
    recording: EpisodeRecording | None = None
    writer: EpisodeInBackground | None = None
    #: When it was asked for the answer that it owes, or gave the last part of it; None if it owes none.
    asked_at: float | None = None

    @property
    def begins(self) -> bool:
        """Whether it is at the beginning of the episode, which ends with the first picture."""
        return self.recording is None or not self.recording.num_replans

    @property
    def in_episode(self) -> tuple[EpisodeRecording, EpisodeInBackground]:
        """The recording of the episode and its writer, after its reset."""
        assert self.recording is not None
        assert self.writer is not None
        return self.recording, self.writer


@dataclass
class PipelinedLoop(EpisodeLoop):
    """Records episodes in several simulators at a time; see `EpisodeLoop`.

    policy_batch: most policy calls that are made as one batch; what is ready is taken, without waiting for more.
    num_envs: number of simulators. Each stays with its task as long as possible, because another task needs another
    scene, and because LIBERO's published furniture depends on the resets of earlier episodes.
    """

    suite: Suite
    environment_settings: EnvironmentSettings
    run: EpisodeRun
    num_envs: int = 2
    policy_batch: int = 1
    _idle: list[tuple[SimulatorProcess, int | None]] = field(default_factory=list, init=False)
    _running: list[Simulator] = field(default_factory=list, init=False)
    #: Episodes whose commit waits for the thread, with the progress of each.
    _writing: dict[EpisodeInBackground, tuple[EpisodeJob, EpisodeRecording, EpisodeProgress]] = field(
        default_factory=dict, init=False
    )
    #: Episodes that are to be recorded and that no simulator has.
    _left: list[EpisodeJob] = field(default_factory=list, init=False)
    _ready: deque[tuple[Simulator, Seen]] = field(default_factory=deque, init=False)
    #: What simulators of each task know of its resets, for the others.
    _resets: dict[int, Sequence[object]] = field(default_factory=dict, init=False)
    _told_of_resets: set[int] = field(default_factory=set, init=False)
    #: Seconds of the slowest answer so far, at beginnings (True) and after actions (False).
    _slowest: dict[bool, float] = field(default_factory=lambda: {True: 0.0, False: 0.0}, init=False)

    @contextmanager
    def opened(self) -> Iterator[None]:
        """Start the thread that writes; end it and all simulators at the end of the block."""
        attributes = self.run.store.attributes
        cameras = policy_cameras(self.run.policy)
        self._setup = SimulatorSetup(self.suite, self.environment_settings, attributes.protocol, cameras)
        self._woken, wake = Pipe(duplex=False)
        with ExitStack() as stack:
            stack.enter_context(self._woken)
            stack.enter_context(wake)
            stack.callback(self._note_last_commits)
            self._thread = stack.enter_context(
                BackgroundWriting(notify=partial(_wake, wake), check=self.termination.check)
            )
            stack.callback(self._end_simulators)
            yield

    @property
    def at_a_time(self) -> int:
        """Simulators, each with an episode."""
        return self.num_envs

    def attempt_all(self, missing: Sequence[EpisodeJob]) -> list[tuple[EpisodeJob, Holder]]:
        """Record every episode that nobody has; return those that other processes are writing."""
        self.termination.check()
        self._left = list(missing)
        elsewhere: list[tuple[EpisodeJob, Holder]] = []
        with self.termination.only_at_checks():
            while self._left or self._running or self._writing:
                self.termination.check()
                self._note_commits(self._thread.take_commits())
                # Before the policy computes: simulators reset and step meanwhile.
                self._begin_episodes(self._left, elsewhere)
                if self._running or self._writing:
                    self._receive()
                    self._call_policy()
        self.termination.check()
        return elsewhere

    def _begin_episodes(self, left: list[EpisodeJob], elsewhere: list[tuple[EpisodeJob, Holder]]) -> None:
        """Give an episode to every simulator without one; takes from `left`, adds to `elsewhere`."""
        while left and len(self._running) < self.num_envs:
            process, task_id = self._idle.pop() if self._idle else (None, None)
            place = self._choose(left, task_id)
            if process is not None and self._would_repeat_resets(task_id, left[place]):
                self._idle.append((process, task_id))
                return
            job = left.pop(place)
            locked = self.lock(job)
            if locked is True:
                process = process or self._start_simulator()
                simulator = Simulator(process, job, self.progress.begin(job.title, job.size))
                self._running.append(simulator)
                self._begin(simulator)
                continue
            if process is not None:
                self._idle.append((process, task_id))
            if isinstance(locked, Holder):
                elsewhere.append((job, locked))

    def _start_simulator(self) -> SimulatorProcess:
        try:
            return SimulatorProcess(self._setup)
        except OSError as error:
            raise SimulatorRefused(
                f"Cannot start a process for a simulator ({error.strerror or error}); use a smaller --num-envs, and "
                "--resume for what is missing."
            ) from None

    def _choose(self, left: Sequence[EpisodeJob], task_id: int | None) -> int:
        """Return the place of the next episode: of the same task, else of one that no simulator has, else the first."""
        taken = {simulator.job.task.task_id for simulator in self._running}
        taken.update(number for _, number in self._idle if number is not None)

        def preference(place: int) -> tuple[bool, bool, int]:
            other = left[place].task.task_id
            return (other != task_id, other in taken, place)

        return min(range(len(left)), key=preference)

    def _would_repeat_resets(self, task_id: int | None, job: EpisodeJob) -> bool:
        """Tell whether a simulator with a scene of the task would make a reset that another one is making now."""
        # The published furniture of an episode needs the resets of all before it, seconds each. What a simulator knows
        # of them reaches the others when its episode has begun; until then a second one would make them all again.
        wanted = job.task.task_id
        known = self._resets.get(wanted)
        resetting = any(other.job.task.task_id == wanted and other.recording is None for other in self._running)
        return task_id == wanted and bool(known) and len(known or ()) <= job.episode_index and resetting

    def _begin(self, simulator: Simulator) -> None:
        self.positions[simulator.job.name] = 0
        simulator.asked_at = time.monotonic()
        task_id, index = simulator.job.task.task_id, simulator.job.episode_index
        simulator.process.begin(BeginEpisode(task_id, index, self._title(simulator.job), self._resets.get(task_id)))

    def _title(self, job: EpisodeJob) -> str:
        return episode_title(self.run.store, job.task, job.episode_index)

    def _receive(self) -> None:
        """Take what the simulators have answered; waits for an answer unless the policy has something to do."""
        by_connection = {simulator.process.connection: simulator for simulator in self._running}
        timeout = 0.0 if self._ready else _LOOK_EVERY_S
        answered = wait([*by_connection, self._woken], timeout)
        self._end_what_hangs([by_connection[each] for each in by_connection if each not in answered])
        for connection in answered:
            if connection is self._woken:
                self._woken.recv_bytes()
                continue
            simulator = by_connection[connection]  # type: ignore[index]
            try:
                answer = simulator.process.connection.recv()
            except (EOFError, OSError):  # OSError: it ended inside of an answer
                self._begin_again(simulator, simulator.process.how_it_ended())
            else:
                self._note_answer(simulator)
                self._take(simulator, answer)

    def _note_answer(self, simulator: Simulator) -> None:
        now = time.monotonic()
        if simulator.asked_at is not None:
            seconds = now - simulator.asked_at
            self._slowest[simulator.begins] = max(seconds, self._slowest[simulator.begins])
            simulator.asked_at = now  # `_advanced` takes it back: nothing more is to come

    def _end_what_hangs(self, silent: Sequence[Simulator]) -> None:
        """End simulators of `silent` that have owed an answer for too long, and begin their episodes again."""
        now = time.monotonic()
        for simulator in silent:
            least = NO_BEGINNING_S if simulator.begins else NO_ANSWER_S
            limit = max(least, NO_ANSWER_TIMES * self._slowest[simulator.begins])
            if simulator.asked_at is not None and now - simulator.asked_at > limit:
                self._begin_again(simulator, f"killed after {now - simulator.asked_at:.0f} s without an answer")

    def _take(self, simulator: Simulator, answer: object) -> None:
        match answer:
            case ResetsFirst(number):
                # Once a task: simulators that begin at the same time cannot know of each other's resets yet.
                if simulator.job.task.task_id not in self._told_of_resets:
                    self._told_of_resets.add(simulator.job.task.task_id)
                    self.progress.say(resets_line(simulator.job.name, number))
            case KnownResets(resets):
                known = self._resets.get(simulator.job.task.task_id, ())
                self._resets[simulator.job.task.task_id] = max(known, resets, key=len)
            case Begun():
                start = simulated_start(self.run, simulator.job.task, simulator.job.episode_index, answer)
                simulator.recording = EpisodeRecording(self.run, simulator.job.task, start, answer)
                protocol = self.run.store.attributes.protocol
                simulator.writer = self._thread.episode(
                    self.run.store, start, recorded_times(self.run), max_replans(protocol)
                )
            case Advanced():
                self._advanced(simulator, answer)
            case Failed(sentence, expected, reason):
                if expected:
                    raise SimulatorRefused(sentence)
                self._fail(simulator, SimulationFailed(sentence, reason))

    def _advanced(self, simulator: Simulator, result: Advanced) -> None:
        simulator.asked_at = None
        recording, writer = simulator.in_episode
        recording.advanced(result)
        if recording.num_replans:
            self.positions[simulator.job.name] = recording.step
            simulator.progress.update(recording.step, recording.num_replans)
        if not recording.ended:
            if result.seen is None:
                raise ValueError("a simulator gave no observation before a policy call")
            self._ready.append((simulator, result.seen))
            return
        self._running.remove(simulator)
        self._idle.append((simulator.process, simulator.job.task.task_id))
        self._writing[writer] = (simulator.job, recording, simulator.progress)
        writer.commit(recording.success, recording.step, recording.steps)

    def _call_policy(self) -> None:
        """Make the next policy calls, and let their simulators go on before the calls are stored."""
        if not self._ready:
            return
        batch = [self._ready.popleft() for _ in range(min(self.policy_batch, len(self._ready)))]
        prepared = []
        for simulator, seen in batch:
            try:
                prepared.append((simulator, simulator.in_episode[0].prepare(seen)))
            except SimulationFailed as error:
                self._fail(simulator, error)
        if not prepared:
            return
        calls = record_calls(self.run.policy, [call for _, call in prepared], self.run.store.attributes.recording)
        for (simulator, _), call in zip(prepared, calls, strict=True):
            if isinstance(call, NumbersNotFinite):
                self._fail(simulator, call)
            else:
                simulator.asked_at = time.monotonic()
                simulator.process.execute(Execute(*simulator.in_episode[0].next_actions(call)))
        for (simulator, before), call in zip(prepared, calls, strict=True):
            if not isinstance(call, NumbersNotFinite):
                recording, writer = simulator.in_episode
                recording.keep(before, call, writer)

    def _begin_again(self, simulator: Simulator, how: str) -> None:
        """Begin the episode of a simulator that has died or hangs in a new one; how: in what way, for messages."""
        simulator.process.close()
        self._ready = deque(entry for entry in self._ready if entry[0] is not simulator)
        if simulator.writer is not None:
            simulator.writer.drop()
            simulator.recording = simulator.writer = None
        if simulator.begun_times > MOST_RESTARTS:
            why = _WHY_KILLED if "signal 9" in how else ""
            title, times = self._title(simulator.job), simulator.begun_times
            died = f"The simulator of {title} ended {times} times, the last time {how}."
            self._fail(simulator, SimulatorDied(f"{died} {why}Nothing of this episode was kept."))
            return
        self.progress.say(f"{simulator.job.name}: its simulator ended ({how}); the episode begins again.")
        simulator.begun_times += 1
        simulator.progress.update(0, 0)
        simulator.process = self._start_simulator()
        self._begin(simulator)

    def _fail(self, simulator: Simulator, error: Exception) -> None:
        """Drop the episode of a simulator after a fault. If it shall be tried again, it waits for a simulator."""
        self._ready = deque(entry for entry in self._ready if entry[0] is not simulator)
        self._running.remove(simulator)
        if simulator.writer is not None:
            simulator.writer.drop()
        # What raised an error is not to be trusted, and what owes an answer would give it to another episode.
        if isinstance(error, SimulationFailed) or simulator.asked_at is not None:
            simulator.process.close()
        else:
            self._idle.append((simulator.process, simulator.job.task.task_id))
        self._after_fault(simulator.job, simulator.progress, error)

    def _after_fault(self, job: EpisodeJob, progress: EpisodeProgress, error: Exception) -> None:
        self.locks.release(job.name)
        if isinstance(error, StoreExists):
            again = self.note_refused(job, progress, error)
        else:
            again = self.note_fault(job.name, progress, error)
        if again:
            self._left.insert(0, job)

    def _note_commits(self, commits: Sequence[Committed]) -> None:
        for commit in commits:
            if isinstance(commit.folder, Exception):
                self._fail_in_writing(commit.episode, commit.folder)
                continue
            job, recording, progress = self._writing.pop(commit.episode)
            result = EpisodeResult(
                job.task.task_id,
                job.episode_index,
                recording.success,
                recording.step,
                recording.num_replans,
                commit.folder,
            )
            self.note_commit(result)
            self.show_end(job, progress, result, commit.num_bytes)
            self.locks.release(job.name)

    def _fail_in_writing(self, writer: EpisodeInBackground, error: Exception) -> None:
        """Drop an episode that the thread did not store; its simulator may be on the way to the next replan."""
        if writer in self._writing:
            job, _, progress = self._writing.pop(writer)
            self._after_fault(job, progress, error)
            return
        for simulator in [each for each in self._running if each.writer is writer]:
            self._fail(simulator, error)

    def _note_last_commits(self) -> None:
        """Note the commits that were completed while the thread ended."""
        commits = self._thread.commits_before_end()
        self._note_commits([commit for commit in commits if not isinstance(commit.folder, Exception)])

    def _end_simulators(self) -> None:
        for process in [*(simulator.process for simulator in self._running), *(process for process, _ in self._idle)]:
            process.close()
        self._running.clear()
        self._idle.clear()
        self._ready.clear()


def _wake(connection: Connection) -> None:
    with contextlib.suppress(OSError):  # nobody waits any more
        connection.send_bytes(b".")
