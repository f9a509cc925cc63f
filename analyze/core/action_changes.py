"""How far other actions are from those of a run: its own episodes changed, or made again. Pure functions on arrays.

Dimensions of an action have different units (metres, radians, a gripper command). A change is therefore measured in
units of the run's own spread: 1 is a change as large as the actions of the run differ from each other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from msgspec import structs
from numpy.typing import NDArray

from vla_attention.analyze.measures.selected import SelectedEpisode
from vla_attention.analyze.statistics.intervals import estimates, ratio_of_means_over_episodes
from vla_attention.analyze.statistics.units import Units
from vla_attention.schemas.effects import CHANGE
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.interventions import Interventions
from vla_attention.schemas.stores.reader import Store, StoredEpisode
from vla_attention.schemas.stores.store_format import CorruptEpisode

Array = NDArray[np.float64]

#: What is measured of a pair of replans: over the executed steps, over the whole chunk, the angle in degrees between
#: the first actions' translations, the share of executed steps whose gripper command has the other sign.
CHANGES = ("effect", "effect_chunk", "angle", "gripper_flips")
#: Position of the gripper command in an action. Every suite of the capture side drives robosuite's Panda gripper: a
#: command above 0 closes it, one below 0 opens it, 0 leaves it as it is. While an episode waits, the command is -1.
GRIPPER = -1
#: The dimensions of an action that move the hand. Every suite of the capture side drives robosuite's Panda arm.
TRANSLATION = slice(0, 3)
#: A dimension with less spread than this part of the largest one is not driven by the policy. Division by its spread
#: would make what is left of it, rounding or noise of the denoising, as large as a real movement.
LEAST_SPREAD = 0.01
#: A dimension that another noise seed changes by more than this many spreads is more than half noise: two draws of
#: noise of variance v differ by 2 v on average.
MOST_NOISE = 1.0


@dataclass(frozen=True)
class Noise:
    """Root mean square change by another noise seed over all replans and steps, in spreads.

    change: (dimension,); NaN where there is no spread. low, high: ends (dimension,) of its interval over the episodes,
    NaN where there is none (a single episode).
    """

    change: Array
    low: Array
    high: Array


@dataclass(frozen=True)
class ActionSpread:
    """The units of changes.

    Attributes:
        spread: (dimension,) standard deviation over all replans and all steps of their chunks.
        used: (dimension,) bool, the dimensions that are compared.
        noise: change by another noise seed; None where it is not known.
        reasons: (dimension,) why a dimension is not compared; empty for those that are.
    """

    spread: Array
    used: NDArray[np.bool_]
    noise: Noise | None = None
    reasons: tuple[str, ...] = ()

    @property
    def left_out(self) -> tuple[int, ...]:
        """The dimensions that are not compared."""
        return tuple(int(i) for i in np.flatnonzero(~self.used))


def action_spread(actions: Sequence[Array]) -> ActionSpread:
    """The spread of a run's actions, each (replan, step, dimension); steps may differ in number.

    A dimension without spread (see `LEAST_SPREAD`) is not compared.
    """
    flat = np.concatenate([chunk.reshape(-1, chunk.shape[-1]) for chunk in actions])
    spread = flat.std(axis=0)
    moves = spread > LEAST_SPREAD * spread.max(initial=0.0)
    return ActionSpread(spread, moves, reasons=tuple("" if move else "no spread" for move in moves))


def with_noise(spread: ActionSpread, noise: Noise) -> ActionSpread:
    """The same with the change by another noise seed; dimensions that are mostly noise are not compared.

    Such a dimension would make every effect as large as its noise. It is left out where the whole interval lies above
    `MOST_NOISE`, so that no chance of the episodes decides; where all of them would be, all are kept.
    """
    mostly = spread.used & (noise.low > MOST_NOISE)
    if mostly[spread.used].all():
        return replace(spread, noise=noise)
    reasons = ["mostly noise" if drop else reason for drop, reason in zip(mostly, spread.reasons, strict=True)]
    return replace(spread, used=spread.used & ~mostly, noise=noise, reasons=tuple(reasons))


def noise_of(pairs: Sequence[tuple[Array, Array]], spread: Array) -> Noise:
    """The change by another noise seed, with its interval over episodes.

    pairs: per episode the actions (replan, step, dimension) of the run, and those with other noise.
    """
    squares = np.array([((other - base) ** 2).sum(axis=(0, 1)) for base, other in pairs]).T  # (dimension, episode)
    number = np.array([base.shape[0] * base.shape[1] for base, _ in pairs], dtype=np.float64)
    statistic = ratio_of_means_over_episodes(squares, np.broadcast_to(number, squares.shape))
    # The episodes are those of which the units are, whatever their tasks.
    spreads = estimates([statistic], Units.of(np.zeros(len(pairs))))
    # Several episodes that do not differ agree on the value; a single one says nothing of others.
    values = np.array(
        [(one.value, *(one.interval() or [one.value if len(pairs) > 1 else np.nan] * 2)) for one in spreads], np.float64
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        return Noise(*np.where(spread > 0, np.sqrt(values.T) / spread, np.nan))


def units_of_recorded(*stores: Store, skip_corrupt: bool = False) -> ActionSpread:
    """The units of the effects that stores recorded: over all of their episodes, whichever are selected.

    skip_corrupt: damaged episodes are left out.

    Raises:
        BadArgument: an episode holds no actions, or they are the same everywhere.
        CorruptEpisode: an episode is damaged.
    """
    actions, pairs = [], []
    for store in stores:
        for episode in store.episodes:
            try:
                if episode.attributes.num_replans:
                    actions.append(actions_of(store, episode))
                    pairs += _noise_pairs(episode, actions[-1])
            except CorruptEpisode:
                if not skip_corrupt:
                    raise
    spread = action_spread(actions)
    if not spread.used.any():
        raise BadArgument(
            f"In {stores[0].path} the actions are the same in every replan and step, so a change has no unit; ask a "
            "store of a robot that moves."
        )
    return with_noise(spread, noise_of(pairs, spread.spread)) if pairs else spread


def _noise_pairs(episode: StoredEpisode, actions: Array) -> list[tuple[Array, Array]]:
    """The actions of the replans that were made again with other noise alone, and these."""
    effects = episode.attributes.effects
    if effects is None or not episode.has(CHANGE):
        return []
    numbers = [i for i, one in enumerate(effects.items) if one.change == "noise"]
    entries = np.flatnonzero(np.isin(effects.condition, numbers))
    if not entries.size:
        return []
    base = actions[np.array(effects.replan)[entries]]
    return [(base, base + episode.read(CHANGE)[entries].astype(np.float64) * np.array(effects.units))]


def changes_noise_alone(interventions: Interventions) -> bool:
    """Whether another noise seed is all that was changed."""
    return interventions.noise is not None and structs.replace(interventions, name="", noise=None).is_none


def actions_of(store: Store, episode: StoredEpisode) -> Array:
    """The actions of an episode, (replan, step, dimension).

    Raises:
        BadArgument: it holds none.
    """
    if not episode.has("actions"):
        raise BadArgument(
            f"{episode.name} of {store.path} holds no actions, and an effect is a change of the actions; record the "
            "run with its actions."
        )
    return np.asarray(episode.read("actions"), np.float64)


@dataclass(frozen=True)
class BaseEpisode:
    """The actions of an episode that others are compared with.

    Attributes:
        item: the episode.
        actions: (replan, step, dimension).
        env_step: (replan,).
        starts: (replan,) policy steps before each replan.
        executed: (replan,) how many steps of each chunk were executed; all of them where that is not known.
        num_steps: policy steps of the episode.
    """

    item: SelectedEpisode
    actions: Array
    env_step: NDArray[np.int64]
    starts: NDArray[np.int64]
    executed: NDArray[np.int64]
    num_steps: int

    @classmethod
    def of(cls, item: SelectedEpisode) -> BaseEpisode:
        """Read an episode's actions."""
        actions = actions_of(item.store, item.episode)
        env_step = item.episode.read("env_step").astype(np.int64)
        starts, num_steps = item.timing(env_step)
        executed = np.full(len(starts), actions.shape[1])
        protocol = item.store.attributes.protocol
        # Of the caller's own loop it is not known where it gave no number, and a replayed data set executes none: there
        # `replan_steps` is the number of frames from one policy call to the next.
        if protocol.name != "dataset" and protocol.replan_steps > 0:
            until_next = np.diff(np.append(starts, num_steps))
            executed = np.minimum(executed, np.minimum(until_next, protocol.replan_steps))
        return cls(item, actions, env_step, starts, executed, num_steps)

    def at(self, replans: NDArray[np.int64]) -> BaseEpisode:
        """The same at some replans, which may repeat."""
        parts = {name: getattr(self, name)[replans] for name in ("actions", "env_step", "starts", "executed")}
        return replace(self, **parts)


