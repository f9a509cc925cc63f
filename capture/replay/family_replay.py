"""A replay with a policy of a family that reads data sets (pi0 and pi0.5)."""

from __future__ import annotations

import argparse
import hashlib
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Protocol, cast

import numpy as np
from numpy.typing import NDArray

from vla_attention.capture.effects.mean_pictures import pictures_of
from vla_attention.capture.effects.measurement import measurement_of
from vla_attention.capture.engine.call import Caller, PolicyCall
from vla_attention.capture.engine.plan import plan_recording, root_attributes
from vla_attention.capture.engine.progress import say
from vla_attention.capture.engine.settings import recording_settings
from vla_attention.capture.engine.source import Episode, EpisodeJob, Outcome, Source, episode_start
from vla_attention.capture.interventions.changed_inputs import CallContext
from vla_attention.capture.machine import describe_machine
from vla_attention.capture.policies.family import PolicyFamily
from vla_attention.capture.policies.identity import downloads_of
from vla_attention.capture.policies.policy import Policy, PolicyInput
from vla_attention.capture.policies.robot import Robot
from vla_attention.capture.replay.replay_plan import (
    ReplayPlan,
    announce_replay,
    columns_of,
    joined,
    record_episodes,
    success_of,
)
from vla_attention.capture.store.replan_records import EpisodeStart
from vla_attention.capture.store.store_writer import open_run
from vla_attention.schemas.data_sets.lerobot_dataset import DataSetEpisode, DataSetFrame, LeRobotDataset
from vla_attention.schemas.data_sets.video import decoder_version
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


@dataclass
class Frames(Source):
    """The frames of a data set's episodes, for a policy of a family.

    every: a call at frame 0, every, 2 · every ... instruction: what the policy reads instead of the tasks; None: the
    tasks. machine: provenance that is stored with every episode.
    """

    policy: RobotPolicy
    caller: Caller
    plan: ReplayPlan
    every: int
    machine: Mapping[str, str]

    def open(self, job: EpisodeJob) -> FramesOfEpisode:
        """Open an episode."""
        episode, robot = self.plan.data.episode(job.episode_index), self.policy.robot
        state = joined(episode, robot.state)
        actions = joined(episode, robot.actions) if robot.actions else None
        digest = hashlib.sha256(np.ascontiguousarray(state[0]).tobytes()).hexdigest()
        start = episode_start(job, self.machine, state_digest=digest)
        frames = episode.frames(self.every, tuple(robot.cameras.values()))
        return FramesOfEpisode(self, job, episode, start, frames, state, actions)


@dataclass
class FramesOfEpisode(Episode):
    """One episode. state: (frame, number); actions: (frame, number), None where the policy's are not recorded.

    The step of a replan is the number of its frame. The recorded actions of a replan are those from its frame on, as
    many as the policy gives, fewer at the end of the episode. Whether the task was solved is not known unless the data
    set has a column `next.success`.
    """

    source: Frames
    job: EpisodeJob
    episode: DataSetEpisode
    start: EpisodeStart
    frames: Iterator[DataSetFrame]
    state: NDArray[np.float64]
    actions: NDArray[np.float64] | None
    done: int = 0

    def poll(self) -> PolicyCall | Outcome:
        """Return the policy call of the next frame."""
        frame = next(self.frames, None)
        if frame is None:
            return Outcome(success_of(self.episode), self.episode.length)
        plan, policy, actions = self.source.plan, self.source.policy, self.actions
        given = plan.settings.instruction
        context = CallContext(self.job.task.task_id, frame.episode, self.done)
        return PolicyCall(
            policy.prepare_robot(frame.images, self.state[frame.index], frame.instruction if given is None else given),
            self.source.caller.drawn_seed(plan.settings.seed, context),
            context,
            frame.index,
            f"replan {self.done} (frame {frame.index}) of episode {self.job.name} of {plan.store}",
            dataset_actions=None if actions is None else actions[frame.index : frame.index + policy.action_horizon],
        )


def replay_with_family(arguments: argparse.Namespace, plan: ReplayPlan, device: str) -> int:
    """Build the policy for the robot of the data set, and record its calls; returns the number of new episodes."""
    family: PolicyFamily = arguments.family
    arguments.robot_data = plan.robot_data
    policy = cast(RobotPolicy, family.read(arguments).build(device))
    robot = policy.robot
    plan.data.check_files(plan.wanted, tuple(robot.cameras.values()))
    settings = recording_settings(arguments)
    recording, note = plan_recording(settings, policy, plan.settings.seed)
    if note:
        say(note)
    every = plan.settings.every or policy.default_replan_steps
    attributes = root_attributes(
        policy.identity(),
        policy.sites,
        plan.protocol(every),
        recording,
        describe_machine(device) | downloads_of(policy) | plan.data.downloads | decoder_version(),
        data_set=plan.source(columns_of(robot.cameras, robot.state, robot.actions), robot.actions),
    )
    store = open_run(plan.store, attributes, plan.mode)
    todo = announce_replay(plan, attributes, policy.action_horizon, _picture_sizes(plan.data, policy))
    masked = [camera for camera in policy.sites[0].cameras if camera not in robot.cameras]
    if masked:
        say(f"Black and masked: {listing(masked)}.")
    # A data set knows no families of tasks, so there are no words to exchange.
    pictures = pictures_of(settings.effects, policy, attributes.protocol.suite)
    effects = measurement_of(recording.effects, policy, [], say, pictures, policy.action_horizon)
    caller = Caller(policy, recording, effects=effects, looks_at_words=True)
    source = Frames(policy, caller, plan, every, attributes.provenance)
    return record_episodes(plan, store, todo, every, source)


def _picture_sizes(data: LeRobotDataset, policy: RobotPolicy) -> list[int]:
    """Return the bytes of every picture that is stored of a call."""
    sizes = [math.prod(picture_size(policy.sites, camera.name)) * 3 for camera in policy.cameras]
    if policy.needs_camera_frames:
        sizes += [math.prod(data.feature(camera.source).shape) for camera in policy.cameras]
    return sizes
