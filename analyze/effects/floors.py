"""Effects beside their floors: another noise seed, and random keys; means over episodes with intervals."""

from __future__ import annotations

from collections.abc import Sequence

import polars as pl

from vla_attention.analyze.effects.conditions import FLOORS, Condition, Kind
from vla_attention.analyze.effects.group_attention import MEASURES
from vla_attention.analyze.measures.frames import EPISODE_ID
from vla_attention.analyze.statistics.episode_intervals import Sampling, means_of_all_and_of_tasks
from vla_attention.analyze.statistics.intervals import NO_LIMITS, POSITIVE, SHARE
from vla_attention.analyze.statistics.many_looks import adjusted_p_values

_LIMITS = {"effect": POSITIVE, "effect_chunk": POSITIVE, "angle": POSITIVE, "gripper_flips": SHARE}
#: What a row of a condition is named by.
NAMES = ("condition", "kind", "group", "selector")


def with_floors(episodes: pl.DataFrame, conditions: Sequence[Condition]) -> pl.DataFrame:
    """The columns noise, random, minus_noise and minus_random of `EffectStudy.episodes`.

    Several reruns with other noise seeds, or several draws of random keys, are averaged.
    """
    place = [*EPISODE_ID, "phase"]
    effect = pl.col("effect").mean()
    noise = episodes.filter(pl.col("kind") == Kind.NOISE.value).group_by(place).agg(effect.alias("noise"))
    controls = []
    for condition in conditions:
        names = [other.name for other in conditions if other.is_control_of(condition)]
        among = episodes.filter(pl.col("condition").is_in(names))
        if condition.recorded and condition.kind == Kind.WITHOUT:
            among = _nearest_controls(episodes, condition, conditions, place)
        controlled = among.group_by(place).agg(effect.alias("random"))
        controls.append(controlled.with_columns(pl.lit(condition.name).alias("condition")))
    empty = pl.DataFrame(
        schema={name: episodes.schema[name] for name in place} | {"random": pl.Float64, "condition": pl.String}
    )
    random = pl.concat([empty, *controls], how="vertical_relaxed")
    floor = pl.col("kind").is_in([kind.value for kind in FLOORS])
    return (
        episodes.join(noise, on=place, how="left", maintain_order="left")
        .join(random, on=[*place, "condition"], how="left", maintain_order="left")
        .with_columns(pl.when(pl.col("kind") != Kind.NOISE.value).then("noise").alias("noise"))
        .with_columns(
            minus_noise=pl.col("effect") - pl.col("noise"),
            minus_random=pl.when(~floor).then(pl.col("effect") - pl.col("random")),
        )
    )


def _nearest_controls(
    episodes: pl.DataFrame, condition: Condition, conditions: Sequence[Condition], place: Sequence[str]
) -> pl.DataFrame:
    """The rows of the random keys whose number is nearest to that of a recorded condition, in each episode and phase.

    A run that records effects draws random keys for one word and for the whole instruction, not for every item.
    """
    readers = [(one.queries, one.query_selector) for one in condition.interventions.keys]
    names = [
        other.name
        for other in conditions
        if other.kind == Kind.RANDOM
        and [(one.queries, one.query_selector) for one in other.interventions.keys] == readers
    ]
    keys = episodes.filter(pl.col("condition") == condition.name).select(*place, pl.col("keys").alias("_keys"))
    among = episodes.filter(pl.col("condition").is_in(names)).join(keys, on=place, how="inner")
    distance = (pl.col("keys") - pl.col("_keys")).abs()
    # A few random keys are no floor for a whole picture.
    near = among.filter(pl.col("keys") >= pl.col("_keys") / 2)
    nearest = near.filter(distance == distance.min().over(place))
    return nearest.select(episodes.columns)


def summary_of(episodes: pl.DataFrame, sampling: Sampling) -> pl.DataFrame:
    """Means over episodes with intervals; every task weighs the same.

    Returns:
        One row per (scope, condition, phase): scope "all", or "task" with suite, task_id and instruction; kind, group,
        selector; num_episodes, num_tasks; `CHANGES`, mass, lift, norm, keys, noise, random, minus_noise, minus_random,
        over_noise and over_random (mean effect / mean effect of the floor), each with `_low`, `_high` and `_episodes`;
        minus_noise_q and minus_random_q: p of no difference, adjusted for the number of conditions
        (Benjamini-Hochberg).
    """
    values = {
        **_LIMITS,
        **dict.fromkeys((*MEASURES, "noise", "random"), POSITIVE),
        **dict.fromkeys(("minus_noise", "minus_random"), NO_LIMITS),
    }
    quotients = {"over_noise": ("effect", "noise"), "over_random": ("effect", "random")}
    nulls = {"minus_noise": 0.0, "minus_random": 0.0}
    return _with_adjusted(
        means_of_all_and_of_tasks(episodes, [*NAMES, "phase"], values, sampling, quotients=quotients, nulls=nulls)
    )


def _with_adjusted(summary: pl.DataFrame) -> pl.DataFrame:
    """p-values of differences to a floor become q, over the conditions that are no floor themselves."""
    floor = pl.col("kind").is_in([kind.value for kind in FLOORS])
    numbered = summary.with_columns(pl.int_range(pl.len()).alias("_row"))
    for name in ("minus_noise", "minus_random"):
        q_values: list[float | None] = [None] * numbered.height
        looks = numbered.filter(~floor).partition_by("scope", "suite", "task_id", "phase", maintain_order=True)
        for part in looks:
            for row, q in zip(part["_row"], adjusted_p_values(part[f"{name}_p"].to_list()), strict=True):
                q_values[row] = q
        numbered = numbered.with_columns(pl.Series(f"{name}_q", q_values, dtype=pl.Float64)).drop(f"{name}_p")
    return numbered.drop("_row")
