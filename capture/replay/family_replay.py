"""A replay with a policy of a family that reads data sets (pi0 and pi0.5)."""

from __future__ import annotations

import argparse
import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Protocol, cast

import numpy as np
from numpy.typing import NDArray

from vla_attention.capture.effects.arguments import effect_settings
from vla_attention.capture.effects.conditions import describe_effects
from vla_attention.capture.effects.mean_pictures import pictures_of
from vla_attention.capture.effects.measurement import EffectMeasurement, EpisodeEffectsMeasured, measurement_of
from vla_attention.capture.interventions.changed_inputs import CallContext
from vla_attention.capture.machine.provenance import describe_machine
from vla_attention.capture.policies.family import PolicyFamily
from vla_attention.capture.policies.identity import downloads_of
from vla_attention.capture.policies.policy import Policy, PolicyInput
from vla_attention.capture.policies.robot import Robot
from vla_attention.capture.replay.lerobot_dataset import DataSetEpisode, DataSetFrame, LeRobotDataset
from vla_attention.capture.replay.replay_plan import (
    BeforeCall,
    ReplayPlan,
    announce,
    columns_of,
    joined,
    record_episodes,
    success_of,
)
from vla_attention.capture.replay.video import decoder_version
from vla_attention.capture.rollout.episode_loop import EpisodeJob, episode_start
from vla_attention.capture.engine.call import record_call, replan_record
from vla_attention.capture.engine.progress import say
from vla_attention.capture.engine.plan import plan_recording, recording_settings, root_attributes
from vla_attention.capture.store.episode_writer import EpisodeWriter
from vla_attention.capture.store.store_writer import RunStore, open_run
from vla_attention.schemas.errors import listing
from vla_attention.schemas.layout import picture_size


class RobotPolicy(Policy, Protocol):
    """A policy of a family that reads data sets, built for the robot of one."""

    @property
    def robot(self) -> Robot:
        """The columns that the policy reads."""

    def prepare_robot(
        self, pictures: Mapping[str, NDArray[np.uint8]], state: NDArray[np.float64], instruction: str
    ) -> PolicyInput:
        """Turn a frame into the model's input; pictures: column -> (height, width, 3) uint8."""


@dataclass(frozen=True)
class Replay:
    """A policy on a data set.

    every: a call at frame 0, every, 2 · every ... instruction: what the policy reads instead of the tasks; None: the
    tasks. machine: provenance of this process.
    """

    policy: RobotPolicy
    store: RunStore
    every: int
    seed: int
    instruction: str | None
    machine: Mapping[str, str]
    effects: EffectMeasurement | None = None


def replay_episode(replay: Replay, job: EpisodeJob, episode: DataSetEpisode, before_call: BeforeCall) -> Path:
    """Make the policy calls of one episode, and commit them; returns its folder in the store.

    The step of a replan is the number of its frame. The recorded actions of a replan are those from its frame on, as
    many as the policy gives, fewer at the end of the episode. Whether the task was solved is not known unless the data
    set has a column `next.success`.
    """
    policy, recording = replay.policy, replay.store.attributes.recording
    state = joined(episode, policy.robot.state)
    actions = joined(episode, policy.robot.actions) if policy.robot.actions else None
    digest = hashlib.sha256(np.ascontiguousarray(state[0]).tobytes()).hexdigest()
    start = episode_start(job.task, job.episode_index, replay.machine, state_digest=digest, objects=())
    denoise_times = policy.denoise_times()[list(recording.denoise_steps)]
    effects = None if replay.effects is None else replay.effects.begin()
    with replay.store.episode(start, np.asarray(denoise_times), job.size) as writer:
        cameras = tuple(policy.robot.cameras.values())
        for frame in episode.frames(replay.every, cameras):
            before_call(len(writer.records))
            _append_call(replay, writer, frame, job.task.task_id, state[frame.index], actions, effects)
        return writer.commit(success_of(episode), episode.length)


def _append_call(
    replay: Replay,
    writer: EpisodeWriter,
    frame: DataSetFrame,
    task_id: int,
    state: NDArray[np.float64],
    actions: NDArray[np.float64] | None,
    effects: EpisodeEffectsMeasured | None,
) -> None:
    policy, recording = replay.policy, replay.store.attributes.recording
    instruction = frame.instruction if replay.instruction is None else replay.instruction
    policy_input = policy.prepare_robot(frame.images, state, instruction)
    seed = policy.replan_noise_seed(replay.seed, task_id, frame.episode, len(writer.records))
    where = f"replan {len(writer.records)} (frame {frame.index}) of {writer.what}"
    call = record_call(policy, policy_input, seed, recording, where)
    context = CallContext(task_id, frame.episode, len(writer.records))
    writer.append(
        replan_record(
            policy_input,
            call,
            recording,
            env_step=frame.index,
            noise_seed=seed,
            effects=None if effects is None else effects.measure(policy_input, seed, call.actions, context),
            dataset_actions=None if actions is None else actions[frame.index : frame.index + policy.action_horizon],
        )
    )


def replay_with_family(arguments: argparse.Namespace, plan: ReplayPlan, device: str) -> int:
    """Build the policy for the robot of the data set, and record its calls; returns the number of new episodes."""
    family: PolicyFamily = arguments.family
    arguments.robot_data = plan.robot_data
    policy = cast(RobotPolicy, family.build(arguments, device))
    robot = policy.robot
    plan.data.check_files(plan.wanted, tuple(robot.cameras.values()))
    recording, note = plan_recording(recording_settings(arguments), policy, plan.seed)
    if note:
        say(note)
    every = plan.every or policy.default_replan_steps
    attributes = root_attributes(
        policy.identity(),
        policy.sites,
        plan.protocol(every),
        recording,
        describe_machine(device) | downloads_of(policy) | plan.data.downloads | decoder_version(),
        data_set=plan.source(columns_of(robot.cameras, robot.state, robot.actions)),
    )
    store = open_run(plan.store, attributes, plan.mode)
    todo = announce(plan, attributes, policy.action_horizon, _picture_sizes(plan.data, policy))
    masked = [camera for camera in policy.sites[0].cameras if camera not in robot.cameras]
    if masked:
        say(f"Black and masked: {listing(masked)}.")
    # A data set knows no families of tasks, so there are no words to exchange.
    pictures = pictures_of(effect_settings(arguments), policy, attributes.protocol.suite)
    effects = measurement_of(recording.effects, policy, [], say, pictures)
    if recording.effects is not None:
        say(describe_effects(recording.effects))
    replay = Replay(policy, store, every, plan.seed, plan.instruction, attributes.provenance, effects)
    return len(record_episodes(plan, store, todo, every, partial(replay_episode, replay)))


def _picture_sizes(data: LeRobotDataset, policy: RobotPolicy) -> list[int]:
    """Return the bytes of every picture that is stored of a call."""
    sizes = [math.prod(picture_size(policy.sites, camera.name)) * 3 for camera in policy.cameras]
    if policy.needs_camera_frames:
        sizes += [math.prod(data.feature(camera.source).shape) for camera in policy.cameras]
    return sizes
