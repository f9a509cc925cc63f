"""One episode: the policy acts in the environment, and every replan is stored.

The simulator may be in this process (`record_episode`) or in another one (`pipeline.py`): both use `EpisodeRecording`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Protocol as Interface

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from vla_attention.capture.effects.measurement import EffectMeasurement, EpisodeEffectsMeasured
from vla_attention.capture.environments.base import Environment, Moment, Task
from vla_attention.capture.interventions.changed_inputs import CallContext, changed_inputs
from vla_attention.capture.interventions.run_changes import RunChanges
from vla_attention.capture.policies.policy import Policy
from vla_attention.capture.recording.finite_numbers import NumbersNotFinite
from vla_attention.capture.rollout.episode_loop import EpisodeResult, StepReport, episode_start
from vla_attention.capture.rollout.observation_checks import ObservationChecks
from vla_attention.capture.rollout.policy_call import PreparedCall, RecordedCall, record_calls, replan_record
from vla_attention.capture.rollout.simulation import Advanced, Begun, CameraPatches, Seen, Simulation, StopCheck
from vla_attention.capture.store.replan_records import EpisodeStart, RecordedSteps, ReplanRecord
from vla_attention.capture.store.store_writer import RunStore
from vla_attention.schemas.episode_steps import EpisodeSteps
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.interventions import Interventions
from vla_attention.schemas.layout import camera_grids
from vla_attention.schemas.stores.store_format import Protocol, episode_name


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


@dataclass(frozen=True)
class EpisodeRun:
    """What all episodes of a process have in common.

    machine: provenance that is stored with every episode. changes: the run's interventions; without any, nothing.
    check: called before every environment step and policy call; an exception that it raises drops the episode.
    observed: what is checked of the simulator's pictures and states before every policy call. effects: what measures
    the effects of calls; None where they are not recorded.
    """

    policy: Policy
    store: RunStore
    machine: dict[str, str]
    changes: RunChanges = field(default_factory=lambda: RunChanges(Interventions(), {}))
    check: StopCheck = lambda: None
    observed: ObservationChecks = field(default_factory=ObservationChecks)
    effects: EffectMeasurement | None = None


class ReplanWriter(Interface):
    """Stores the replans of one episode, as `EpisodeWriter` does."""

    def append(self, record: ReplanRecord) -> None:
        """Add the next replan."""


def episode_title(store: RunStore, task: Task, episode_index: int) -> str:
    """Return an episode's name in messages."""
    return f"episode {episode_name(task.task_id, episode_index)} of {store.path}"


def simulated_start(run: EpisodeRun, task: Task, episode_index: int, begun: Begun) -> EpisodeStart:
    """Return what is known of an episode of a simulator before its first replan."""
    return episode_start(
        task, episode_index, run.machine, state_digest=begun.initial_state_digest, objects=begun.objects
    )


def recorded_times(run: EpisodeRun) -> NDArray[np.float64]:
    """Return the noise levels of the denoise steps that the run records, (denoise,)."""
    return run.policy.denoise_times()[list(run.store.attributes.recording.denoise_steps)]


def policy_cameras(policy: Policy) -> tuple[CameraPatches, ...]:
    """Return the policy's cameras with their patches."""
    return tuple(CameraPatches(camera, camera_grids(policy.sites, camera.name)) for camera in policy.cameras)


