"""`vla-capture replay`: make policy calls on the frames of a data set, and record them into a store."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import cast

from vla_attention.capture.capture_run import plan_recording
from vla_attention.capture.command_line import check_writable
from vla_attention.capture.device import load_torch
from vla_attention.capture.jobs.damaged_episodes import find_damaged
from vla_attention.capture.jobs.termination import Termination
from vla_attention.capture.policies.family import PolicyFamily
from vla_attention.capture.policies.policy import camera_grid
from vla_attention.capture.policies.robot import Robot, RobotData
from vla_attention.capture.provenance import describe_machine
from vla_attention.capture.replay.chosen_episodes import chosen_episodes
from vla_attention.capture.replay.lerobot_dataset import DataSetEpisode, LeRobotDataset, open_dataset
from vla_attention.capture.replay.replay_episodes import Replay, num_calls, replay_episode, task_of
from vla_attention.capture.replay.robot_policy import RobotPolicy
from vla_attention.capture.rerun.progress import RerunProgress
from vla_attention.capture.rollout.progress import say
from vla_attention.capture.run_settings import recording_settings
from vla_attention.capture.store.disk_estimate import describe, estimate_disk
from vla_attention.capture.store.store_writer import WriteMode, open_run, refuse_existing
from vla_attention.schemas.errors import BadArgument, listing
from vla_attention.schemas.safe_text import file_part
from vla_attention.schemas.stores.store_format import (
    FORMAT_NAME,
    FORMAT_VERSION,
    STORE_SUFFIX,
    DataSetSource,
    Protocol,
    Recording,
    RootAttributes,
    StoreExists,
    episode_name,
)
from vla_attention.schemas.threads import Threads


def run_replay(arguments: argparse.Namespace, threads: Threads, termination: Termination) -> int:
    """Run `vla-capture replay` on parsed arguments; returns the exit code."""
    if arguments.every is not None and arguments.every < 1:
        raise BadArgument(f"Cannot use --every {arguments.every}; expected at least 1.")
    if arguments.seed < 0:
        raise BadArgument(f"Cannot use --seed {arguments.seed}; expected 0 or more.")
    data = open_dataset(arguments.data_set)
    wanted = chosen_episodes(data, arguments.episodes, arguments.num_episodes)
    store = _target(arguments, data)
    mode: WriteMode = "overwrite" if arguments.overwrite else "resume" if arguments.resume else "new"
    # An existing store or an unwritable place is an error now, before the minutes for loading a model.
    if mode == "new" and store.exists():
        refuse_existing(store)
    check_writable(store.parent, "--store")
    arguments.robot_data = robot_data(data, arguments)
    say(threads.describe())
    device = load_torch(arguments.device, threads.number)
    family: PolicyFamily = arguments.family
    policy = cast(RobotPolicy, family.build(arguments, device))
    data.check_files(wanted, tuple(policy.robot.cameras.values()))
    recording, note = plan_recording(recording_settings(arguments), policy)
    if note:
        say(note)
    every = arguments.every or policy.default_replan_steps
    attributes = _attributes(data, policy, recording, every, arguments.seed, describe_machine(device))
    run = open_run(store, attributes, mode)
    replay = Replay(policy, run, every, arguments.seed, arguments.instruction, attributes.provenance)
    added = _record(data, wanted, replay, termination)
    say(f"{added} episodes added. Store: {store}")
    say(f"Next: vla-analyze {store}")
    return 0


def robot_data(data: LeRobotDataset, arguments: argparse.Namespace) -> RobotData:
    """Return what the data set offers and what the options choose of it.

    Raises:
        BadArgument: a `--camera` is not POLICY=COLUMN, or names a camera of the policy twice.
    """
    cameras: dict[str, str] = {}
    for word in arguments.camera:
        camera, sign, column = word.partition("=")
        if not (camera and sign and column):
            raise BadArgument(
                f"Cannot use --camera {word}; expected POLICY=COLUMN, with a column of {listing(data.cameras)} or none."
            )
        if camera in cameras:
            raise BadArgument(f"--camera names the policy's camera '{camera}' twice.")
        cameras[camera] = column
    numbers = {
        name: feature.shape[0] if feature.shape else 1
        for name, feature in data.features.items()
        if feature.dtype.startswith(("float", "int", "uint")) and len(feature.shape) <= 1
    }
    indices = ("timestamp", "frame_index", "episode_index", "index", "task_index")
    return RobotData(
        name=data.name,
        cameras=data.cameras,
        numbers={name: size for name, size in numbers.items() if name not in indices},
        chosen_cameras=cameras,
        chosen_state=tuple(arguments.state),
        chosen_actions=tuple(arguments.action),
        relative_actions=arguments.relative_actions,
    )


def _target(arguments: argparse.Namespace, data: LeRobotDataset) -> Path:
    if arguments.store is not None:
        return Path(arguments.store)
    return Path("runs") / f"{file_part(_suite(data))}{STORE_SUFFIX}"


def _suite(data: LeRobotDataset) -> str:
    """Return the data set's name without its organisation."""
    return data.name.rpartition("/")[2]


