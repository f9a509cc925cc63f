"""Align episodes: on episode time from 0 to 1, and around the first closing of the gripper.

Pure functions on one episode's arrays. Values are not interpolated: a replan's value holds until the next replan, as
its actions do.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vla_attention.analyze.measures.masses import finite_mean
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


def on_episode_time(
    values: NDArray[np.float64], starts: NDArray[np.int64], num_steps: int, num_bins: int
) -> NDArray[np.float64]:
    """Means (bin, quantity) over equal parts of an episode's time, of values (replan, quantity).

    The value at policy step s is that of the last replan at or before s. A bin's value is the mean of this step
    function over the bin, that is the replans' mean with the shares of the bin that they last as weights. Values that
    are not finite take no part; a bin with nothing else is NaN.

    Args:
        values: (replan, quantity).
        starts: (replan,) policy steps before each replan, see `replan_starts`.
        num_steps: policy steps of the episode.
        num_bins: parts of equal length.
    """
    ends = np.append(starts[1:], num_steps)
    edges = np.linspace(0.0, 1.0, num_bins + 1)
    from_ = np.maximum(edges[:-1, None], starts[None, :] / num_steps)
    to = np.minimum(edges[1:, None], ends[None, :] / num_steps)
    # Rounding can make neighbours overlap by a tiny amount.
    share = np.where(to - from_ > 1e-12, to - from_, 0.0)
    finite = np.isfinite(values)
    weight = share @ finite.astype(np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(weight > 0, (share @ np.where(finite, values, 0.0)) / weight, np.nan)


def closing_replan(actions: NDArray[np.float64], starts: NDArray[np.int64], num_steps: int) -> int | None:
    """The first replan one of whose executed actions closes the gripper; None when none does.

    A replan's chunk is longer than what is executed of it: its first actions, up to the next replan or the end of the
    episode. With an open gripper to begin with, this is the first closing command of the episode.

    Args:
        actions: (replan, horizon, action dimension), as given to the environment.
        starts: (replan,) policy steps before each replan.
        num_steps: policy steps of the episode.
    """
    executed = np.diff(np.append(starts, num_steps))
    for replan, count in enumerate(executed):
        if (actions[replan, :count, GRIPPER] > 0).any():
            return replan
    return None


def around_event(values: NDArray[np.float64], event: int, window: int) -> NDArray[np.float64]:
    """Values (offset, quantity) of the replans from `window` before to `window` after one; NaN outside the episode.

    Offset 0 is the event's own replan. values: (replan, quantity).
    """
    result = np.full((2 * window + 1, values.shape[1]), np.nan)
    first, last = max(0, event - window), min(len(values), event + window + 1)
    result[first - event + window : last - event + window] = values[first:last]
    return result


def change_at_event(around: NDArray[np.float64], window: int) -> NDArray[np.float64]:
    """Mean of the finite values (offset, quantity) from offset 0 on minus the mean before: (quantity,).

    NaN where a side has no finite value.
    """
    return finite_mean(around[window:]) - finite_mean(around[:window])


def change_and_placebo(
    values: NDArray[np.float64], starts: NDArray[np.int64], event: int, window: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """`change_at_event`, and what it would be if the values drifted all along as they do at other times: (quantity,).

    Every other replan is a placebo event. Its change is divided by the time between the middles of its two sides: near
    the episode's ends sides are shorter, and a steady drift changes less between them. The mean of these, times that of
    the event, is what a steady drift gives at the event, too.

    Args:
        values: (replan, quantity); those that are not finite take no part.
        starts: (replan,) policy steps before each replan, see `replan_starts`.
        event: the replan of the event.
        window: replans on either side.

    Returns:
        NaN where a side of the event has no finite value; the placebo's also where no other replan has both sides.
    """
    times = np.where(np.isfinite(values), starts[:, None].astype(np.float64), np.nan)

    def at(replan: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        of_values, of_times = (change_at_event(around_event(of, replan, window), window) for of in (values, times))
        return of_values, of_times

    change, apart = at(event)
    others = [of_values / of_times for of_values, of_times in map(at, range(len(values)))]
    return change, apart * finite_mean(np.delete(np.array(others), event, axis=0))