@dataclass
class EpisodeRecording:
    """The policy's part of one episode, after the protocol of the published evaluations.

    After the waiting steps, `prepare` and `keep` make one policy call for every `replan_steps` executed actions, and
    `advanced` takes what the simulator gave for these; until the task is solved or `max_steps` actions have been
    executed.
    """

    run: EpisodeRun
    task: Task
    start: EpisodeStart
    begun: Begun
    step: int = field(default=0, init=False)
    num_replans: int = field(default=0, init=False)
    success: bool = field(default=False, init=False)
    _effects: EpisodeEffectsMeasured | None = field(default=None, init=False)
    _moments: list[Moment] = field(default_factory=list, init=False)
    _executed: list[NDArray[np.float64]] = field(default_factory=list, init=False)

    def __post_init__(self) -> None:
        """Begin measuring effects, where the run does."""
        self._effects = None if self.run.effects is None else self.run.effects.begin()

    @property
    def ended(self) -> bool:
        """Whether the episode is over."""
        return self.success or self.step >= self.run.store.attributes.protocol.max_steps

    def prepare(self, seen: Seen) -> PreparedCall:
        """Return the next policy call: its input, with the run's interventions, and the seed of its noise."""
        policy, changes, start = self.run.policy, self.run.changes, self.start
        protocol, interventions, replan = self.run.store.attributes.protocol, changes.interventions, self.num_replans
        title = episode_title(self.run.store, self.task, start.episode_index)
        env_step = protocol.wait_steps + self.step
        where = f"replan {replan} (environment step {env_step}) of {title}"
        cameras = [camera.source for camera in policy.cameras]
        constant = self.run.observed.check(start.task_id, seen.observation, cameras, where)
        policy_input = policy.prepare(seen.observation, start.instruction)
        context = CallContext(
            start.task_id, start.episode_index, replan, changes.instructions, start.objects, seen.coverage
        )
        if interventions.changes_input:
            given = changed_inputs(
                policy_input.given, interventions, policy.sites, context, allow_empty=changes.allow_empty
            )
            policy_input = policy.prepare_again(given)
        noise = protocol.seed if interventions.noise is None else interventions.noise.seed
        return PreparedCall(
            env_step=env_step,
            where=where,
            context=context,
            policy_input=policy_input,
            noise_seed=policy.replan_noise_seed(noise, start.task_id, start.episode_index, replan),
            coverage=seen.coverage,
            editors=changes.editors(policy.sites, policy_input, context),
            constant_cameras=constant,
        )

    def keep(self, prepared: PreparedCall, call: RecordedCall, writer: ReplanWriter) -> None:
        """Store a policy call that has been made, with its effects. A simulator elsewhere goes on meanwhile."""
        recording = self.run.store.attributes.recording
        self.num_replans += 1
        effects = None
        if self._effects is not None:
            given = prepared.policy_input
            effects = self._effects.measure(given, prepared.noise_seed, call.actions, prepared.context)
        writer.append(
            replan_record(
                prepared.policy_input,
                call,
                recording,
                env_step=prepared.env_step,
                noise_seed=prepared.noise_seed,
                coverage=prepared.coverage,
                effects=effects,
                constant_cameras=prepared.constant_cameras,
            )
        )

    def next_actions(self, call: RecordedCall) -> tuple[NDArray[np.float64], bool]:
        """Return the actions (step, action dim) to execute after a call, and whether another call may follow."""
        protocol = self.run.store.attributes.protocol
        count = min(protocol.replan_steps, protocol.max_steps - self.step)
        self._executed += list(call.actions[:count])
        return call.actions[:count], self.step + count < protocol.max_steps

    def advanced(self, result: Advanced) -> None:
        """Note what the simulator gave for the waiting steps, or for the last actions."""
        self.step += result.steps
        self.success = result.success
        self._moments += result.moments

    @property
    def steps(self) -> RecordedSteps | None:
        """What the simulator told of every step; None where it told nothing."""
        if self.begun.bodies is None:
            return None
        moments = self._moments
        touched = np.stack([moment.touched for moment in moments])
        held = np.stack([moment.held for moment in moments])
        goals = [replace(goal, first_held=_first(when)) for goal, when in zip(self.begun.goals, held.T, strict=True)]
        return RecordedSteps(
            EpisodeSteps(self.begun.bodies, tuple(map(_first, touched.T)), tuple(goals)),
            poses=np.stack([moment.poses for moment in moments]),
            gripper=np.stack([moment.gripper for moment in moments]),
            # Those after the one that solved the task were not executed.
            actions=np.array(self._executed[: self.step], dtype=np.float32),
        )


def _first(moments: NDArray[np.bool_]) -> int | None:
    """Return the first moment at which something holds, (moment,) bool; None where it never does."""
    return int(np.argmax(moments)) if moments.any() else None


def record_episode(
    run: EpisodeRun, environment: Environment, task: Task, episode_index: int, report: StepReport | None = None
) -> EpisodeResult:
    """Run one episode from the stored initial state of the same index, and commit it to the store.

    The simulator is in this process. An exception, also one from `run.check`, drops the episode: nothing of it remains
    in or beside the store.
    """
    store, protocol = run.store, run.store.attributes.protocol
    simulation = Simulation(environment, protocol, policy_cameras(run.policy), run.check)
    begun = simulation.begin(episode_index, episode_title(store, task, episode_index))
    start = simulated_start(run, task, episode_index, begun)
    with store.episode(start, recorded_times(run), max_replans(protocol)) as writer:
        recording, result = EpisodeRecording(run, task, start, begun), simulation.wait()
        recording.advanced(result)
        while not recording.ended:
            run.check()
            if result.seen is None:
                raise ValueError("the environment gave no observation before a policy call")
            prepared = recording.prepare(result.seen)
            (call,) = record_calls(run.policy, [prepared], store.attributes.recording)
            if isinstance(call, NumbersNotFinite):
                raise call
            recording.keep(prepared, call, writer)
            result = simulation.advance(*recording.next_actions(call))
            recording.advanced(result)
            if report is not None:
                report(recording.step, recording.num_replans)
        folder = writer.commit(recording.success, recording.step, recording.steps)
    return EpisodeResult(task.task_id, episode_index, recording.success, recording.step, recording.num_replans, folder)
