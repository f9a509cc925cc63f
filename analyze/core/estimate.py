"""From one value per episode to what may be said: means over tasks, intervals by families, q after many looks."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Literal, TypeAlias

import polars as pl

from vla_attention.analyze.statistics.episode_intervals import Sampling, means_with_intervals
from vla_attention.analyze.statistics.intervals import NO_LIMITS, POSITIVE, SHARE
from vla_attention.analyze.statistics.many_looks import adjusted_p_values

#: positive: masses, lifts, ratios; the interval is symmetric on the log scale. share: 0..1, log odds. plain: as it is.
#: geometric: a column of ratios, of which the mean of logarithms is taken.
Scale: TypeAlias = Literal["positive", "share", "plain", "geometric"]
_LIMITS = {"positive": POSITIVE, "share": SHARE, "plain": NO_LIMITS}


def estimate(
    table: pl.DataFrame,
    by: Sequence[str],
    values: Mapping[str, Scale],
    sampling: Sampling,
    nulls: Mapping[str, float] | None = None,
    family: Collection[str] = (),
    quotients: Mapping[str, tuple[str, str]] | None = None,
) -> pl.DataFrame:
    """Mean of each value for every item of `by`, with its interval.

    Args:
        table: one row per (episode, item), with `suite` and `task_id`.
        by: the columns that name an item.
        values: columns to average, each with its scale.
        sampling: what the intervals are about, and which tasks are related.
        nulls: for some values, what they would be if nothing were there.
        family: of `by`, the columns inside of whose values the looks are counted; all rows are one look's unless given.
        quotients: further columns, each the mean of one column / the mean of another.

    Returns:
        One row per item in order of first appearance: `by`, num_episodes, num_tasks, num_families, intervals; per value
        V, V_low, V_high (null where there is none), and of `nulls` V_q, the p of this null adjusted for the number of
        rows (Benjamini-Hochberg).
    """
    nulls = nulls or {}
    limits = {name: _LIMITS[scale] for name, scale in values.items() if scale != "geometric"}
    geometric = {name: f"_log_{name}" for name, scale in values.items() if scale == "geometric"}
    logs = table.with_columns(pl.col(name).log().alias(log) for name, log in geometric.items())
    found = means_with_intervals(
        logs, by, limits, sampling, nulls=nulls, quotients=quotients, geometric=geometric
    )  # fmt: skip
    found = found.drop(f"{name}_episodes" for name in (*values, *(quotients or {})))
    for name in nulls:
        found = with_q(found, name, family)
    return found


def with_q(table: pl.DataFrame, name: str, family: Collection[str] = ()) -> pl.DataFrame:
    """The table with NAME_q in the place of NAME_p, adjusted for the number of rows, or of rows of each `family`."""
    parts = table.partition_by(*family, maintain_order=True) if family else [table]
    adjusted = [
        part.with_columns(
            pl.Series(f"{name}_q", adjusted_p_values(part[f"{name}_p"].to_list()), dtype=pl.Float64)
        ).drop(f"{name}_p")
        for part in parts
    ]
    return pl.concat(adjusted) if adjusted else table.rename({f"{name}_p": f"{name}_q"})
