"""Episodes of simulators, after the protocol of the published evaluations.

One simulator is in this process, several are in processes of their own.

After the waiting steps there is one policy call for every `replan_steps` executed actions, until the task is solved or
`max_steps` actions have been executed.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import TypeAlias

import numpy as np
from msgspec import structs
from numpy.typing import NDArray

from vla_attention.capture.engine.call import Caller, PolicyCall
from vla_attention.capture.engine.observation_checks import ObservationChecks
from vla_attention.capture.engine.simulation import (
    Advanced,
    Begun,
    CameraPatches,
    Seen,
    SimulationFailed,
    StopCheck,
)
from vla_attention.capture.engine.simulator_process import (
    BeginEpisode,
    Execute,
    Failed,
    KnownResets,
    ResetsFirst,
    SimulatorProcess,
    SimulatorServer,
    SimulatorSetup,
)
from vla_attention.capture.engine.source import Episode, EpisodeJob, Outcome, Source, SourceLost, episode_start
from vla_attention.capture.environments.base import NO_DEPARTURES, Departures, EnvironmentSettings, Moment, Suite
from vla_attention.capture.interventions.changed_inputs import CallContext
from vla_attention.capture.policies.policy import Policy
from vla_attention.capture.store.replan_records import RecordedSteps
from vla_attention.capture.store.store_writer import RunStore
from vla_attention.schemas.episode_steps import EpisodeSteps
from vla_attention.schemas.errors import BadArgument, UserError
from vla_attention.schemas.layout import camera_grids
from vla_attention.schemas.libero_physics import MEND, describe_departures, what_differs
from vla_attention.schemas.stores.store_format import Protocol

#: A simulator that gives no answer is ended after so many times the slowest answer of this run so far, but not before
#: so many seconds: after actions, and while it begins an episode, for which it may read a scene from a slow disk.
NO_ANSWER_TIMES = 10
NO_ANSWER_S = 120.0
NO_BEGINNING_S = 1200.0


class SimulatorRefused(UserError):
    """No simulator can do the work: what is needed is missing, or no process can be started."""


def max_replans(protocol: Protocol) -> int:
    """Return the largest possible number of policy calls of one episode."""
    return math.ceil(protocol.max_steps / protocol.replan_steps)


def check_protocol(protocol: Protocol, policy: Policy) -> None:
    """Raise `BadArgument` if the policy cannot follow the protocol."""
    if protocol.max_steps < 1:
        raise BadArgument(f"Cannot use --max-steps {protocol.max_steps}; expected at least 1.")
    if not 1 <= protocol.replan_steps <= policy.action_horizon:
        raise BadArgument(
            f"Cannot use --replan-steps {protocol.replan_steps}: the policy gives {policy.action_horizon} actions a "
            f"call; expected 1 to {policy.action_horizon}."
        )


class LocalSimulator(SimulatorServer):
    """A simulator in this process, which has answered when `ask` returns; otherwise as a `SimulatorProcess`."""

    connection = None

    def __init__(self, source: Simulators) -> None:
        super().__init__(self._answer, source.setup, source.check)
        self._source = source
        self._answers: deque[object] = deque()

    def ask(self, request: BeginEpisode | Execute) -> None:
        """Do what is asked for."""
        self._answers.clear()
        self.answer(request)

    def has_answer(self) -> bool:
        """Whether there is an answer."""
        return bool(self._answers)

    def receive(self) -> object:
        """Return the next answer."""
        return self._answers.popleft()

    def how_it_ended(self) -> str:
        """Describe its end; this process has not ended."""
        raise NotImplementedError

    def close(self) -> None:
        """Close the environment; one that has failed may fail again."""
        with suppress(Exception):
            super().close()

    def _answer(self, answer: object) -> None:
        if isinstance(answer, ResetsFirst):
            self._source.tell_resets(answer)  # before they are made
        else:
            self._answers.append(answer)


Simulator: TypeAlias = SimulatorProcess | LocalSimulator


@dataclass
class Simulators(Source):
    """Up to `capacity` simulators; one is in this process, several are in processes of their own.

    Each stays with its task as long as possible, because another task needs another scene, and because LIBERO's
    published furniture depends on the resets of earlier episodes.

    Attributes:
        machine: provenance that is stored with every episode.
        check: called before every environment step in this process; an exception that it raises drops the episode.
        observed: what is checked of pictures and states before every policy call.
    """

    suite: Suite
    settings: EnvironmentSettings
    store: RunStore
    caller: Caller
    machine: Mapping[str, str]
    check: StopCheck = lambda: None
    capacity: int = 1
    observed: ObservationChecks = field(default_factory=ObservationChecks)
    #: Simulators without an episode, with the task whose scene each has.
    _idle: list[tuple[Simulator, int]] = field(default_factory=list, init=False)
    _episodes: list[SimulatedEpisode] = field(default_factory=list, init=False)
    #: What simulators of each task know of its resets, for the others.
    _resets: dict[int, Sequence[object]] = field(default_factory=dict, init=False)
    _told_of_resets: set[int] = field(default_factory=set, init=False)
    _told_of_departures: set[int] = field(default_factory=set, init=False)
    #: Seconds of the slowest answer so far, at beginnings (True) and after actions (False).
    slowest: dict[bool, float] = field(default_factory=lambda: {True: 0.0, False: 0.0}, init=False)

    @property
    def protocol(self) -> Protocol:
        """The protocol of the run."""
        return self.store.attributes.protocol

    @property
    def setup(self) -> SimulatorSetup:
        """What a simulator needs to know."""
        policy = self.caller.policy
        cameras = tuple(CameraPatches(camera, camera_grids(policy.sites, camera.name)) for camera in policy.cameras)
        return SimulatorSetup(self.suite, self.settings, self.protocol, cameras)

    def choose(self, left: Sequence[EpisodeJob]) -> int | None:
        """Return the place of the next episode: of the same task, else of one that no simulator has, else the first.

        None: it would make a reset that another one is making now. The published furniture of an episode needs the
        resets of all before it, seconds each. What a simulator knows of them reaches the others when its episode has
        begun; until then a second one would make them all again.
        """
        task_id = self._idle[-1][1] if self._idle else None
        taken = {episode.job.begins_as[0] for episode in self._episodes} | {number for _, number in self._idle}

        def preference(place: int) -> tuple[bool, bool, int]:
            other = left[place].begins_as[0]
            return (other != task_id, other in taken, place)

        place = min(range(len(left)), key=preference)
        wanted, index = left[place].begins_as
        known = self._resets.get(wanted)
        resetting = any(other.job.begins_as[0] == wanted and other.begun is None for other in self._episodes)
        return None if task_id == wanted and known and len(known) <= index and resetting else place

    def open(self, job: EpisodeJob) -> SimulatedEpisode:
        """Let a simulator begin an episode."""
        task_id, state = job.begins_as
        place = max(range(len(self._idle)), key=lambda place: (self._idle[place][1] == task_id, place), default=None)
        simulator = self._started() if place is None else self._idle.pop(place)[0]
        episode = SimulatedEpisode(self, job, simulator)
        self._episodes.append(episode)
        try:
            told = None if job.scene is None else job.task.task_id
            simulator.ask(BeginEpisode(task_id, state, episode.title, self._resets.get(task_id), told))
        except Exception as error:
            episode.close(error)
            raise
        return episode

    def _started(self) -> Simulator:
        if self.capacity == 1:
            return LocalSimulator(self)
        try:
            return SimulatorProcess(self.setup)
        except OSError as error:
            raise SimulatorRefused(
                f"Cannot start a process for a simulator ({error.strerror or error}); use a smaller --num-envs, and "
                "--resume for what is missing."
            ) from None

    def tell_resets(self, first: ResetsFirst) -> None:
        """Say that an episode needs resets of other episodes first.

        Once a task: simulators that begin at the same time cannot know of each other's resets yet.
        """
        if first.task_id not in self._told_of_resets:
            self._told_of_resets.add(first.task_id)
            self.say(
                f"{first.episode}: the published furniture depends on the resets of earlier episodes; making "
                f"{first.number} first."
            )

    def tell_departures(self, episode: SimulatedEpisode, departures: Departures) -> None:
        """Say, once a task, that a scene did not begin as in the published evaluations."""
        task_id, said = episode.job.begins_as[0], describe_departures(departures.lost_relations, departures.displaced)
        if said and task_id not in self._told_of_departures:
            self._told_of_departures.add(task_id)
            mend = f" {MEND} mends it." if what_differs(self.machine.get("mujoco", "")) else ""
            self.say(f"WARNING: at the beginning of {episode.title} {' and '.join(said)}.{mend}")

    def learn_resets(self, task_id: int, resets: Sequence[object]) -> None:
        """Keep what a simulator knows of a task's resets, for the others."""
        self._resets[task_id] = max(self._resets.get(task_id, ()), resets, key=len)

    def give_back(self, episode: SimulatedEpisode, simulator: Simulator, *, is_sound: bool) -> None:
        """Take the simulator of an episode that has ended."""
        self._episodes.remove(episode)
        if is_sound:
            self._idle.append((simulator, episode.job.begins_as[0]))
        else:
            simulator.close()

    def close(self) -> None:
        """End all simulators."""
        for episode in list(self._episodes):
            episode.close(SimulationFailed("the run ends"))
        for simulator, _ in self._idle:
            simulator.close()
        self._idle.clear()


