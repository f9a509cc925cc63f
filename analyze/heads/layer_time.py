"""Layers over the course of episodes: every layer in equal parts of the episodes' time."""

from __future__ import annotations

import numpy as np
import polars as pl

from vla_attention.analyze.measures.aggregate import layer_order
from vla_attention.analyze.measures.alignment import on_episode_time, steps_of_time
from vla_attention.analyze.measures.frames import EPISODE_ID, LAYERS_AVG, Tables
from vla_attention.analyze.statistics.episode_intervals import Sampling
from vla_attention.analyze.statistics.intervals import (
    DEFAULT_LEVEL,
    estimates,
    mean_over_episodes,
)
from vla_attention.schemas.groupings.grouping import Grouping

MOST_BINS = 20
#: Number of groups that are shown of a grouping without a ratio.
_MOST_GROUPS = 3


def layer_time_table(
    replans: Tables,
    grouping: Grouping,
    sampling: Sampling,
    num_bins: int | None = None,
    level: float = DEFAULT_LEVEL,
) -> pl.DataFrame:
    """Means over episodes with intervals for every layer and equal part of the episodes' time.

    An episode's time is divided as in `on_episode_time`. Columns: quantity, layer, block, bin, start, stop
    (0..1), num_episodes (with a finite value), mean, low, high. The quantity with a ratio is `log2_lift`, log2 of ratio
    over uniform ratio (`log2_ratio` where a side has no keys and there is no uniform ratio); else the fraction
    `{g}_fraction` of each of the first groups with mass.

    Args:
        replans: `aggregate.replan_tables`.
        grouping: the groups.
        sampling: what intervals are about, and which tasks are related.
        num_bins: parts of the time; `MOST_BINS` unless no episode has as many replans.
        level: of the intervals.
    """
    tables = replans.filter(pl.col("layer") != LAYERS_AVG)
    tables = tables if grouping.ratio is not None else tables.kept()
    single = tables.cells
    if grouping.ratio is not None:
        quantities = ["log2_ratio" if single["uniform_ratio"].is_null().all() else "log2_lift"]
        single = single.with_columns(pl.col("ratio_lift").log(2.0).alias("log2_lift"))
    else:
        having = (tables.groups_with_mass() or grouping.names)[:_MOST_GROUPS]
        quantities = [f"{name}_fraction" for name in having]
        single = single.with_columns(tables.of_group(name)["fraction"].alias(f"{name}_fraction") for name in having)
    layers = [layer for layer in layer_order(single) if layer != LAYERS_AVG]
    blocks = dict(single.select("layer", "block").unique().iter_rows())
    bins = num_bins or min(MOST_BINS, int(single["replan"].to_numpy().max()) + 1)
    place = {layer: i for i, layer in enumerate(layers)}
    values, names = [], []
    for key, part in single.sort(*EPISODE_ID, "replan").group_by(EPISODE_ID, maintain_order=True):
        at = part["replan"].rank("dense").to_numpy().astype(np.int64) - 1
        column = part["layer"].replace_strict(place, return_dtype=pl.Int64).to_numpy()
        table = np.full((at.max() + 1, len(layers), len(quantities)), np.nan)
        table[at, column] = part.select(pl.col(quantities).fill_null(float("nan"))).to_numpy()
        starts = part["env_step"].unique().sort().to_numpy()
        starts, num_steps = steps_of_time(starts, int(part["num_steps"][0]))
        timed = on_episode_time(table.reshape(len(table), -1), starts, num_steps, bins)
        values.append(timed.reshape(bins, len(layers), len(quantities)))
        names.append(key)
    stacked = np.stack(values).transpose(0, 3, 2, 1).reshape(len(values), -1)  # (episode, quantity x layer x bin)
    statistics = [mean_over_episodes(stacked[:, i]) for i in range(stacked.shape[1])]
    episodes = pl.DataFrame(names, schema={name: single.schema[name] for name in EPISODE_ID}, orient="row")
    found = estimates(statistics, sampling.units(episodes).decided())
    intervals = [one.interval(level) for one in found]
    quantity, layer, part_of = (axis.ravel() for axis in np.indices((len(quantities), len(layers), bins)))
    return pl.DataFrame(
        {
            "quantity": [quantities[i] for i in quantity],
            "layer": [layers[i] for i in layer],
            "block": [blocks[layers[i]] for i in layer],
            "bin": part_of,
            "start": part_of / bins,
            "stop": (part_of + 1) / bins,
            "num_episodes": [int(statistic.used.sum()) for statistic in statistics],
            "mean": [one.value for one in found],
            "low": [interval.low if interval else None for interval in intervals],
            "high": [interval.high if interval else None for interval in intervals],
        },
        schema_overrides=dict.fromkeys(("mean", "low", "high"), pl.Float64),
    )
