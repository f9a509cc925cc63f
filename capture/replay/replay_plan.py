"""What a replay is before its policy is loaded: data set, episodes, store; and what is said and stored of it."""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from vla_attention.capture.command_line import check_writable
from vla_attention.capture.jobs.termination import Termination
from vla_attention.capture.policies.identity import announcement
from vla_attention.capture.policies.robot import RobotData
from vla_attention.capture.recording.finite_numbers import NumbersNotFinite
from vla_attention.capture.replay.chosen_episodes import chosen_episodes
from vla_attention.capture.replay.data_set_files import INDEX_COLUMNS
from vla_attention.capture.replay.lerobot_dataset import DataSetEpisode, LeRobotDataset, open_dataset
from vla_attention.capture.replay.replay_episodes import EpisodeReplay, num_calls, task_of
from vla_attention.capture.replay.video import import_av
from vla_attention.capture.rerun.progress import RerunProgress
from vla_attention.capture.rollout.episode_faults import Faults
from vla_attention.capture.rollout.progress import say
from vla_attention.capture.store.disk_estimate import describe, estimate_disk
from vla_attention.capture.store.episode_writer import ReplanRefused
from vla_attention.capture.store.store_writer import WriteMode, refuse_existing
from vla_attention.schemas.errors import BadArgument, listing
from vla_attention.schemas.plurals import plural
from vla_attention.schemas.safe_text import file_part
from vla_attention.schemas.stores.damaged_episodes import find_damaged
from vla_attention.schemas.stores.root import episode_folders
from vla_attention.schemas.stores.store_format import (
    EPISODES_GROUP,
    STORE_SUFFIX,
    DataSetSource,
    Protocol,
    RootAttributes,
    StoreExists,
    episode_name,
    parse_episode_name,
)
from vla_attention.schemas.stores.store_place import check_place


@dataclass(frozen=True)
class ReplayPlan:
    """A replay that is to be made.

    wanted: numbers of the episodes. every: a policy call at frame 0, every, 2 · every ...; None: as the policy says.
    instruction: what the policy reads instead of the data set's tasks; None: the tasks.
    faults: of episodes that were left out.
    """

    data: LeRobotDataset
    wanted: tuple[int, ...]
    store: Path
    mode: WriteMode
    every: int | None
    seed: int
    instruction: str | None
    robot_data: RobotData
    termination: Termination
    faults: Faults = field(default_factory=Faults)

    def protocol(self, every: int) -> Protocol:
        """Return the protocol of the run: without a simulator, numbers of one are 0."""
        return Protocol(
            name="dataset",
            suite=suite_of(self.data),
            seed=self.seed,
            wait_steps=0,
            replan_steps=every,
            max_steps=0,
            image_size=0,
        )

    def source(self, columns: Mapping[str, str]) -> DataSetSource:
        """Return what the store says of the data set; columns: what the policy reads -> column."""
        info = self.data.info
        return DataSetSource(self.data.name, info.version, info.fps, info.robot_type, self.data.digest, dict(columns))

    def calls(self, index: int, every: int) -> int:
        """Return the number of policy calls of an episode."""
        return num_calls(self.data.entry(index).length, every)


def plan_replay(arguments: argparse.Namespace, termination: Termination) -> ReplayPlan:
    """Open the data set and check everything that needs no policy.

    Raises:
        DataSetError: there is no data set, or not one that can be read.
        BadArgument, UnknownName: an option cannot be used, or names what does not exist.
        StoreExists: a store is there, and is neither to be continued nor to be replaced.
    """
    if arguments.every is not None and arguments.every < 1:
        raise BadArgument(f"Cannot use --every {arguments.every}; expected at least 1.")
    if arguments.seed < 0:
        raise BadArgument(f"Cannot use --seed {arguments.seed}; expected 0 or more.")
    data = open_dataset(arguments.data_set)
    if any(data.feature(camera).dtype == "video" for camera in data.cameras):
        import_av()  # that PyAV is missing is said now, too
    wanted = chosen_episodes(data, arguments.episodes, arguments.num_episodes)
    store = arguments.store or Path("runs") / f"{file_part(suite_of(data))}{STORE_SUFFIX}"
    check_place(store, "write a store at")
    mode: WriteMode = "overwrite" if arguments.overwrite else "resume" if arguments.resume else "new"
    # An existing store or an unwritable place is an error now, before the minutes for loading a model.
    if mode == "new" and store.exists():
        refuse_existing(store)
    check_writable(store.parent, "--store")
    return ReplayPlan(
        data=data,
        wanted=wanted,
        store=store,
        mode=mode,
        every=arguments.every,
        seed=arguments.seed,
        instruction=arguments.instruction,
        robot_data=robot_data(data, arguments),
        termination=termination,
    )


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
        name: math.prod(feature.shape)
        for name, feature in data.features.items()
        if feature.dtype.startswith(("float", "int", "uint")) and len(feature.shape) <= 1
    }
    return RobotData(
        name=data.name,
        cameras=data.cameras,
        numbers={name: size for name, size in numbers.items() if name not in INDEX_COLUMNS},
        chosen_cameras=cameras,
        chosen_state=tuple(arguments.state),
        chosen_actions=tuple(arguments.action),
        relative_actions=getattr(arguments, "relative_actions", None),
    )


