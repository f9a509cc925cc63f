"""Stored policy calls made again under many interventions, without writing stores: actions only.

The calls are those of `capture rerun`; a test compares them. Policies of different scales stand side by side here,
so effects are in standard deviations of each run's own actions, which `vla-attention effects` takes last.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vla_attention.analyze.core.action_changes import ActionSpread, action_spread, in_spread
from vla_attention.analyze.statistics.intervals import estimates, ratio_of_means_over_episodes
from vla_attention.analyze.statistics.units import Units
from vla_attention.capture.interventions.changed_inputs import changed_inputs
from vla_attention.capture.interventions.factors import QueryWithoutKeys
from vla_attention.capture.interventions.resolution import TooFewKeys, interventions_for
from vla_attention.capture.interventions.run_changes import RunChanges
from vla_attention.capture.rerun.base_store import instructions_of
from vla_attention.capture.rerun.stored_calls import StoredCalls, read_calls
from vla_attention.schemas.groupings.resolve import EmptyGroup
from vla_attention.schemas.interventions import Interventions, NoiseChange
from vla_attention.schemas.stores.reader import Store, StoredEpisode

Array = NDArray[np.float64]
#: Name of a change -> what it is; different episodes may have different changes of one name (their own object, word).
Changes = Mapping[str, Interventions]
#: The stored call, unchanged: its effect is how far the rerun is from the store.
NOTHING = "nothing"
#: Another noise seed: the run's with this in place of its base.
NOISE = Interventions(noise=NoiseChange(1000))
#: A dimension that another noise seed changes by more than this many spreads is more than half noise: two draws of
#: noise of variance v differ by 2 v on average.
MOST_NOISE = 1.0
#: More replans than any episode has.
_ALL_REPLANS = 10**9


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
class ChangedEpisode:
    """The actions of some replans of an episode under changes.

    replans: (replan,) which. base: (replan, step, dimension), as stored. actions: name -> the same shape; NaN where a
    group has no key. executed: (replan,) how many steps of each chunk were executed.
    """

    name: str
    task_id: int
    episode_index: int
    replans: NDArray[np.int64]
    base: Array
    actions: Mapping[str, Array]
    executed: NDArray[np.int64]

    def effect(self, name: str, spread: ActionSpread, against: str | None = None) -> Array:
        """Effects (replan,) in spreads of the run; against: another change instead of the store."""
        base = self.base if against is None else self.actions[against]
        return in_spread(spread).parts[0].of(base, self.actions[name], self.executed)


def spread_of(store: Store) -> ActionSpread:
    """The spread of all actions of the store, without regard to noise."""
    return action_spread([episode.read("actions").astype(np.float64) for episode in store.episodes])


def units_of(policy: Any, store: Store, folder: Path, say: Callable[[str], None]) -> ActionSpread:
    """The units of effects: the spread of the run, of dimensions that are no noise.

    All policy calls of the store are made again with that seed, and dimensions of the action that it changes by more
    than their spread are left out: they would drown every effect.
    """
    spread = spread_of(store)
    again = changed_episodes(policy, store, lambda episode: {"noise": NOISE}, _ALL_REPLANS, folder, say)
    pairs = [(episode.base, episode.actions["noise"]) for episode in again]
    return with_noise(spread, noise_of(pairs, spread.spread))


def with_noise(spread: ActionSpread, noise: Noise) -> ActionSpread:
    """The spread without the dimensions that another noise seed changes by more than they vary.

    Such a dimension would make every effect as large as its noise. It is left out where the whole interval lies above
    `MOST_NOISE`, so that no chance of the episodes decides; where all of them would be, all are kept.
    """
    mostly = spread.used & (noise.low > MOST_NOISE)
    if mostly[spread.used].all():
        return spread
    return replace(spread, used=spread.used & ~mostly)


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


def chosen_replans(number: int, count: int) -> NDArray[np.int64]:
    """`count` replans of an episode with `number` of them, evenly spaced."""
    count = min(count, number)
    return ((np.arange(count) + 0.5) / count * number).astype(np.int64)


def changed_episodes(
    policy: Any,
    store: Store,
    changes_of: Callable[[StoredEpisode], Changes],
    replans: int,
    folder: Path,
    say: Callable[[str], None],
) -> list[ChangedEpisode]:
    """Make calls of every episode again under changes. Episodes whose result is in `folder` are read from there."""
    folder.mkdir(parents=True, exist_ok=True)
    instructions = instructions_of(store)
    found, begun = [], time.monotonic()
    for number, episode in enumerate(store.episodes, start=1):
        changes = changes_of(episode)
        chosen = chosen_replans(episode.attributes.num_replans, replans)
        digest = _digest(store, changes, chosen)
        path = folder / f"{episode.name}.npz"
        actions = _read(path, digest)
        if actions is None:
            calls = read_calls(episode)
            actions = _make(policy, calls, chosen, changes, instructions)
            _write(path, digest, actions)
            say(f"{folder}: {number} of {len(store.episodes)} episodes, {time.monotonic() - begun:.0f} s")
        attributes = episode.attributes
        starts = episode.read("env_step").astype(np.int64) - store.attributes.protocol.wait_steps
        base = episode.read("actions").astype(np.float64)
        executed = np.minimum(np.diff(np.append(starts, attributes.num_steps)), base.shape[1])
        found.append(
            ChangedEpisode(
                episode.name,
                attributes.task_id,
                attributes.episode_index,
                chosen,
                base[chosen],
                dict(zip(changes, actions, strict=True)),
                executed[chosen],
            )
        )
    return found


def changed_call(
    policy: Any, calls: StoredCalls, replan: int, change: Interventions, instructions: Mapping[int, str]
) -> Array:
    """The actions (step, dimension) of one stored policy call under a change; NaN where its group has no key."""
    given, context = calls.given(replan), calls.context(replan, instructions)
    if change.changes_input:
        given = changed_inputs(given, change, policy.sites, context)
    policy_input = policy.prepare_again(given)
    seed = int(calls.noise_seed[replan])
    if change.noise is not None:
        seed = policy.replan_noise_seed(change.noise.seed, context.task_id, context.episode_index, replan)
    try:
        editors = RunChanges(change, instructions).editors(policy.sites, policy_input, context)
        actions: Array = policy.act(policy_input, seed, None, editors)
    except (EmptyGroup, TooFewKeys, QueryWithoutKeys):
        return np.full(calls.actions.shape[1:], np.nan)
    return actions


def _make(
    policy: Any, calls: StoredCalls, chosen: NDArray[np.int64], changes: Changes, instructions: Mapping[int, str]
) -> Array:
    """Actions (change, replan, step, dimension)."""
    placed = [interventions_for(change, policy) for change in changes.values()]
    return np.stack(
        [
            np.stack([changed_call(policy, calls, int(replan), change, instructions) for replan in chosen])
            for change in placed
        ]
    )


def _digest(store: Store, changes: Changes, chosen: Sequence[int] | NDArray[np.int64]) -> str:
    described = [[name, change.describe()] for name, change in changes.items()]
    text = json.dumps([store.run, described, [int(replan) for replan in chosen]])
    return hashlib.sha256(text.encode()).hexdigest()


def _read(path: Path, digest: str) -> Array | None:
    if not path.exists():
        return None
    with np.load(path) as arrays:
        return np.asarray(arrays["actions"]) if str(arrays["digest"]) == digest else None


def _write(path: Path, digest: str, actions: Array) -> None:
    partial = path.with_name(f".{path.name}")
    with partial.open("wb") as file:
        np.savez(file, digest=np.array(digest), actions=actions)
    partial.replace(path)
