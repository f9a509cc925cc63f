"""Where the next steps go when the policy is told of another thing of the scene: towards it, or as they went without.

Only what the simulator says of its tasks decides which things a sentence names: those that it calls of interest in the
task whose instruction the sentence is.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.core.action_changes import BaseEpisode, counted
from vla_attention.analyze.core.hand_movements import TRANSLATION
from vla_attention.analyze.measures.selected import SelectedEpisode
from vla_attention.analyze.measures.tables import EPISODE_ID
from vla_attention.analyze.stores.selection import read_usable
from vla_attention.schemas.effects import CHANGE
from vla_attention.schemas.episode_steps import HAND, POSES
from vla_attention.schemas.groupings.words import folded_words
from vla_attention.schemas.stores.reader import Store
from vla_attention.schemas.stores.store_format import EpisodeAttributes

Array = NDArray[np.float64]
Names = Mapping[tuple[str, ...], frozenset[str]]

#: The kinds of sentences that may name another thing.
KINDS = ("exchanged", "other task", "contradicted")


def things_of_sentences(stores: Sequence[Store], skip_corrupt: bool = False) -> Names:
    """The things that the simulator says a task names, by the words of its instruction.

    skip_corrupt: damaged episodes say nothing.
    """
    found: dict[tuple[str, ...], frozenset[str]] = {}
    for _, _, attributes in read_usable(stores, skip_corrupt, lambda episode: episode.attributes):
        found.setdefault(folded_words(attributes.instruction), _of_interest(attributes))
        for goal in attributes.steps.goals if attributes.steps is not None else ():
            if goal.things:  # a task that shares the scene, whether the store has an episode of it or not
                found.setdefault(folded_words(goal.instruction), frozenset(goal.things))
    return found


def _of_interest(attributes: EpisodeAttributes) -> frozenset[str]:
    return frozenset(thing.name for thing in attributes.objects if thing.of_interest)


def directions(items: Sequence[SelectedEpisode], names: Names, metres: float) -> tuple[pl.DataFrame, int]:
    """How much closer to the newly named thing the executed steps of a chunk go, as the policy was told and otherwise.

    The steps' translations are summed, projected on the line from the hand to the thing at the chunk's beginning, and
    brought to metres. metres: how far a command of 1 moves the hand in a step.

    Returns:
        One row per episode and sentence that names a single other thing: suite, task_id, episode_index, sentence (its
        kind), and in metres changed, unchanged, closer (their difference), means over replans; and of how many
        sentences of `KINDS` that is not known.
    """
    rows, left_out = [], set()
    for item in (one.fresh() for one in items if one.episode.has(CHANGE) and one.episode.has(POSES)):
        attributes, base = item.episode.attributes, BaseEpisode.of(item)
        steps, effects = attributes.steps, attributes.effects
        assert steps is not None
        assert effects is not None
        poses = item.episode.read(POSES).astype(np.float64)[..., :3]
        hand = poses[:, steps.bodies.index(HAND)]
        change = item.episode.read(CHANGE).astype(np.float64) * np.array(effects.units)
        for number, prompt in enumerate(condition.prompt for condition in effects.conditions):
            entries = np.flatnonzero(np.array(effects.condition) == number)
            if prompt is None or prompt.meaning not in KINDS or not entries.size:
                continue
            named = names.get(folded_words(prompt.text))
            others = (named or frozenset()) & {*steps.bodies} - _of_interest(attributes)
            if named is None or len(others) > 1:
                left_out.add(prompt.text)
            if len(others) != 1:
                continue
            at = base.at(np.array(effects.replan)[entries])
            line = poses[at.starts, steps.bodies.index(next(iter(others)))] - hand[at.starts]
            changed = along(line, at.actions + change[entries], at.executed).mean()
            unchanged = along(line, at.actions, at.executed).mean()
            rows.append(
                (item.store.suite, attributes.task_id, attributes.episode_index, prompt.meaning, changed, unchanged)
            )
    table = pl.DataFrame(rows, schema=[*EPISODE_ID, "sentence", "changed", "unchanged"], orient="row")
    table = table.with_columns(pl.col("changed", "unchanged") * metres)
    return table.with_columns(closer=pl.col("changed") - pl.col("unchanged")), len(left_out)


def along(line: Array, actions: Array, steps: NDArray[np.int64]) -> Array:
    """How far the first `steps` (replan,) of each chunk go along a line (replan, 3), in the actions' own unit.

    actions: (replan, horizon, dimension); the first three move the hand along the axes of the world.
    """
    told = (actions[..., TRANSLATION] * counted(steps, actions.shape[1])[..., None]).sum(axis=1)
    result: Array = (told * line).sum(axis=1) / np.linalg.norm(line, axis=1)
    return result
