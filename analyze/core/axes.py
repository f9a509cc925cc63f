"""What a table keeps apart (`--by`): axes of the rows, and what episodes belong to."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import polars as pl

from vla_attention.analyze.core.result import Column
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
