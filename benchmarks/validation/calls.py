"""Stored policy calls made again under many interventions, without writing stores: actions only.

The calls and the units of effects are those of `vla-capture rerun` and `vla-attention effects`; a test compares them.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vla_attention.analyze.core.action_changes import (
    ActionSpread,
    action_spread,
    noise_of,
    root_mean_square_change,
    with_noise,
)
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
#: More replans than any episode has.
_ALL_REPLANS = 10**9


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
        """Effects (replan,) as `vla-attention effects` measures them; against: another change instead of the store."""
        base = self.base if against is None else self.actions[against]
        return root_mean_square_change(base, self.actions[name], spread, self.executed)


def spread_of(store: Store) -> ActionSpread:
    """The spread of all actions of the store, without regard to noise."""
    return action_spread([episode.read("actions").astype(np.float64) for episode in store.episodes])


def units_of(policy: Any, store: Store, folder: Path, say: Callable[[str], None]) -> ActionSpread:
    """The units of effects, those of `vla-attention effects` with a rerun under another noise seed.

    All policy calls of the store are made again with that seed, and dimensions of the action that it changes by more
    than their spread are left out: they would drown every effect.
    """
    spread = spread_of(store)
    again = changed_episodes(policy, store, lambda episode: {"noise": NOISE}, _ALL_REPLANS, folder, say)
    pairs = [(episode.base, episode.actions["noise"]) for episode in again]
    return with_noise(spread, noise_of(pairs, spread.spread))


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
