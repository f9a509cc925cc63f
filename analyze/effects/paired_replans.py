"""A base's episode and its rerun, replan by replan: the changes of the actions, and their means over phases."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vla_attention.analyze.core.same_calls import check_same_calls
from vla_attention.analyze.effects.action_changes import (
    ActionSpread,
    first_angle,
    gripper_flips,
    root_mean_square_change,
)
from vla_attention.analyze.effects.conditions import Condition
from vla_attention.analyze.measures.alignment import episode_timing, on_episode_time
from vla_attention.analyze.measures.masses import finite_mean
from vla_attention.analyze.measures.selected import SelectedEpisode
from vla_attention.schemas.effects import CHANGE
from vla_attention.schemas.errors import BadArgument, listing
from vla_attention.schemas.stores.reader import Store, StoredEpisode

Array = NDArray[np.float64]

#: What is measured of a pair of replans: over the executed steps, over the whole chunk, the angle in degrees between
#: the first actions' translations, the share of executed steps whose gripper command has the other sign.
CHANGES = ("effect", "effect_chunk", "angle", "gripper_flips")
#: Parts of an episode's time, by name. `ALL` is the mean over replans.
PHASES = ("first third", "middle third", "last third")
ALL = "all"


@dataclass(frozen=True)
class BaseEpisode:
    """What is read of a base's episode once, for all reruns.

    Attributes:
        item: the episode.
        actions: (replan, step, dimension).
        env_step: (replan,).
        starts: (replan,) policy steps before each replan.
        executed: (replan,) how many steps of each chunk were executed; all of them where that is not known
            (`stores_executed`).
    """

    item: SelectedEpisode
    actions: Array
    env_step: NDArray[np.int64]
    starts: NDArray[np.int64]
    executed: NDArray[np.int64]

    @property
    def name(self) -> str:
        """The name of the episode's group."""
        return self.item.episode.name

    @classmethod
    def of(cls, item: SelectedEpisode) -> BaseEpisode:
        """Read an episode's actions."""
        if not item.episode.has("actions"):
            raise BadArgument(
                f"{item.episode.name} of {item.store.path} holds no actions, and an effect is a change of the actions; "
                "record the run with its actions."
            )
        actions = item.episode.read("actions").astype(np.float64)
        env_step = item.episode.read("env_step").astype(np.int64)
        starts, num_steps = episode_timing(item.store.attributes, item.episode, env_step)
        executed = np.full(len(starts), actions.shape[1])
        if stores_executed(item.store):
            known = item.store.attributes.protocol.replan_steps
            until_next = np.diff(np.append(starts, num_steps))
            executed = np.minimum(executed, np.minimum(until_next, known))
        return cls(item, actions, env_step, starts, executed)

    def over_phases(self, values: Array) -> dict[str, Array]:
        """Means of values (replan, quantity) over the replans (`ALL`) and over the thirds of the episode's time."""
        num_steps = episode_timing(self.item.store.attributes, self.item.episode, self.env_step)[1]
        timed = on_episode_time(values, self.starts, num_steps, len(PHASES))
        return {ALL: finite_mean(values), **dict(zip(PHASES, timed, strict=True))}


def stores_executed(store: Store) -> bool:
    """Whether a store says how many steps of each chunk were executed.

    Of the caller's own loop that is not known where it gave no number, and a replayed data set executes none: there
    `replan_steps` is the number of frames from one policy call to the next.
    """
    protocol = store.attributes.protocol
    return protocol.name != "dataset" and protocol.replan_steps > 0


@dataclass(frozen=True)
class Pairing:
    """The episodes of a condition: pairs of a base's and its own, and the names of those without a partner."""

    condition: Condition
    pairs: tuple[tuple[BaseEpisode, StoredEpisode], ...]
    missing: tuple[str, ...]
    unknown: tuple[str, ...]

    @property
    def gap(self) -> str:
        """Which episodes have no partner, as the rest of a sentence; empty when all have one."""
        parts = []
        if self.missing:
            parts.append(f"lacks {listing(self.missing, 6)} of the base, which are in none of its numbers")
        if self.unknown:
            parts.append(f"has {listing(self.unknown, 6)}, which the base lacks")
        return " and ".join(parts)


