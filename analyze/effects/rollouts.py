"""Rollouts under interventions, paired with those of the base by initial state: success and number of steps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import polars as pl

from vla_attention.analyze.effects.conditions import Condition
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.statistics.episode_intervals import Sampling, means_of_all_and_of_tasks
from vla_attention.analyze.statistics.intervals import NO_LIMITS, POSITIVE, SHARE
from vla_attention.schemas.errors import BadArgument, listing
from vla_attention.schemas.safe_text import visible
from vla_attention.schemas.stores.reader import StoredEpisode

#: The columns of `rollout_pairs`.
ROLLOUT_COLUMNS: dict[str, Any] = {
    "suite": pl.String,
    "task_id": pl.Int64,
    "instruction": pl.String,
    "condition": pl.String,
    "episode_base": pl.Int64,
    "episode": pl.Int64,
    **dict.fromkeys(("success_base", "success", "success_difference"), pl.Float64),
    **dict.fromkeys(("steps_base", "steps", "steps_difference"), pl.Float64),
}
_VALUES = {
    **dict.fromkeys(("success_base", "success"), SHARE),
    **dict.fromkeys(("steps_base", "steps"), POSITIVE),
    **dict.fromkeys(("success_difference", "steps_difference"), NO_LIMITS),
}


def rollout_pairs(condition: Condition, question: Question) -> tuple[pl.DataFrame, str]:
    """Pairs of rollouts from the same initial state of a task, and a note on what has no partner or another noise.

    Of several rollouts from one initial state, the first ones are a pair, then the second ones.

    Raises:
        BadArgument: no two rollouts begin alike.
    """
    base = _by_start([item.episode for item in question.selected])
    changed = _by_start(condition.store.episodes)
    shared = [start for start in base if start in changed]
    if not shared:
        raise BadArgument(
            f"No rollout of {condition.store.path} begins in the initial state of a selected episode of "
            f"{question.stores[0].path}; roll out the same tasks and episodes."
        )
    suite, rows = question.stores[0].suite, []
    for start in shared:
        first, other = base[start].attributes, changed[start].attributes
        success = [None if one.success is None else float(one.success) for one in (first, other)]
        # 0: not known.
        steps = [float(one.num_steps) if one.num_steps else None for one in (first, other)]
        rows.append(
            {
                "suite": suite,
                "task_id": first.task_id,
                "instruction": visible(first.instruction),
                "condition": condition.name,
                "episode_base": first.episode_index,
                "episode": other.episode_index,
                "success_base": success[0],
                "success": success[1],
                "success_difference": None if success[0] is None or success[1] is None else success[1] - success[0],
                "steps_base": steps[0],
                "steps": steps[1],
                "steps_difference": None if steps[0] is None or steps[1] is None else steps[1] - steps[0],
            }
        )
    notes = []
    missing = [base[start].name for start in base if start not in changed]
    if missing:
        notes.append(f"{condition.name} has no rollout from the initial states of {listing(missing, 6)}.")
    seeds = question.stores[0].attributes.protocol.seed, condition.store.attributes.protocol.seed
    if seeds[0] != seeds[1]:
        notes.append(
            f"{condition.name} was rolled out with the seed {seeds[1]} and the base with {seeds[0]}: noise differs too."
        )
    return pl.DataFrame(rows, schema=ROLLOUT_COLUMNS), " ".join(notes)


def rollout_summary(pairs: pl.DataFrame, sampling: Sampling) -> pl.DataFrame:
    """Means over pairs with intervals, of every condition over all tasks and of every task.

    Returns:
        One row per (scope, condition): scope "all", or "task" with suite, task_id and instruction; num_episodes
        (pairs), num_tasks; success_base, success, success_difference, steps_base, steps, steps_difference, each with
        `_low`, `_high` and `_episodes`. The number of steps of a failure is that at which it was stopped.
    """
    return means_of_all_and_of_tasks(pairs, ["condition"], _VALUES, sampling)


def _by_start(episodes: Sequence[StoredEpisode]) -> dict[tuple[int, str, int], StoredEpisode]:
    """Episodes by task, initial state and how many of the same came before."""
    by_start: dict[tuple[int, str, int], StoredEpisode] = {}
    for episode in episodes:
        attributes, count = episode.attributes, 0
        while (attributes.task_id, attributes.initial_state, count) in by_start:
            count += 1
        by_start[attributes.task_id, attributes.initial_state, count] = episode
    return by_start
