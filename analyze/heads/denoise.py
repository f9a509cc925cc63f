"""Denoise steps: every denoise step by itself."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
import polars as pl

from vla_attention.analyze.measures.aggregate import (
    episode_tables,
    overall_layer,
    overall_rows,
    replan_tables,
    task_tables,
)
from vla_attention.analyze.measures.frames import Tables, concat_tables
from vla_attention.analyze.measures.not_in_memory import MadeWhenAsked
from vla_attention.analyze.measures.steps import MeasuredEpisode
from vla_attention.analyze.statistics.episode_intervals import Sampling
from vla_attention.schemas.groupings.grouping import Grouping


def denoise_tables(measured: Sequence[MeasuredEpisode], grouping: Grouping, sampling: Sampling) -> Tables:
    """Every denoise step: the numbers over all tasks and layers of an analysis in which only this step is selected.

    Returns:
        `denoise_step`, `denoise_time` (mean over episodes) and the columns of `aggregate.task_tables`, in the order of
        the steps.
    """
    selection = measured[0].selection
    parts = []
    for position in np.argsort(selection.denoise_steps, kind="stable").tolist():
        of_step = MadeWhenAsked(partial(_at_denoise, measured, position), range(len(measured)))
        episodes = episode_tables(replan_tables(of_step, grouping), grouping)
        layer = overall_layer(episodes.cells)
        whole = overall_rows(task_tables(episodes.filter(pl.col("layer") == layer), grouping, sampling))
        times = [one.item.episode.read("denoise_time")[selection.denoise[position]] for one in measured]
        time = pl.lit(float(np.mean(times)), dtype=pl.Float64).alias("denoise_time")
        number = pl.lit(selection.denoise_steps[position], dtype=pl.Int64).alias("denoise_step")
        cells, groups = (table.select(number, time, pl.all()) for table in (whole.cells, whole.groups))
        parts.append(Tables(cells, groups))
    return concat_tables(parts)


def _at_denoise(measured: Sequence[MeasuredEpisode], position: int, episode: int) -> MeasuredEpisode:
    return measured[episode].at_denoise(position)
