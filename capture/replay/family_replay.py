"""A replay with a policy of a family that reads data sets (pi0 and pi0.5)."""

from __future__ import annotations

import argparse
import math
from typing import cast

from vla_attention.capture.capture_run import plan_recording
from vla_attention.capture.policies.family import PolicyFamily
from vla_attention.capture.policies.identity import downloads_of
from vla_attention.capture.policies.policy import camera_grid
from vla_attention.capture.provenance import describe_machine
from vla_attention.capture.replay.lerobot_dataset import LeRobotDataset
from vla_attention.capture.replay.replay_episodes import Replay, replay_episode
from vla_attention.capture.replay.replay_plan import ReplayPlan, announce, columns_of, record_episodes
from vla_attention.capture.replay.robot_policy import RobotPolicy
from vla_attention.capture.replay.video import decoder_version
from vla_attention.capture.rollout.progress import say
from vla_attention.capture.run_settings import recording_settings
from vla_attention.capture.store.store_writer import open_run
from vla_attention.schemas.errors import listing
from vla_attention.schemas.stores.store_format import FORMAT_NAME, STORE_VERSION, RootAttributes


def replay_with_family(arguments: argparse.Namespace, plan: ReplayPlan, device: str) -> int:
    """Build the policy for the robot of the data set, and record its calls; returns the number of new episodes."""
    family: PolicyFamily = arguments.family
    arguments.robot_data = plan.robot_data
    policy = cast(RobotPolicy, family.build(arguments, device))
    robot = policy.robot
    plan.data.check_files(plan.wanted, tuple(robot.cameras.values()))
    recording, note = plan_recording(recording_settings(arguments), policy)
    if note:
        say(note)
    every = plan.every or policy.default_replan_steps
    attributes = RootAttributes(
        format=FORMAT_NAME,
        store_version=STORE_VERSION,
        policy=policy.identity(),
        protocol=plan.protocol(every),
        recording=recording,
        sites=policy.sites,
        provenance=describe_machine(device) | downloads_of(policy) | plan.data.downloads | decoder_version(),
        data_set=plan.source(columns_of(robot.cameras, robot.state, robot.actions)),
    )
    store = open_run(plan.store, attributes, plan.mode)
    todo = announce(plan, attributes, policy.action_horizon, _picture_sizes(plan.data, policy))
    masked = [camera for camera in policy.sites[0].cameras if camera not in robot.cameras]
    if masked:
        say(f"Black and masked: {listing(masked)}.")
    replay = Replay(policy, store, every, plan.seed, plan.instruction, attributes.provenance)
    return record_episodes(plan, todo, every, lambda episode, before: replay_episode(replay, episode, before))


def _picture_sizes(data: LeRobotDataset, policy: RobotPolicy) -> list[int]:
    """Return the bytes of every picture that is stored of a call."""
    grids = [camera_grid(policy.sites, camera.name) for camera in policy.cameras]
    sizes = [grid.image_height * grid.image_width * 3 for grid in grids]
    if policy.needs_camera_frames:
        sizes += [math.prod(data.feature(camera.source).shape) for camera in policy.cameras]
    return sizes
