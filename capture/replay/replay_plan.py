"""What a replay is before its policy is loaded: data set, episodes, store; and what is said and stored of it."""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vla_attention.capture.engine.faults import Faults
from vla_attention.capture.engine.loop import EpisodeLoop
from vla_attention.capture.engine.plan import announce
from vla_attention.capture.engine.settings import StoreOutput
from vla_attention.capture.engine.source import EpisodeJob, Source
from vla_attention.capture.environments.base import Task
from vla_attention.capture.jobs.worker_log import plan_of
from vla_attention.capture.policies.robot import RobotData, read_camera_choices
from vla_attention.capture.replay.arguments import ReplaySettings
from vla_attention.capture.store.disk_estimate import estimate_disk
from vla_attention.capture.store.store_writer import RunStore, WriteMode, check_target
from vla_attention.schemas.data_sets.data_set_files import INDEX_COLUMNS
from vla_attention.schemas.data_sets.lerobot_dataset import DataSetEpisode, LeRobotDataset, open_dataset
from vla_attention.schemas.data_sets.video import import_av
from vla_attention.schemas.errors import BadArgument, plural
from vla_attention.schemas.options import read_options
from vla_attention.schemas.progress_bar import progress_bar
from vla_attention.schemas.safe_text import file_part, visible
from vla_attention.schemas.stop_signals import Termination
from vla_attention.schemas.stores.root import episode_folders
from vla_attention.schemas.stores.store_format import (
    DataSetSource,
    Protocol,
    RootAttributes,
    parse_episode_name,
)
from vla_attention.schemas.stores.verify import find_damaged

#: The column that says of every frame whether the task is solved, where a data set has it.
SUCCESS_COLUMN = "next.success"


@dataclass(frozen=True)
class ReplayPlan:
    """A replay that is to be made.

    wanted: numbers of the episodes. faults: of episodes that were left out.
    """

    settings: ReplaySettings
    data: LeRobotDataset
    wanted: tuple[int, ...]
    store: Path
    mode: WriteMode
    robot_data: RobotData
    termination: Termination
    faults: Faults = field(default_factory=Faults)

    def protocol(self, every: int) -> Protocol:
        """Return the protocol of the run: without a simulator, numbers of one are 0."""
        return Protocol(
            name="dataset",
            suite=suite_of(self.data),
            seed=self.settings.seed,
            wait_steps=0,
            replan_steps=every,
            max_steps=0,
            image_size=0,
        )

    def source(self, columns: Mapping[str, str], actions: Sequence[str]) -> DataSetSource:
        """Return what the store says of the data set; columns: what the policy reads -> column. actions: of actions."""
        info, features = self.data.info, [self.data.feature(name) for name in actions]
        known = all(len(one.names) == math.prod(one.shape) for one in features)
        names = [visible(name) for one in features for name in one.names] if known else []
        return DataSetSource(
            self.data.name, info.version, info.fps, info.robot_type, self.data.digest, dict(columns), tuple(names)
        )

    def job(self, index: int, every: int) -> EpisodeJob:
        """Return what is to be recorded of an episode. Its task is that of its first frame."""
        task = self.task(int(self.data.episode(index).task_indices[0]))
        return EpisodeJob(task, index, self.calls(index, every), f"episode {index}")

    def task(self, task_id: int) -> Task:
        """Return a task of the data set, with the instruction that it is given."""
        instruction = self.data.tasks[task_id] if self.settings.instruction is None else self.settings.instruction
        name = re.sub(r"\W+", "_", instruction.strip()).strip("_")[:60] or f"task_{task_id}"
        return Task(suite_of(self.data), task_id, name, instruction, num_initial_states=0)

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
    settings, output = read_options(ReplaySettings, arguments), read_options(StoreOutput, arguments)
    data = open_dataset(arguments.data_set)
    if any(data.feature(camera).dtype == "video" for camera in data.cameras):
        import_av()  # that PyAV is missing is said now, too
    wanted = chosen_episodes(data, settings)
    store = output.place(file_part(suite_of(data)))
    # An existing store or an unwritable place is an error now, before the minutes for loading a model.
    check_target(store, output.mode)
    return ReplayPlan(settings, data, wanted, store, output.mode, robot_data(data, settings), termination)


