"""Align episodes: on episode time from 0 to 1, and around the first closing of the gripper.

Pure functions on one episode's arrays. Values are not interpolated: a replan's value holds until the next replan, as
its actions do.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vla_attention.schemas.stores.reader import StoredEpisode
from vla_attention.schemas.stores.store_format import RootAttributes, StoreError

#: Position of the gripper command in an action. Every suite of the capture side drives robosuite's Panda gripper: a
#: command above 0 closes it, one below 0 opens it, 0 leaves it as it is. While an episode waits, the command is -1.
GRIPPER = -1


def replan_starts(env_step: NDArray[np.int64], wait_steps: int, num_steps: int, name: str) -> NDArray[np.int64]:
    """Policy steps (replan,) executed before each replan, from the environment steps of the store.

    Raises:
        StoreError: they do not increase from 0, or the episode ended before its last replan.
    """
    starts = np.asarray(env_step, dtype=np.int64) - wait_steps
    if len(starts) == 0 or starts[0] != 0 or (np.diff(starts) <= 0).any() or starts[-1] >= num_steps:
        raise StoreError(
            f"The replans of {name} do not fit into its {num_steps} steps after {wait_steps} steps of waiting; check "
            "the store with vla-attention store verify."
        )
    return starts


def episode_timing(
    root: RootAttributes, episode: StoredEpisode, env_step: NDArray[np.int64]
) -> tuple[NDArray[np.int64], int]:
    """Policy steps (replan,) executed before each replan, and those of the whole episode.

    In a loop that is not ours (`Protocol.of_other_loop`) nothing is known of waiting steps, see `steps_of_time`.

    Raises:
        StoreError: see `replan_starts`.
    """
    num_steps, protocol = episode.attributes.num_steps, root.protocol
    if not protocol.of_other_loop:
        return replan_starts(env_step, protocol.wait_steps, num_steps, episode.name), num_steps
    return steps_of_time(env_step, num_steps, max(1, protocol.replan_steps))


def steps_of_time(env_step: NDArray[np.int64], num_steps: int, usual: int = 1) -> tuple[NDArray[np.int64], int]:
    """Steps (replan,) before each replan, with the first one as the beginning, and those of the whole episode.

    Where `num_steps` is not known (0) or not beyond the last replan, this one lasts as long as the median one, or
    `usual` where it is the only one.
    """
    starts = np.asarray(env_step, dtype=np.int64) - int(env_step[0])
    if num_steps > starts[-1]:
        return starts, num_steps
    return starts, int(starts[-1]) + (int(np.median(np.diff(starts))) if len(starts) > 1 else usual)
