"""How far the actions of reruns are from those of their base, and beside another noise seed."""

from __future__ import annotations

from collections.abc import Sequence

import polars as pl

from vla_attention.analyze.core.action_changes import (
    CHANGES,
    BaseEpisode,
    action_spread,
    actions_of,
    changes_noise_alone,
    changes_of,
    noise_of,
    with_noise,
)
from vla_attention.analyze.core.estimate import Scale, estimate
from vla_attention.analyze.core.runs import Run
from vla_attention.analyze.core.same_calls import check_same_calls
from vla_attention.analyze.measures.frames import EPISODE_ID
from vla_attention.analyze.measures.masses import finite_mean
from vla_attention.analyze.statistics.units import Sampling
from vla_attention.schemas.errors import BadArgument

_SCALES: dict[str, Scale] = {
    "effect": "positive", "effect_chunk": "positive", "angle": "positive", "gripper_flips": "share",
    "noise": "positive", "minus_noise": "plain",
}  # fmt: skip


def is_noise(run: Run) -> bool:
    """Whether another noise seed is all that a rerun changed."""
    return all(changes_noise_alone(store.attributes.interventions) for store in run.stores)


def moved_episodes(base: Run, reruns: Sequence[Run]) -> pl.DataFrame:
    """How far the actions moved, means over the replans of each episode.

    Units are the standard deviations of the base's actions over all of its episodes and steps, so that they do not
    change with --tasks. A dimension that another noise seed changes by more than its spread is not compared.

    Returns:
        One row per (rerun, episode of both): run, `EPISODE_ID`, num_replans, `CHANGES`; noise, the effect of another
        noise seed in the same episode (several: their mean), and minus_noise, the effect minus that; null where no
        rerun changes the noise alone, and for those that do.

    Raises:
        BadArgument: the base holds no actions, they are all the same, or a rerun has none of its episodes.
        StoreError: a rerun is of other policy calls, see `same_calls.check_same_calls`.
    """
    members = {(*item.task, item.episode.name): BaseEpisode.of(item) for item in base.question.selected}
    spread = action_spread([actions_of(store, one) for store in base.stores for one in store.episodes])
    if not spread.used.any():
        raise BadArgument(f"The actions of {base.name} are the same in every replan and step: a change has no unit.")
    pairs = []
    for run in reruns:
        for store in run.stores:
            for episode in store.episodes:
                key = (store.suite, episode.attributes.task_id, episode.name)
                if (member := members.get(key)) is not None:
                    check_same_calls(member.item.store, member.item.episode, store, episode)
                    pairs.append((run, member, actions_of(store, episode)))
    for run in reruns:
        if not any(one is run for one, _, _ in pairs):
            raise BadArgument(f"The rerun {run.name} holds none of the selected episodes of {base.name}.")
    noise = [(member.actions, others) for run, member, others in pairs if is_noise(run)]
    spread = with_noise(spread, noise_of(noise, spread.spread)) if noise else spread
    rows = [
        (
            run.name,
            is_noise(run),
            *member.item.key,
            len(others),
            *finite_mean(changes_of(member, others, spread)).tolist(),
        )
        for run, member, others in pairs
    ]
    names = ["run", "is_noise", *EPISODE_ID, "num_replans", *CHANGES]
    table = pl.DataFrame(rows, schema=names, orient="row").with_columns(pl.col(CHANGES).fill_nan(None))
    floor = table.filter("is_noise").group_by(EPISODE_ID).agg(noise=pl.mean("effect"))
    table = table.join(floor, on=EPISODE_ID, how="left", maintain_order="left")
    table = table.with_columns(noise=pl.when(~pl.col("is_noise")).then("noise")).drop("is_noise")
    return table.with_columns(minus_noise=pl.col("effect") - pl.col("noise"))


def moved(episodes: pl.DataFrame, sampling: Sampling) -> pl.DataFrame:
    """Means of `moved_episodes` for every rerun with intervals; over_noise: mean effect / mean noise; minus_noise_q."""
    quotients = {"over_noise": ("effect", "noise")}
    return estimate(episodes, ["run"], _SCALES, sampling, {"minus_noise": 0.0}, quotients=quotients)