def pair_episodes(condition: Condition, base: Sequence[BaseEpisode], all_names: Sequence[str]) -> Pairing:
    """Pair a rerun's episodes with the selected ones of its base, by name; there may be no pair.

    `all_names`: the base's episodes, selected or not.

    Raises:
        BadArgument: the rerun holds none of the base's episodes, selected or not.
    """
    if condition.recorded:
        having = [one for one in base if _was_measured(one.item.episode, condition)]
        return Pairing(condition, tuple((one, one.item.episode) for one in having), (), ())
    reruns = {episode.name: episode for episode in condition.store.episodes}
    pairs = tuple((one, reruns[one.name]) for one in base if one.name in reruns)
    if not any(name in reruns for name in all_names):
        raise BadArgument(
            f"The rerun {condition.store.path} holds none of the {len(all_names)} episodes of its base "
            f"({listing(all_names, 3)}); it holds {listing(reruns, 3)}: let vla-attention capture rerun finish."
        )
    missing = tuple(one.name for one in base if one.name not in reruns)
    return Pairing(condition, pairs, missing, tuple(name for name in reruns if name not in all_names))


def _was_measured(episode: StoredEpisode, condition: Condition) -> bool:
    effects = episode.attributes.effects
    return effects is not None and condition.interventions in effects.conditions


def actions_of(base: BaseEpisode, rerun: StoredEpisode, condition: Condition, changes: Array | None = None) -> Array:
    """Actions (replan, step, dimension) of an episode of a condition; NaN where a recorded one was not measured.

    changes: of all recorded conditions, if they have been read (`changes_recorded`).

    Raises:
        StoreError: the rerun is of other policy calls than the base, see `same_calls.check_same_calls`.
    """
    if condition.recorded:
        return _recorded_actions(base, condition, changes_recorded(base) if changes is None else changes)
    check_same_calls(base.item.store, base.item.episode, condition.store, rerun)
    actions: Array = rerun.read("actions").astype(np.float64)
    return actions


def changes_recorded(base: BaseEpisode) -> Array:
    """The changes that were measured beside an episode's calls, (entry, step, dimension), in normalised units."""
    episode = base.item.episode
    values: Array = episode.read(CHANGE) if episode.has(CHANGE) else np.zeros((0, *base.actions.shape[1:]))
    return values


def _recorded_actions(base: BaseEpisode, condition: Condition, changes: Array) -> Array:
    """What the base's calls give under a condition whose effect was measured beside them."""
    actions = np.full_like(base.actions, np.nan)
    effects = base.item.episode.attributes.effects
    if effects is None or condition.interventions not in effects.conditions:
        return actions
    number = effects.conditions.index(condition.interventions)
    entries = np.flatnonzero(np.array(effects.condition) == number)
    if entries.size:
        replans = np.array(effects.replan)[entries]
        change = changes[entries].astype(np.float64) * np.array(effects.units)
        actions[replans] = base.actions[replans] + change
    return actions


def changes_of(base: BaseEpisode, actions: Array, spread: ActionSpread) -> Array:
    """`CHANGES` of every replan of an episode, (replan, change), from the actions of its rerun (`actions_of`)."""
    whole = np.full(len(actions), actions.shape[1])
    # Which numbers move the hand and the gripper is known of our suites only.
    angle = flips = np.full(len(actions), np.nan)
    if not base.item.store.attributes.protocol.of_other_loop:
        angle = first_angle(base.actions, actions)
        flips = gripper_flips(base.actions, actions, base.executed)
    return np.stack(
        (
            root_mean_square_change(base.actions, actions, spread, base.executed),
            root_mean_square_change(base.actions, actions, spread, whole),
            angle,
            flips,
        ),
        axis=1,
    )


def mean_over_phases(base: BaseEpisode, values: Mapping[str, Array]) -> list[dict[str, object]]:
    """One row per phase with the mean of every value (replan,); None where there is none."""
    names = list(values)
    phases = base.over_phases(np.stack([values[name] for name in names], axis=1))
    return [
        {
            "phase": phase,
            **{name: float(x) if np.isfinite(x) else None for name, x in zip(names, row, strict=True)},
        }
        for phase, row in phases.items()
    ]
