"""Depth: the centre of gravity over layers of the attention on a group, by masses and by contributions."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import polars as pl
from numpy.typing import ArrayLike, NDArray

from vla_attention.analyze.measures.frames import EPISODE_ID, LAYERS_AVG, Tables
from vla_attention.analyze.measures.group_contributions import group_contribution_tables
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.statistics.episode_intervals import Sampling, means_with_intervals
from vla_attention.analyze.statistics.intervals import DEFAULT_LEVEL, NO_LIMITS
from vla_attention.schemas.groupings.resolve import ResolvedGrouping


def depth_centre(amounts: ArrayLike, blocks: ArrayLike) -> NDArray[np.float64]:
    """Centre of gravity over layers: sum over l of l x a_l / sum over l of a_l, with block indices l.

    The "center of gravity" of Tenney et al. (2019), "BERT Rediscovers the NLP Pipeline", section 3, which weighs layers
    in the same way. The same amount at every layer gives the mean block.

    Args:
        amounts: (..., layer), at least 0: masses of a group, or norms of its contributions.
        blocks: (layer,) block indices. The centre is one over these layers, whatever lies between them.

    Returns:
        (...); NaN where all amounts are 0 or one is not finite.
    """
    amount, block = np.asarray(amounts, dtype=np.float64), np.asarray(blocks, dtype=np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        centre: NDArray[np.float64] = (amount * block).sum(axis=-1) / amount.sum(axis=-1)
    return centre


def depth_table(
    episodes: Tables,
    norms: pl.DataFrame | None,
    sampling: Sampling,
    level: float = DEFAULT_LEVEL,
) -> pl.DataFrame:
    """One row per group that has any amount: the mean over episodes of its centre, with its interval.

    Columns: group; of: "mass", or "contribution" (the norm of what the group's keys add to the residual stream; norms
    may grow with depth, so compare this centre only with those of other groups); num_episodes, num_tasks,
    `ABOUT_COLUMNS`; centre_episodes (with a centre); centre, centre_low, centre_high;
    even: the centre of an amount that is the same at every layer; first_block, last_block, num_layers: the layers that
    the centre is over.

    Args:
        episodes: `aggregate.episode_tables`. A block that was named by two layer numbers counts once.
        norms: suite, task_id, episode_index, block, group, norm (see `contribution_norms`), where there are any.
        sampling: what intervals are about, and which tasks are related.
        level: of the intervals.
    """
    single = episodes.groups.filter(pl.col("layer") != LAYERS_AVG)
    parts = [_centres(single, "mass", "mass")]
    if norms is not None:
        parts.append(_centres(norms, "norm", "contribution"))
    blocks = single["block"].unique().sort()
    # With a single layer both limits are equal, and no interval could be widened between them.
    limits = (float(blocks[0]), float(blocks[-1])) if len(blocks) > 1 else NO_LIMITS
    table = means_with_intervals(pl.concat(parts), ("group", "of"), {"centre": limits}, sampling, level)
    return table.filter(pl.col("centre").is_not_null()).with_columns(
        pl.lit(float(np.mean(blocks.to_numpy()))).alias("even"),
        pl.lit(blocks[0], dtype=pl.Int64).alias("first_block"),
        pl.lit(blocks[-1], dtype=pl.Int64).alias("last_block"),
        pl.lit(len(blocks), dtype=pl.Int64).alias("num_layers"),
    )


def _centres(table: pl.DataFrame, column: str, of: str) -> pl.DataFrame:
    """One row per (group, episode) with its centre, from one row per (episode, block, group)."""
    cell = [*EPISODE_ID, "block", "group"]
    once = table.select(*cell, column).unique(cell, keep="first", maintain_order=True)
    once = once.sort(*EPISODE_ID, "block", maintain_order=True)
    episodes = once.select(EPISODE_ID).unique(maintain_order=True)
    blocks = once["block"].unique().sort().to_numpy()
    rows = []
    for (name,), part in once.partition_by("group", as_dict=True, maintain_order=True).items():
        amounts = part[column].fill_null(0.0).to_numpy().reshape(episodes.height, len(blocks))
        rows.append(
            episodes.select(
                pl.all(),
                pl.lit(name).alias("group"),
                pl.lit(of).alias("of"),
                pl.Series("centre", depth_centre(amounts, blocks)).fill_nan(None),
            )
        )
    return pl.concat(rows)


def contribution_norms(question: Question, resolved: Sequence[ResolvedGrouping]) -> pl.DataFrame | None:
    """Mean over replans and denoise steps of `group_contribution_tables`: one row per (episode, block, group)."""
    tables = group_contribution_tables(question, resolved)
    if tables is None:
        return None
    by = (*EPISODE_ID, "block", "group")
    return pl.concat(
        [part.groups.group_by(by, maintain_order=True).agg(pl.col("norm").mean()) for part in tables.parts]
    )