@dataclass(eq=False)
class SimulatedEpisode(Episode):
    """One episode in a simulator."""

    source: Simulators
    job: EpisodeJob
    simulator: Simulator
    done: int = field(default=0, init=False)
    begun: Begun | None = field(default=None, init=False)
    #: When the simulator was asked for the answer that it owes, or gave the last part of it; None if it owes none.
    _asked_at: float | None = field(default_factory=time.monotonic, init=False)
    _replan: int = field(default=0, init=False)
    _success: bool = field(default=False, init=False)
    _moments: list[Moment] = field(default_factory=list, init=False)
    _departures: Departures = field(default=NO_DEPARTURES, init=False)
    _executed: list[NDArray[np.float64]] = field(default_factory=list, init=False)
    _closed: bool = field(default=False, init=False)

    def __post_init__(self) -> None:
        """Take the connection of the simulator."""
        self.connection = self.simulator.connection

    @property
    def title(self) -> str:
        """Its name in messages."""
        return f"episode {self.job.name} of {self.source.store.path}"

    def poll(self) -> PolicyCall | Outcome | None:
        """Take the answers that are there."""
        while self.simulator.has_answer():
            try:
                answer = self.simulator.receive()
            except (EOFError, OSError):  # OSError: it ended inside of an answer
                raise SourceLost(self.simulator.how_it_ended()) from None
            self._note_time()
            match answer:
                case ResetsFirst():
                    self.source.tell_resets(answer)
                case KnownResets(resets):
                    self.source.learn_resets(self.job.begins_as[0], resets)
                case Begun():
                    self.begun, machine = answer, self.source.machine
                    digest, objects = answer.initial_state_digest, answer.objects
                    self.start = episode_start(self.job, machine, state_digest=digest, objects=objects)
                case Advanced():
                    self._asked_at = None
                    return self._advanced(answer)
                case Failed(sentence, expected, reason):
                    raise SimulatorRefused(sentence) if expected else SimulationFailed(sentence, reason)
        return None

    def advance(self, actions: NDArray[np.float64]) -> None:
        """Let the simulator execute as many of the actions as the protocol says."""
        protocol = self.source.protocol
        chosen = actions[: min(protocol.replan_steps, protocol.max_steps - self.done)]
        self._executed += list(chosen)
        self._replan += 1
        self._asked_at = time.monotonic()
        self.simulator.ask(Execute(chosen, self.done + len(chosen) < protocol.max_steps))

    def overdue(self) -> str | None:
        """Return how the simulator hangs, if it has owed an answer for too long."""
        if self._asked_at is None or self.connection is None:
            return None
        seconds = time.monotonic() - self._asked_at
        least = NO_ANSWER_S if self._replan else NO_BEGINNING_S
        limit = max(least, NO_ANSWER_TIMES * self.source.slowest[not self._replan])
        return f"killed after {seconds:.0f} s without an answer" if seconds > limit else None

    def close(self, error: Exception | None = None) -> None:
        """Give the simulator back, unless its error says that it is not to be trusted, or it owes an answer."""
        if not self._closed:
            self._closed = True
            is_sound = not isinstance(error, (SimulationFailed, SourceLost)) and self._asked_at is None
            self.source.give_back(self, self.simulator, is_sound=is_sound)

    def _note_time(self) -> None:
        now = time.monotonic()
        if self._asked_at is not None:
            begins = not self._replan
            self.source.slowest[begins] = max(now - self._asked_at, self.source.slowest[begins])
            self._asked_at = now

    def _advanced(self, result: Advanced) -> PolicyCall | Outcome:
        self.done += result.steps
        self._success = result.success
        self._moments += result.moments
        if not result.steps:  # the waiting steps
            self._departures = result.departures
            self.source.tell_departures(self, result.departures)
        if self._success or self.done >= self.source.protocol.max_steps:
            return Outcome(self._success, self.done, self._steps())
        if result.seen is None:
            raise ValueError("a simulator gave no observation before a policy call")
        return self._prepared(result.seen)

    def _prepared(self, seen: Seen) -> PolicyCall:
        """Return the next policy call: its input, with the run's interventions, and the seed of its noise."""
        source, caller, start = self.source, self.source.caller, self.start
        policy, env_step = caller.policy, source.protocol.wait_steps + self.done
        where = f"replan {self._replan} (environment step {env_step}) of {self.title}"
        cameras = [camera.source for camera in policy.cameras]
        constant = source.observed.check(start.task_id, seen.observation, cameras, where)
        context = CallContext(
            start.task_id,
            start.episode_index,
            self._replan,
            caller.changes.instructions,
            start.objects,
            seen.coverage,
        )
        policy_input = policy.prepare(seen.observation, start.instruction)
        if caller.changes.interventions.changes_input:
            policy_input = caller.prepared(policy_input.given, context)
        # What begins alike has the same noise, whatever it is told.
        scene, state = self.job.begins_as
        seed = caller.drawn_seed(source.protocol.seed, replace(context, task_id=scene, episode_index=state))
        return PolicyCall(policy_input, seed, context, env_step, where, constant_cameras=constant)

    def _steps(self) -> RecordedSteps | None:
        """Return what the simulator told of every step; None where it told nothing."""
        assert self.begun is not None
        if self.begun.bodies is None:
            return None
        touched = np.stack([moment.touched for moment in self._moments])
        held = np.stack([moment.held for moment in self._moments])
        goals = [
            structs.replace(goal, first_held=_first(when)) for goal, when in zip(self.begun.goals, held.T, strict=True)
        ]
        return RecordedSteps(
            EpisodeSteps(
                self.begun.bodies,
                tuple(map(_first, touched.T)),
                tuple(goals),
                self.source.machine.get("mujoco", ""),
                self._departures.lost_relations,
                self._departures.displaced,
            ),
            poses=np.stack([moment.poses for moment in self._moments]),
            gripper=np.stack([moment.gripper for moment in self._moments]),
            # Those after the one that solved the task were not executed.
            actions=np.array(self._executed[: self.done], dtype=np.float32),
        )


def _first(moments: NDArray[np.bool_]) -> int | None:
    """Return the first moment at which something holds, (moment,) bool; None where it never does."""
    return int(np.argmax(moments)) if moments.any() else None
