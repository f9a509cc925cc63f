"""What a table keeps apart (`--by`): axes of the rows, and what episodes belong to."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np
import polars as pl

from vla_attention.analyze.core.measure import Measured
from vla_attention.analyze.core.result import Column
from vla_attention.analyze.measures.tables import EPISODE_ID
from vla_attention.analyze.statistics.units import Sampling
from vla_attention.schemas.errors import BadArgument, listing, unknown_name

#: Axis -> its columns in tables of `core.measure` and how they are shown; those of an episode come with each row.
COLUMNS: Mapping[str, tuple[Column, ...]] = {
    "layer": (Column("layer", "text"),),
    "head": (Column("head", "count"),),
    "denoise": (Column("denoise_step", "count", "denoise step"),),
    "replan": (Column("replan", "count"),),
    "time": (Column("phase", "number", "time", "part of the episode, from its first replan (0) to its end (1)"),),
    "task": (Column("suite", "text", screen=False), Column("task_id", "count", "task"), Column("instruction", "text")),
    "family": (Column("family", "text", "task family", "tasks of one sentence template"),),
    "outcome": (Column("success", "text", "solved"),),
    "episode": (
        Column("suite", "text", screen=False),
        Column("task_id", "count", "task"),
        Column("episode_index", "count", "episode"),
    ),
}
#: The axes that rows are averaged over unless they are kept.
OF_ROWS = ("replan", "layer", "denoise", "head")
#: Parts of an episode's time.
TIME_PARTS = 20


def check_axes(by: Collection[str], allowed: Collection[str]) -> None:
    """Raise unless the axes can be kept apart here.

    Raises:
        UnknownName: there is no such axis.
        BadArgument: this question cannot keep it, or an axis stands twice.
    """
    for axis in by:
        if axis not in (*COLUMNS, "camera"):
            raise unknown_name("axis for --by", axis, [*COLUMNS, "camera"])
        if axis not in allowed:
            raise BadArgument(f"--by {axis} is not possible here; possible: {listing(allowed, 20)}.")
    if len(set(by)) < len(list(by)):
        raise BadArgument(f"--by {','.join(by)} names an axis twice.")


def columns_of(by: Collection[str]) -> list[Column]:
    """The columns that tell the rows of a table apart."""
    return list({column.name: column for axis in by for column in COLUMNS.get(axis, ())}.values())


def with_families(rows: pl.DataFrame, sampling: Sampling) -> pl.DataFrame:
    """The rows with a column `family`; null for a task of which none is known."""
    families = pl.DataFrame(
        [(suite, task, family) for (suite, task), family in sampling.families.items()],
        schema={"suite": pl.String, "task_id": pl.Int64, "family": pl.String},
        orient="row",
    )
    return rows.join(families, on=["suite", "task_id"], how="left", maintain_order="left")


def weighted(value: pl.Expr, weight: pl.Expr) -> pl.Expr:
    """Weighted mean over the finite values; null without any."""
    known = value.is_finite().fill_null(False)
    total = pl.when(known).then(weight).otherwise(0.0).sum()
    return pl.when(total > 0).then(pl.when(known).then(value * weight).otherwise(0.0).sum() / total)


def with_time(rows: pl.DataFrame, measured: Sequence[Measured]) -> pl.DataFrame:
    """The rows once for each part of the episode's time that their replan lasts in, with the share as `weight`.

    `phase` is the middle of the part. A replan's value holds until the next replan, as its actions do.
    """
    wanted = set(rows.select(EPISODE_ID).unique().rows())
    edges, parts = np.linspace(0.0, 1.0, TIME_PARTS + 1), []
    for one in measured:
        if (key := one.item.key) not in wanted:
            continue
        starts, num_steps = one.item.timing(one.env_step)
        ends = np.append(starts[1:], num_steps)
        shares = np.minimum(edges[1:, None], ends / num_steps) - np.maximum(edges[:-1, None], starts / num_steps)
        part, replan = np.nonzero(shares > 1e-12)  # rounding can make neighbours overlap by a tiny amount
        parts.append(
            pl.DataFrame(
                {
                    "replan": replan,
                    "phase": ((edges[:-1] + edges[1:]) / 2).round(6)[part],
                    "weight": shares[part, replan],
                }
            ).with_columns(**{name: pl.lit(value) for name, value in zip(EPISODE_ID, key, strict=True)})
        )
    weights = pl.concat(parts).with_columns(pl.col("replan", "task_id", "episode_index").cast(pl.Int64))
    return rows.join(weights, on=[*EPISODE_ID, "replan"], how="left", maintain_order="left")
