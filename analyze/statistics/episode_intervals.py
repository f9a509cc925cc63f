"""Means with intervals of things that not every episode has (a word, an object), from a table with one row per episode and thing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import polars as pl

from vla_attention.analyze.statistics.bootstrap import (
    DEFAULT_LEVEL,
    DEFAULT_RESAMPLES,
    DEFAULT_SEED,
    Resamples,
    bootstrap_intervals,
    mean_over_episodes,
    resample_episodes,
)

_TASK = ("suite", "task_id")


def means_with_intervals(
    table: pl.DataFrame,
    by: Sequence[str],
    values: Mapping[str, tuple[float, float]],
    seed: int = DEFAULT_SEED,
    level: float = DEFAULT_LEVEL,
    num_resamples: int = DEFAULT_RESAMPLES,
) -> pl.DataFrame:
    """Mean over episodes of each value, with the two-level interval of `vla_attention.analyze.statistics.bootstrap`, for every thing.

    A thing that only some episodes have is about these: tasks and episodes are drawn from them alone. Values that are null or
    not finite take no part in their mean.

    Args:
        table: one row per (episode, thing), with `suite` and `task_id`.
        by: the columns that make a thing.
        values: columns to average, with their natural limits (`statistics.NO_LIMITS`, `POSITIVE`, `SHARE`).
        seed: of the bootstrap.
        level: of the intervals.
        num_resamples: of the bootstrap.

    Returns:
        One row per thing in order of first appearance: `by`, `num_episodes`, `num_tasks`, and per value `V`, `V_low`, `V_high`
        (null where there is none) and `V_episodes`, how many episodes have a finite value.
    """
    drawn: dict[tuple[Any, ...], Resamples] = {}
    rows = []
    for key, part in table.group_by(by, maintain_order=True):
        tasks = tuple(part.select(pl.concat_str(_TASK, separator="\t")).to_series().to_list())
        if tasks not in drawn:
            drawn[tasks] = resample_episodes(tasks, num_resamples, seed)
        statistics = [
            mean_over_episodes(part[name].cast(pl.Float64).to_numpy(), limits) for name, limits in values.items()
        ]
        intervals = bootstrap_intervals(statistics, drawn[tasks], level)
        row: dict[str, Any] = {
            **dict(zip(by, key, strict=True)),
            "num_episodes": part.height,
            "num_tasks": len(set(tasks)),
        }
        for name, statistic, interval in zip(values, statistics, intervals, strict=True):
            row[name] = statistic.value
            row[f"{name}_low"] = interval.low if interval else None
            row[f"{name}_high"] = interval.high if interval else None
            row[f"{name}_episodes"] = int(statistic.used.sum())
        rows.append(row)
    schema: dict[str, Any] = {name: table.schema[name] for name in by}
    schema |= {"num_episodes": pl.Int64, "num_tasks": pl.Int64}
    for name in values:
        schema |= dict.fromkeys((name, f"{name}_low", f"{name}_high"), pl.Float64) | {f"{name}_episodes": pl.Int64}
    return pl.DataFrame(rows, schema=schema)
