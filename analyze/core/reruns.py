"""Reruns beside their base: whether they are of the same policy calls, and how far the actions moved.

A base that was recorded again with the same settings has the digest of the one that was rerun. So the digest of the run
is not enough: everything that both stores hold of a call is compared before two replans are a pair.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.core.action_changes import (
    EFFECT,
    ActionUnits,
    BaseEpisode,
    actions_of,
    changes_noise_alone,
    units_of,
)
from vla_attention.analyze.core.estimate import estimate
from vla_attention.analyze.core.runs import Run
from vla_attention.analyze.measures.tables import EPISODE_ID
from vla_attention.analyze.statistics.units import Sampling
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.safe_text import visible
from vla_attention.schemas.stores.reader import Store, StoredEpisode
from vla_attention.schemas.stores.store_format import StoreError

#: (replan,) in which replans something differs.
_Differs = NDArray[np.bool_]
_PICTURES = ("frames", "camera_frames")


def _changed(base: Store, rerun: Store) -> set[str]:
    """The inputs that the rerun changes beyond its base, by name: these may differ, and nothing else.

    What the base's own run had changed is in what its calls were given; a rerun of it has the same.
    """
    mine, theirs = base.attributes.interventions, rerun.attributes.interventions
    names = {f"{group}/{change.camera}" for change in theirs.images if change not in mine.images for group in _PICTURES}
    if theirs.prompt != mine.prompt:
        names.add("prompt")
    return names | {"noise_seed"} if theirs.noise != mine.noise else names


def check_same_calls(base: Store, episode: StoredEpisode, rerun: Store, own: StoredEpisode) -> None:
    """Raise `StoreError` unless an episode of a rerun is of the policy calls of its base's episode.

    Compared are number and place of the replans, task, instruction, noise seed, prompt, state and pictures, as far as
    both stores hold them (`held_by_one` says what is not), and the base's actions with those that the rerun says that
    its base had. Pictures are compared by the sha256 of their values in the attributes, which the seal binds.

    Args:
        base, episode: the base and its episode.
        rerun, own: the rerun and its episode.
    """
    mine, theirs, where = episode.attributes, own.attributes, f"{episode.name} of {rerun.path}"
    shapes = [part.arrays["actions"].shape if "actions" in part.arrays else () for part in (mine, theirs)]
    if mine.num_replans != theirs.num_replans or shapes[0] != shapes[1]:
        raise StoreError(
            f"{where} has {theirs.num_replans} policy calls and actions of the shape {shapes[1]}, and in its base "
            f"{mine.num_replans} and {shapes[0]}: these are not the same policy calls; make the rerun again."
        )
    if (mine.task_name, mine.instruction) != (theirs.task_name, theirs.instruction):
        raise StoreError(
            f"{where} is of the task '{theirs.task_name}' ('{visible(theirs.instruction)}'), and in its base "
            f"{base.path} of '{mine.task_name}' ('{visible(mine.instruction)}'): these are not the same episodes; make "
            "the rerun again."
        )
    differing = dict(_differing_inputs(episode, own, _changed(base, rerun)))
    if differing:
        replan = min(int(np.argmax(differs)) for differs in differing.values())
        what = [name for name, differs in differing.items() if differs[replan]]
        raise StoreError(
            f"Policy call {replan} of {where} was given {' and '.join(what)} than in its base {base.path}, which the "
            "condition does not change: the base was recorded again since, or the rerun is of another one; make the "
            "rerun again."
        )
    if own.has("base_actions") and (differs := _array_differs(episode, "actions", own, "base_actions")) is not None:
        raise StoreError(
            f"Policy call {int(np.argmax(differs))} of {episode.name} has other actions in {base.path} than in the "
            f"base of which {rerun.path} was made: the base was recorded again since; make the rerun again."
        )


def held_by_one(base: Run, rerun: Run) -> list[str]:
    """The inputs that only one of a run and its rerun holds, and which are therefore not compared."""
    known = {(*item.task, item.episode.name): item for item in base.question.selected}
    found = []
    for own in rerun.question.selected:
        if (item := known.get((*own.task, own.episode.name))) is not None:
            both = item.episode, own.episode
            for name in sorted({name for one in both for name in _inputs(one)} - _changed(item.store, own.store)):
                found += [_called(name, "s")] if both[0].has(name) != both[1].has(name) else []
    return list(dict.fromkeys(found))


def _inputs(episode: StoredEpisode) -> list[str]:
    """Arrays of what an episode's calls were given, and `noise_seed`, where it is known."""
    pictures = [name for name in episode.attributes.arrays if name.partition("/")[0] in _PICTURES]
    return [name for name in ("noise_seed", "state") if episode.has(name)] + pictures


