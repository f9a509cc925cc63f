"""Policy calls on the frames of one episode of a data set, committed to a store like any other."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vla_attention.capture.replay.lerobot_dataset import DataSetEpisode, DataSetFrame
from vla_attention.capture.replay.robot_policy import RobotPolicy
from vla_attention.capture.rollout.policy_call import record_call, replan_record
from vla_attention.capture.store.episode_writer import EpisodeStart, EpisodeWriter
from vla_attention.capture.store.store_writer import RunStore

#: The column that says of every frame whether the task is solved, where a data set has it.
SUCCESS_COLUMN = "next.success"

#: Called before every policy call with the number of calls done; an exception that it raises drops the episode.
BeforeCall = Callable[[int], None]
#: Makes the policy calls of an episode and commits them.
EpisodeReplay = Callable[[DataSetEpisode, BeforeCall], object]


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


def task_of(episode: DataSetEpisode) -> int:
    """Return the task under which an episode is stored: that of its first frame."""
    return int(episode.task_indices[0])


def num_calls(length: int, every: int) -> int:
    """Return the number of policy calls of an episode of so many frames."""
    return -(-length // every)


def replay_episode(replay: Replay, episode: DataSetEpisode, before_call: BeforeCall) -> Path:
    """Make the policy calls of one episode, and commit them; returns its folder in the store.

    The step of a replan is the number of its frame. The recorded actions of a replan are those from its frame on, as
    many as the policy gives, fewer at the end of the episode. Whether the task was solved is not known unless the data
    set has a column `next.success`.
    """
    policy, recording = replay.policy, replay.store.attributes.recording
    instruction = replay.instruction if replay.instruction is not None else episode.instructions[0]
    state = joined(episode, policy.robot.state)
    actions = joined(episode, policy.robot.actions) if policy.robot.actions else None
    start = EpisodeStart(
        task_id=task_of(episode),
        task_name=task_name(instruction, task_of(episode)),
        instruction=instruction,
        episode_index=episode.index,
        initial_state_index=episode.index,
        initial_state_digest=hashlib.sha256(np.ascontiguousarray(state[0]).tobytes()).hexdigest(),
        objects=(),
        provenance=dict(replay.machine),
    )
    denoise_times = policy.denoise_times()[list(recording.denoise_steps)]
    with replay.store.episode(start, np.asarray(denoise_times), num_calls(episode.length, replay.every)) as writer:
        cameras = tuple(policy.robot.cameras.values())
        for frame in episode.frames(replay.every, cameras):
            before_call(len(writer.records))
            _append_call(replay, writer, frame, task_of(episode), state[frame.index], actions)
        return writer.commit(success_of(episode), episode.length)


def _append_call(
    replay: Replay,
    writer: EpisodeWriter,
    frame: DataSetFrame,
    task_id: int,
    state: NDArray[np.float64],
    actions: NDArray[np.float64] | None,
) -> None:
    policy, recording = replay.policy, replay.store.attributes.recording
    instruction = frame.instruction if replay.instruction is None else replay.instruction
    policy_input = policy.prepare_robot(frame.images, state, instruction)
    seed = policy.replan_noise_seed(replay.seed, task_id, frame.episode, len(writer.records))
    where = f"replan {len(writer.records)} (frame {frame.index}) of {writer.what}"
    call = record_call(policy, policy_input, seed, recording, where)
    writer.append(
        replan_record(
            policy_input,
            call,
            recording,
            env_step=frame.index,
            noise_seed=seed,
            dataset_actions=None if actions is None else actions[frame.index : frame.index + policy.action_horizon],
        )
    )


def joined(episode: DataSetEpisode, columns: tuple[str, ...]) -> NDArray[np.float64]:
    """Return columns of numbers side by side, (frame, number)."""
    return np.concatenate([episode.column(name) for name in columns], axis=1)


def success_of(episode: DataSetEpisode) -> bool | None:
    """Return whether the task was solved at some frame; None if the data set has no such column."""
    if SUCCESS_COLUMN not in episode.dataset.features:
        return None
    return bool(episode.column(SUCCESS_COLUMN).any())


def task_name(instruction: str, task_id: int) -> str:
    """Return a name that can be a part of a path: the words of the instruction."""
    return re.sub(r"\W+", "_", instruction.strip()).strip("_")[:60] or f"task_{task_id}"
