"""One episode: the policy acts in the environment, and every replan is stored."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vla_attention.capture.environments.base import Environment, Observation, Task
from vla_attention.capture.environments.coverage import patch_coverage
from vla_attention.capture.environments.episode_protocol import WAIT_ACTION
from vla_attention.capture.interventions.changed_inputs import CallContext, changed_inputs
from vla_attention.capture.interventions.run_changes import RunChanges
from vla_attention.capture.policies.policy import Policy, camera_frame, camera_grid
from vla_attention.capture.rollout.policy_call import record_call
from vla_attention.capture.store.episode_writer import EpisodeStart, EpisodeWriter, ReplanRecord
from vla_attention.capture.store.store_writer import RunStore
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.interventions import Interventions
from vla_attention.schemas.stores.store_format import Protocol

#: Called after the actions of each replan with (environment steps done, replans done).
StepReport = Callable[[int, int], None]
#: Raises an exception when the process shall stop.
StopCheck = Callable[[], None]


@dataclass(frozen=True)
class EpisodeResult:
    """How an episode ended, and its folder in the store."""

    task_id: int
    episode_index: int
    success: bool
    num_steps: int
    num_replans: int
    folder: Path


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
    """

    policy: Policy
    store: RunStore
    machine: dict[str, str]
    changes: RunChanges = field(default_factory=lambda: RunChanges(Interventions(), {}))
    check: StopCheck = lambda: None


def record_episode(
    run: EpisodeRun, environment: Environment, task: Task, episode_index: int, report: StepReport | None = None
) -> EpisodeResult:
    """Run one episode from the stored initial state of the same index, and commit it to the store.

    The protocol of the published evaluations: waiting steps, then one policy call for every `replan_steps` executed
    actions, until the task is solved or `max_steps` actions have been executed. An exception, also one from
    `run.check`, drops the episode: nothing of it remains in or beside the store.
    """
    policy, store, check = run.policy, run.store, run.check
    protocol = store.attributes.protocol
    environment.reset(episode_index, protocol.seed)
    start = EpisodeStart(
        task_id=task.task_id,
        task_name=task.name,
        instruction=task.instruction,
        episode_index=episode_index,
        initial_state_index=episode_index,
        initial_state_digest=environment.initial_state_digest,
        objects=tuple(environment.objects),
        provenance=run.machine,
    )
    denoise_times = policy.denoise_times()[list(store.attributes.recording.denoise_steps)]
    with store.episode(start, denoise_times, max_replans(protocol)) as writer:
        observation = _wait(environment, protocol.wait_steps, check)
        success, step, replans = False, 0, 0
        while step < protocol.max_steps and not success:
            check()
            actions = _replan(run, environment, writer, start, observation, step)
            replans += 1
            chunk = min(protocol.replan_steps, protocol.max_steps - step)
            for i in range(chunk):
                # Only the picture before the next replan is drawn, because the policy sees no other.
                check()
                observe = i == chunk - 1 and step + 1 < protocol.max_steps
                result = environment.step(actions[i], observe=observe)
                step += 1
                success = result.success
                if success:
                    break
                if result.observation is not None:
                    observation = result.observation
            if report is not None:
                report(step, replans)
        folder = writer.commit(success, step)
    return EpisodeResult(task.task_id, episode_index, success, step, replans, folder)


def _wait(environment: Environment, steps: int, check: StopCheck) -> Observation:
    action, observation = np.array(WAIT_ACTION), None
    for i in range(steps):
        check()
        observation = environment.step(action, observe=i == steps - 1).observation
    if observation is None:
        raise ValueError(
            "an episode needs at least one waiting step: the first picture is the one after the last of them"
        )
    return observation


def _replan(
    run: EpisodeRun,
    environment: Environment,
    writer: EpisodeWriter,
    start: EpisodeStart,
    observation: Observation,
    step: int,
) -> NDArray[np.float64]:
    """Call the policy after `step` policy steps, store the call, and return its actions (horizon, action dim)."""
    policy, changes = run.policy, run.changes
    protocol, recording = run.store.attributes.protocol, run.store.attributes.recording
    task_id, episode_index = start.task_id, start.episode_index
    interventions, replan = changes.interventions, len(writer.records)
    where = f"replan {replan} (environment step {protocol.wait_steps + step}) of {writer.what}"
    policy_input = policy.prepare(observation, start.instruction)
    coverage = _coverage(environment, policy, observation, where)
    context = CallContext(task_id, episode_index, replan, changes.instructions, start.objects, coverage)
    if interventions.changes_input:
        given = changed_inputs(
            policy_input.given, interventions, policy.sites, context, allow_empty=changes.allow_empty
        )
        policy_input = policy.prepare_again(given)
    noise = protocol.seed if interventions.noise is None else interventions.noise.seed
    seed = policy.replan_noise_seed(noise, task_id, episode_index, replan)
    editors = changes.editors(policy.sites, policy_input, context)
    call = record_call(policy, policy_input, seed, recording, where, editors)
    writer.append(
        ReplanRecord(
            env_step=protocol.wait_steps + step,
            noise_seed=seed,
            rows=call.rows,
            key_role=policy_input.key_role,
            prompt=policy_input.prompt,
            state=policy_input.state,
            actions=call.actions,
            frames=policy_input.frames if recording.frames else {},
            camera_frames=policy_input.camera_frames if recording.frames else {},
            coverage=coverage,
        )
    )
    return call.actions


def _coverage(
    environment: Environment, policy: Policy, observation: Observation, where: str
) -> dict[str, NDArray[np.float32]]:
    """Return how much of each patch each object covers, (patch, object) by policy camera."""
    coverage = {}
    for camera in policy.cameras:
        segmentation, grid = environment.segmentation(camera.source), camera_grid(policy.sites, camera.name)
        expected = camera_frame(observation, camera.source).shape[:2]
        try:
            if segmentation.shape != expected or segmentation.dtype.kind not in "iu":
                raise BadArgument(
                    f"The segmentation has the shape {segmentation.shape} and type {segmentation.dtype}; expected "
                    f"whole numbers for the picture's {expected} pixels."
                )
            coverage[camera.name] = patch_coverage(
                segmentation,
                len(environment.objects),
                grid.rows,
                grid.columns,
                flip_rows=camera.upright,
                flip_columns=camera.mirrored,
                visible=camera.visible,
            )
        except BadArgument as error:
            raise BadArgument(f"Cannot store {where}, camera '{camera.source}': {error}") from None
    return coverage