def _differing_inputs(base: StoredEpisode, own: StoredEpisode, free: set[str]) -> Iterator[tuple[str, _Differs]]:
    """What of the calls' inputs differs although nothing changed it, and in which replans."""
    mine, theirs = base.attributes, own.attributes
    known: dict[str, tuple[Sequence[object], Sequence[object]]] = {"environment step": (mine.env_step, theirs.env_step)}
    if mine.noise_seed and theirs.noise_seed and "noise_seed" not in free:
        known["noise seed"] = (mine.noise_seed, theirs.noise_seed)
    if "prompt" not in free:
        known["prompt"] = (_prompts(base), _prompts(own))
    for name, (first, other) in known.items():
        differs = np.array([one != two for one, two in zip(first, other, strict=True)], dtype=bool)
        if differs.any():
            yield f"another {name}", differs
    for name in _inputs(base):
        if name == "noise_seed" or not own.has(name) or name in free:
            continue
        of_array = _array_differs(base, name, own, name)
        if of_array is not None:
            yield f"another {_called(name)}", of_array


def _prompts(episode: StoredEpisode) -> list[str]:
    """The text of each replan's prompt."""
    texts = [prompt.text for prompt in episode.attributes.prompts]
    return [texts[index] for index in episode.attributes.prompt_index]


def _called(name: str, plural: str = "") -> str:
    """What an input is called in a sentence."""
    group, _, camera = name.partition("/")
    if group in _PICTURES:
        return f"picture{plural} of camera '{camera}'"
    return {"state": f"state{plural} of the robot", "noise_seed": f"noise seed{plural}"}[name]


def _array_differs(first: StoredEpisode, name: str, other: StoredEpisode, others: str) -> _Differs | None:
    """In which replans (replan,) two arrays differ; None where they are the same. Equal ones are not read."""
    if first.attributes.arrays[name] == other.attributes.arrays[others]:
        return None
    one, two = first.read(name), other.read(others)
    if one.shape != two.shape:
        return np.ones(len(one), dtype=bool)
    differs: _Differs = (one != two).reshape(len(one), -1).any(axis=1)
    return differs if differs.any() else None


def is_noise(run: Run) -> bool:
    """Whether another noise seed is all that a rerun changed."""
    return all(changes_noise_alone(store.attributes.interventions) for store in run.stores)


def moved_episodes(base: Run, reruns: Sequence[Run]) -> tuple[pl.DataFrame, ActionUnits]:
    """How far the actions moved, means over the replans of each episode, and in which units.

    Units are those of all of the base's episodes, so that they do not change with --tasks.

    Returns:
        One row per (rerun, episode of both): run, `EPISODE_ID`, num_replans, the parts of the units; noise, the effect
        of another noise seed in the same episode (several: their mean), and minus_noise, the effect minus that; null
        where no rerun changes the noise alone, and for those that do.

    Raises:
        BadArgument: the base holds no actions, they are all the same, or a rerun has none of its episodes.
        StoreError: a rerun is of other policy calls, see `check_same_calls`.
    """
    members = {(*item.task, item.episode.name): BaseEpisode.of(item) for item in base.question.selected}
    settings, pairs = base.question.settings, []
    units = units_of(base.stores, settings.units, settings.skip_corrupt)
    for run in reruns:
        for own in run.question.selected:
            if (member := members.get((*own.task, own.episode.name))) is not None:
                check_same_calls(member.item.store, member.item.episode, own.store, own.episode)
                pairs.append((run, member, actions_of(own.store, own.episode)))
    for run in reruns:
        if not any(one is run for one, _, _ in pairs):
            raise BadArgument(f"The rerun {run.name} holds none of the selected episodes of {base.name}.")
    rows = [
        (run.name, is_noise(run), *member.item.key, len(others), *units.changes(member, others).mean(axis=0).tolist())
        for run, member, others in pairs
    ]
    names = ["run", "is_noise", *EPISODE_ID, "num_replans", *units.names]
    table = pl.DataFrame(rows, schema=names, orient="row").with_columns(pl.col(units.names).fill_nan(None))
    floor = table.filter("is_noise").group_by(EPISODE_ID).agg(noise=pl.mean(EFFECT))
    table = table.join(floor, on=EPISODE_ID, how="left", maintain_order="left")
    table = table.with_columns(noise=pl.when(~pl.col("is_noise")).then("noise")).drop("is_noise")
    return table.with_columns(minus_noise=pl.col(EFFECT) - pl.col("noise")), units


def moved(episodes: pl.DataFrame, units: ActionUnits, sampling: Sampling) -> pl.DataFrame:
    """Means of `moved_episodes` for every rerun with intervals; over_noise: mean effect / mean noise; minus_noise_q."""
    quotients = {"over_noise": ("effect", "noise")}
    return estimate(
        episodes, ["run"], units.scales | {"noise": "positive", "minus_noise": "plain"}, sampling, {"minus_noise": 0.0},
        quotients=quotients,
    )  # fmt: skip
