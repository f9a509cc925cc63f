"""The number of independent replans in each episode, from the autocorrelation of its ratio."""

from __future__ import annotations

import polars as pl

from vla_attention.analyze.measures.frames import EPISODE_ID, EPISODE_KEYS, Tables
from vla_attention.analyze.statistics.autocorrelation import autocorrelation_table
from vla_attention.schemas.groupings.grouping import Grouping


def effective_replans_table(replans: Tables, grouping: Grouping) -> pl.DataFrame:
    """`autocorrelation_table` of every (episode, layer) of `aggregate.replan_tables`.

    The series is log2_ratio, or the first group's fraction when the grouping has no ratio.
    """
    keys = [*EPISODE_KEYS, "layer", "layer_number"]
    if grouping.ratio:
        name, values = "log2_ratio", replans.cells["log2_ratio"]
    else:
        name, values = f"{grouping.names[0]}_fraction", replans.of_group(grouping.names[0])["fraction"]
    table = replans.cells.select(*keys, "replan", values.alias(name)).sort("replan", maintain_order=True)
    return autocorrelation_table(table, keys, name).sort(*EPISODE_ID, "layer_number", nulls_last=True)