def suite_of(data: LeRobotDataset) -> str:
    """Return the data set's name without its organisation."""
    return data.name.rpartition("/")[2]


def columns_of(cameras: Mapping[str, str], state: Sequence[str], actions: Sequence[str]) -> dict[str, str]:
    """Return what the policy reads -> column, for the store and the terminal."""
    named = {f"camera {camera}": column for camera, column in cameras.items()}
    return named | {"state": ", ".join(state) or "none", "actions": ", ".join(actions) or "none"}


def announce(
    plan: ReplayPlan, attributes: RootAttributes, horizon: int, picture_sizes: Sequence[int]
) -> tuple[int, ...]:
    """Print what will be recorded and how much disk it can take; returns the episodes that the store lacks.

    horizon: actions of a policy call; 0 where it is not known. picture_sizes: bytes of the pictures of a call.
    """
    identity, recording, info = attributes.policy, attributes.recording, plan.data.info
    every = attributes.protocol.replan_steps
    source = attributes.data_set
    stored = sorted(path.name for path in episode_folders(plan.store)) if plan.store.exists() else []
    done = {parse_episode_name(name)[1] for name in stored}
    todo = tuple(index for index in plan.wanted if index not in done)
    for line in announcement(identity):
        say(line)
    say(
        f"Data set: {plan.data.name}, LeRobotDataset {info.version}, {plural(len(info.episodes), 'episode')} of "
        f"{plural(len(info.tasks), 'task')} at {info.fps:g} frames per second, robot {info.robot_type}."
    )
    if source is not None:
        say(f"Columns: {'; '.join(f'{what} = {column}' for what, column in source.columns.items())}.")
    if not attributes.interventions.is_none:
        say(f"Interventions: {attributes.interventions.describe()}.")
    calls = [plan.calls(index, every) for index in todo]
    of_actions = f", of {horizon} actions each" if horizon else ""
    say(f"Policy calls: {sum(calls)}, every {every} frames ({every / info.fps:.3g} s){of_actions}.")
    say(
        f"Recording {len(recording.layers)} layers, denoise steps {listing(recording.denoise_steps)}, "
        f"{len(recording.heads)} heads, {', '.join(str(site.num_keys) for site in attributes.sites)} keys."
    )
    estimate = estimate_disk(recording, attributes.sites, picture_sizes, max(calls, default=0), len(calls))
    say(describe(estimate, plan.store))
    if len(todo) < len(plan.wanted):
        say(f"{len(plan.wanted) - len(todo)} of {len(plan.wanted)} episodes are complete already; {len(todo)} to run.")
    for fault in find_damaged(plan.store, set(stored), False) if stored else []:
        say(f"Not recorded again without vla-capture repair: {fault.describe()}")
    return todo


def record_episodes(plan: ReplayPlan, todo: Sequence[int], every: int, replay: EpisodeReplay) -> int:
    """Make the calls of the episodes; returns how many were added. One with a fault is left out, and noted in the plan.

    Raises:
        Terminated: SIGTERM was received; the episode in progress was dropped.
    """
    progress = RerunProgress(len(todo), sum(plan.calls(index, every) for index in todo))
    added = 0
    try:
        for index in todo:
            plan.termination.check()
            episode = plan.data.episode(index)
            # Another process may run the same command, and have committed the episode meanwhile.
            if (plan.store / EPISODES_GROUP / episode_name(task_of(episode), index)).is_dir():
                continue
            progress.begin(f"episode {index}")
            again = True
            while again:
                again = False
                try:
                    with plan.termination.only_at_checks():
                        added += _record_one(plan, episode, every, replay, progress)
                except (NumbersNotFinite, ReplanRefused) as error:
                    again = plan.faults.note(episode_name(task_of(episode), index), error)
                    what_next = "It begins again." if again else "It is left out."
                    progress.say(f"episode {index}: {error} {what_next}")
            progress.end(plan.calls(index, every))
    finally:
        progress.close()
    return added


def _record_one(
    plan: ReplayPlan, episode: DataSetEpisode, every: int, replay: EpisodeReplay, progress: RerunProgress
) -> int:
    calls = plan.calls(episode.index, every)

    def before_call(done: int) -> None:
        plan.termination.check()
        progress.update(done, calls)

    try:
        replay(episode, before_call)
    except StoreExists:
        return 0
    return 1
