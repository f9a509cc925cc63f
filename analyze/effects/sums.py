"""Effects of groups that were not measured together: sums of single effects, which are not the group's own.

Single effects do not add up. Two sums stand for a group whose keys are exactly those of several items: the size of the
summed changes, and the sum of the sizes. For whole instructions of the small policy of `docs/cubes.md` the first was
0.99 [0.79, 1.36] of the exact effect and the second 1.38 [1.07, 1.97]; for cameras both fail.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.effects.action_changes import ActionSpread, root_mean_square_change
from vla_attention.analyze.effects.conditions import Condition, Kind, Reader, reader_of, selector_kind
from vla_attention.analyze.effects.paired_replans import BaseEpisode, changes_recorded
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.measures.selected import resolve_all
from vla_attention.analyze.statistics.episode_intervals import means_of_all_and_of_tasks
from vla_attention.analyze.statistics.intervals import POSITIVE
from vla_attention.schemas.effects import CUT
from vla_attention.schemas.safe_text import visible

#: Weights that differ by less are the same.
_SAME = 1e-4
_SCHEMA: dict[str, Any] = {
    "suite": pl.String,
    "task_id": pl.Int64,
    "instruction": pl.String,
    "episode_index": pl.Int64,
    "group": pl.String,
    "reader": pl.String,
    "num_items": pl.Float64,
    "size_of_sum": pl.Float64,
    "sum_of_sizes": pl.Float64,
}


def sums_of_groups(
    question: Question, members: Sequence[BaseEpisode], spread: ActionSpread, conditions: Sequence[Condition]
) -> pl.DataFrame:
    """The two sums of every group of the question's grouping that no item is, and that several items make up.

    Returns:
        One row per (episode, group, reader), means over the replans in which the items make up the group: num_items,
        size_of_sum and sum_of_sizes, in the units of effects.
    """
    single: dict[Reader, list[Condition]] = {}
    for condition in conditions:
        reader = reader_of(condition)
        if condition.recorded and condition.kind == Kind.WITHOUT and reader is not None:
            single.setdefault(reader, []).append(condition)
    known = {item.episode.name: item for item in question.selected}
    chosen = [member for member in members if member.name in known]
    resolved = resolve_all(question.grouping, [known[member.name] for member in chosen], question.vocabulary)
    rows: list[dict[str, object]] = []
    for member, groups in zip(chosen, resolved, strict=True):
        attributes = member.item.episode.attributes
        if attributes.effects is None or not attributes.effects.replan:
            continue
        named = {
            "suite": member.item.store.suite,
            "task_id": attributes.task_id,
            "instruction": visible(attributes.instruction),
            "episode_index": attributes.episode_index,
        }
        valid = known[member.name].tokens.valid
        changes = changes_recorded(member) * np.array(attributes.effects.units)
        cut = member.item.episode.read(f"{question.site}/{CUT}")
        for number, group in enumerate(groups.names):
            weights = np.broadcast_to(groups.weights[..., number] * valid, (len(member.actions), cut.shape[1]))
            for reader, conditions_of_reader in single.items():
                sums = _of_episode(member, weights, cut, changes, spread, conditions_of_reader)
                if sums is not None:
                    rows.append(named | {"group": group, "reader": reader} | sums)
    return pl.DataFrame(rows, schema=_SCHEMA)


def _of_episode(
    member: BaseEpisode,
    weights: NDArray[np.floating],
    cut: NDArray[np.float32],
    changes: NDArray[np.float64],
    spread: ActionSpread,
    conditions: Sequence[Condition],
) -> dict[str, float] | None:
    """The sums of one episode; None where the items make up the group at no replan, or one of them is the group.

    weights: (replan, key) of the group. cut: (entry, key). changes: (entry, step, dimension).
    """
    effects = member.item.episode.attributes.effects
    assert effects is not None
    replan_of, condition_of = np.array(effects.replan), np.array(effects.condition)
    known = [one for one in conditions if one.interventions in effects.conditions]
    numbers = {effects.conditions.index(one.interventions): one for one in known}
    single = [number for number, one in numbers.items() if selector_kind(one)]
    sizes: list[tuple[int, float, float]] = []
    for replan in sorted(set(effects.replan)):
        wanted = weights[replan]
        entries = [int(entry) for entry in np.flatnonzero(replan_of == replan) if int(condition_of[entry]) in numbers]
        if not wanted.any() or any(np.allclose(cut[entry], wanted, atol=_SAME) for entry in entries):
            continue
        taken = _made_up_of(wanted, [entry for entry in entries if condition_of[entry] in single], cut)
        if taken:
            base, steps = member.actions[replan][None], member.executed[replan][None]
            summed = root_mean_square_change(base, base + changes[taken].sum(axis=0), spread, steps)
            each = [float(root_mean_square_change(base, base + changes[one], spread, steps)[0]) for one in taken]
            sizes.append((len(taken), float(summed[0]), sum(each)))
    if not sizes:
        return None
    means = np.mean(sizes, axis=0)
    return dict(zip(("num_items", "size_of_sum", "sum_of_sizes"), map(float, means), strict=True))


def _made_up_of(wanted: NDArray[np.floating], entries: Sequence[int], cut: NDArray[np.float32]) -> list[int]:
    """Entries whose keys together are the wanted ones, each once, the smallest first; empty where they are not."""
    taken: list[int] = []
    covered = np.zeros_like(wanted)
    for entry in sorted(entries, key=lambda one: float(cut[one].sum())):
        if cut[entry].any() and (covered + cut[entry] <= wanted + _SAME).all():
            taken.append(entry)
            covered = covered + cut[entry]
    return taken if np.allclose(covered, wanted, atol=_SAME) else []


def summary_of_sums(sums: pl.DataFrame, question: Question) -> pl.DataFrame:
    """Means over episodes with intervals: scope, group, reader, num_items, size_of_sum and sum_of_sizes."""
    values = dict.fromkeys(("num_items", "size_of_sum", "sum_of_sizes"), POSITIVE)
    return means_of_all_and_of_tasks(sums, ["group", "reader"], values, question.sampling)