def changes_of(base: BaseEpisode, actions: Array, spread: ActionSpread) -> Array:
    """`CHANGES` of every replan, (replan, change), from other actions (replan, step, dimension) of the same replans."""
    whole = np.full(len(actions), actions.shape[1])
    # Which numbers move the hand and the gripper is known of our suites only.
    angle = flips = np.full(len(actions), np.nan)
    if not base.item.store.attributes.protocol.of_other_loop:
        angle = first_angle(base.actions, actions)
        flips = gripper_flips(base.actions, actions, base.executed)
    sizes = (root_mean_square_change(base.actions, actions, spread, steps) for steps in (base.executed, whole))
    return np.stack((*sizes, angle, flips), axis=1)


def root_mean_square_change(base: Array, other: Array, spread: ActionSpread, steps: NDArray[np.int64]) -> Array:
    """Root mean square over the first steps of each chunk, and over dimensions, of the change in units of the spread.

    Args:
        base, other: actions (replan, step, dimension).
        spread: the units.
        steps: (replan,) how many steps of each chunk count, at least 1.

    Returns:
        (replan,).
    """
    change = (other - base)[..., spread.used] / spread.spread[spread.used]
    squares = (change**2).mean(axis=2)
    result: Array = np.sqrt((squares * counted(steps, squares.shape[1])).sum(axis=1) / steps)
    return result


def first_angle(base: Array, other: Array) -> Array:
    """Angle in degrees (replan,) between the translations of the first actions; NaN where one of them is zero."""
    with np.errstate(divide="ignore", invalid="ignore"):
        first, second = (
            part / np.linalg.norm(part, axis=1, keepdims=True)
            for part in (base[:, 0, TRANSLATION], other[:, 0, TRANSLATION])
        )
    # Kahan's formula: exact for small angles, where the arc cosine loses half of the digits.
    angle: Array = np.degrees(
        2 * np.arctan2(np.linalg.norm(first - second, axis=1), np.linalg.norm(first + second, axis=1))
    )
    return angle


def gripper_flips(base: Array, other: Array, steps: NDArray[np.int64]) -> Array:
    """Share (replan,) of the first `steps` steps in which the gripper command has the other sign."""
    flipped = base[..., GRIPPER] * other[..., GRIPPER] < 0
    share: Array = (flipped * counted(steps, flipped.shape[1])).sum(axis=1) / steps
    return share


def counted(steps: NDArray[np.int64], horizon: int) -> NDArray[np.bool_]:
    """Which steps count, (replan, horizon) bool: the first `steps` (replan,) of each chunk."""
    return np.arange(horizon)[None, :] < steps[:, None]