def robot_data(data: LeRobotDataset, settings: ReplaySettings) -> RobotData:
    """Return what the data set offers and what the options choose of it.

    Raises:
        BadArgument: a `--camera` is not POLICY=COLUMN, or names a camera of the policy twice.
    """
    numbers = {
        name: math.prod(feature.shape)
        for name, feature in data.features.items()
        if feature.dtype.startswith(("float", "int", "uint")) and len(feature.shape) <= 1
    }
    return RobotData(
        name=data.name,
        cameras=data.cameras,
        numbers={name: size for name, size in numbers.items() if name not in INDEX_COLUMNS},
        chosen_cameras=read_camera_choices(settings.camera, data.cameras),
        chosen_state=settings.state,
        chosen_actions=settings.action,
        relative_actions=settings.relative_actions,
    )


def suite_of(data: LeRobotDataset) -> str:
    """Return the data set's name without its organisation."""
    return data.name.rpartition("/")[2]


def columns_of(cameras: Mapping[str, str], state: Sequence[str], actions: Sequence[str]) -> dict[str, str]:
    """Return what the policy reads -> column, for the store and the terminal."""
    named = {f"camera {camera}": column for camera, column in cameras.items()}
    return named | {"state": ", ".join(state) or "none", "actions": ", ".join(actions) or "none"}


def announce_replay(
    plan: ReplayPlan, attributes: RootAttributes, horizon: int, picture_sizes: Sequence[int]
) -> tuple[int, ...]:
    """Print what will be recorded and how much disk it can take; returns the episodes that the store lacks.

    horizon: actions of a policy call; 0 where it is not known. picture_sizes: bytes of the pictures of a call.
    """
    info, every, source = plan.data.info, attributes.protocol.replan_steps, attributes.data_set
    stored = sorted(path.name for path in episode_folders(plan.store)) if plan.store.exists() else []
    done = {parse_episode_name(name)[1] for name in stored}
    todo = tuple(index for index in plan.wanted if index not in done)
    calls = [plan.calls(index, every) for index in todo]
    lines = [
        f"Data set: {plan.data.name}, LeRobotDataset {info.version}, {plural(len(info.rows), 'episode')} of "
        f"{plural(len(info.tasks), 'task')} at {info.fps:g} frames per second, robot {info.robot_type}."
    ]
    if source is not None:
        lines.append(f"Columns: {'; '.join(f'{what} = {column}' for what, column in source.columns.items())}.")
    of_actions = f", of {horizon} actions each" if horizon else ""
    lines.append(f"Policy calls: {sum(calls)}, every {every} frames ({every / info.fps:.3g} s){of_actions}.")
    bound = estimate_disk(attributes.recording, attributes.sites, picture_sizes, max(calls, default=0), len(calls))
    damaged = find_damaged(plan.store, set(stored), False) if stored else []
    announce(attributes, lines, bound, plan.store, len(plan.wanted), damaged)
    return todo


def record_episodes(plan: ReplayPlan, store: RunStore, todo: Sequence[int], every: int, source: Source) -> int:
    """Make the calls of the episodes; returns how many were added. The plan notes those that a fault left out.

    Raises:
        Terminated: SIGTERM was received; the episode in progress was dropped.
    """
    if not todo:
        return 0
    jobs = []
    with progress_bar(len(todo), "episodes") as advance:
        for index in todo:
            jobs.append(plan.job(index, every))
            advance(1)
    done = [(plan.task(task_id), index) for task_id, index in store.committed() if index in plan.wanted]
    planned = plan_of([*((job.task, job.episode_index) for job in jobs), *done])
    loop = EpisodeLoop(store, planned, plan.termination, "call", source)
    results = loop.record_all(jobs)
    plan.faults.dropped.update(loop.faults.dropped)
    return len(results)


def chosen_episodes(data: LeRobotDataset, settings: ReplaySettings) -> tuple[int, ...]:
    """Return the numbers of the wanted episodes, in their order.

    Raises:
        UnknownName: an episode does not exist.
        BadArgument: there are none.
    """
    chosen = data.episode_numbers if settings.episodes is None else settings.episodes
    numbers = tuple(data.entry(index).index for index in sorted(set(chosen)))
    if not numbers:
        raise BadArgument(f"The data set '{data.name}' has no episodes.")
    return numbers[: settings.num_episodes]


def num_calls(length: int, every: int) -> int:
    """Return the number of policy calls of an episode of so many frames."""
    return -(-length // every)


def joined(episode: DataSetEpisode, columns: tuple[str, ...]) -> NDArray[np.float64]:
    """Return columns of numbers side by side, (frame, number)."""
    return np.concatenate([episode.column(name) for name in columns], axis=1)


def success_of(episode: DataSetEpisode) -> bool | None:
    """Return whether the task was solved at some frame; None if the data set has no such column."""
    if SUCCESS_COLUMN not in episode.dataset.features:
        return None
    return bool(episode.column(SUCCESS_COLUMN).any())