def _attributes(
    data: LeRobotDataset, policy: RobotPolicy, recording: Recording, every: int, seed: int, machine: dict[str, str]
) -> RootAttributes:
    info = data.info
    source = DataSetSource(
        name=data.name,
        version=info.version,
        fps=info.fps,
        robot_type=info.robot_type,
        digest=data.digest,
        columns=_columns(policy.robot),
    )
    protocol = Protocol(
        name="dataset",
        suite=_suite(data),
        seed=seed,
        wait_steps=0,
        replan_steps=every,
        max_steps=0,
        image_size=0,
    )
    return RootAttributes(
        format=FORMAT_NAME,
        format_version=FORMAT_VERSION,
        policy=policy.identity(),
        protocol=protocol,
        recording=recording,
        sites=policy.sites,
        provenance=machine,
        data_set=source,
    )


def _columns(robot: Robot) -> dict[str, str]:
    cameras = {f"camera {camera}": column for camera, column in robot.cameras.items()}
    return cameras | {"state": ", ".join(robot.state), "actions": ", ".join(robot.actions) or "none"}


def _announce(data: LeRobotDataset, replay: Replay, wanted: tuple[int, ...], todo: tuple[int, ...]) -> None:
    policy, attributes = replay.policy, replay.store.attributes
    identity, recording = attributes.policy, attributes.recording
    say(
        f"Policy: {identity.name} ({identity.checkpoint_format}: {identity.checkpoint}), weights "
        f"{identity.digest[:12]}."
    )
    if identity.untrained:
        say(
            "These weights are random and UNTRAINED: the numbers show that the tool works, and say nothing about any "
            "policy."
        )
    info = data.info
    say(
        f"Data set: {data.name}, LeRobotDataset {info.version}, {len(info.episodes)} episodes of {len(info.tasks)} "
        f"tasks at {info.fps:g} frames per second, robot {info.robot_type}."
    )
    say(f"Columns: {'; '.join(f'{what} = {column}' for what, column in _columns(policy.robot).items())}.")
    masked = [camera for camera in policy.sites[0].cameras if camera not in policy.robot.cameras]
    if masked:
        say(f"Black and masked: {listing(masked)}.")
    calls = [num_calls(data.entry(index).length, replay.every) for index in todo]
    say(
        f"Policy calls: {sum(calls)}, every {replay.every} frames ({replay.every / info.fps:.3g} s), of "
        f"{policy.action_horizon} actions each."
    )
    say(
        f"Recording {len(recording.layers)} layers, denoise steps {listing(recording.denoise_steps)}, "
        f"{len(recording.heads)} heads, {', '.join(str(site.num_keys) for site in attributes.sites)} keys."
    )
    estimate = estimate_disk(
        recording, attributes.sites, _picture_sizes(data, policy), max(calls, default=0), len(calls)
    )
    say(describe(estimate, replay.store.path))
    if len(todo) < len(wanted):
        say(f"{len(wanted) - len(todo)} of {len(wanted)} episodes are complete already; {len(todo)} to run.")


def _picture_sizes(data: LeRobotDataset, policy: RobotPolicy) -> list[int]:
    """Return the bytes of every picture that is stored of a call."""
    grids = [camera_grid(policy.sites, camera.name) for camera in policy.cameras]
    sizes = [grid.image_height * grid.image_width * 3 for grid in grids]
    if policy.needs_camera_frames:
        for camera in policy.cameras:
            size = 1
            for side in data.feature(camera.source).shape:
                size *= side
            sizes.append(size)
    return sizes


def _record(data: LeRobotDataset, wanted: tuple[int, ...], replay: Replay, termination: Termination) -> int:
    """Make the calls of the episodes that the store lacks; returns how many episodes were added."""
    store = replay.store
    done = {episode for _, episode in store.committed()}
    todo = tuple(index for index in wanted if index not in done)
    _announce(data, replay, wanted, todo)
    names = {episode_name(*pair) for pair in store.committed()}
    for fault in find_damaged(store.path, names, False) if names else []:
        say(f"Not recorded again without vla-capture repair: {fault.describe()}")
    progress = RerunProgress(len(todo), sum(num_calls(data.entry(index).length, replay.every) for index in todo))
    added = 0
    try:
        for index in todo:
            termination.check()
            episode = data.episode(index)
            # Another process may run the same command, and have committed the episode meanwhile.
            if store.has(task_of(episode), index):
                continue
            with termination.only_at_checks():
                added += _record_one(replay, episode, progress, termination)
    finally:
        progress.close()
    return added


def _record_one(replay: Replay, episode: DataSetEpisode, progress: RerunProgress, termination: Termination) -> int:
    calls = num_calls(episode.length, replay.every)
    progress.begin(f"episode {episode.index}")

    def before_call(done: int) -> None:
        termination.check()
        progress.update(done, calls)

    try:
        replay_episode(replay, episode, before_call)
    except StoreExists:
        return 0
    progress.end(calls)
    return 1
