"""Over the denoising of one replan: everything that is said of all denoise steps, for each of them alone."""

from __future__ import annotations

import polars as pl

from vla_attention.analyze.measures.aggregate import (
    add_layers_avg,
    episodes_table,
    overall_layer,
    overall_rows,
    per_replan,
    tasks_table,
)
from vla_attention.analyze.statistics.bootstrap import DEFAULT_SEED
from vla_attention.schemas.groupings.grouping import Grouping


def denoise_table(steps: pl.DataFrame, grouping: Grouping, seed: int = DEFAULT_SEED) -> pl.DataFrame:
    """One row per denoise step, in the order of the steps: `denoise_step`, `denoise_time`, and the columns of `tasks_table`.

    Each row is what the whole analysis would say of all tasks, all layers together, had only this step been selected.
    """
    rows = []
    for step in steps["denoise_step"].unique().sort():
        part = steps.filter(pl.col("denoise_step") == step)
        episodes = episodes_table(add_layers_avg(per_replan(part, grouping), grouping), grouping)
        of_whole = tasks_table(episodes.filter(pl.col("layer") == overall_layer(episodes)), grouping, seed=seed)
        time = pl.lit(part["denoise_time"].mean(), dtype=pl.Float64).alias("denoise_time")
        number = pl.lit(step, dtype=pl.Int64).alias("denoise_step")
        rows.append(overall_rows(of_whole).select(number, time, pl.all()))
    return pl.concat(rows)
