"""Differences of recorded effects between runs: what the action depended on in one, and does in the other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import polars as pl

from vla_attention.analyze.compare.differences import (
    DIFFERENCE_SCHEMA,
    PAIR_KEYS,
    pair_episodes,
    paired_differences,
    unpaired_differences,
    with_adjusted,
)
from vla_attention.analyze.compare.replan_pairs import is_rerun
from vla_attention.analyze.compare.runs import Run
from vla_attention.analyze.core.action_changes import units_of_recorded
from vla_attention.analyze.core.recorded_effects import recorded_effects
from vla_attention.analyze.measures.frames import EPISODE_ID, LAYERS_AVG
from vla_attention.analyze.statistics.episode_intervals import Sampling
from vla_attention.schemas.errors import BadArgument, listing

#: The readers whose effects are compared.
_READERS = ("total", "direct")
_NO_BLOCK = pl.lit(None, pl.Int64).alias("block")
EMPTY = pl.DataFrame(schema={"run": pl.String, "item": pl.String, "reader": pl.String, **DIFFERENCE_SCHEMA})


def effect_differences(
    runs: Sequence[Run], episodes: Sequence[pl.DataFrame], sampling: Sampling
) -> tuple[pl.DataFrame, list[str]]:
    """The effects of every run minus those of the first one, where both recorded them.

    episodes: per run a table of `differences`, of which the rows' episodes are taken.

    Returns:
        One row per (run, item, reader, scope) like those of `comparison.Comparison.differences`, with `item` and
        `reader` ("total", "direct") for the quantity; and notes. Effects are in the spread of their own run's actions,
        over the dimensions that all runs compare.
    """
    having = [run for run in runs if any(store.attributes.recording.effects for store in run.stores)]
    if runs[0] not in having or len(having) < 2:
        lacking = [run.name for run in runs if run not in having]
        return EMPTY, [f"effects are not compared: {listing(lacking)} recorded none."] if having else []
    try:
        tables = _values(having)
    except BadArgument as error:
        return EMPTY, [f"effects are not compared: {error}"]
    keys = ["suite", "task_id", "episode_index"]
    sides = {
        run.name: table.unique(keys, maintain_order=True)
        .select(*PAIR_KEYS, "instruction", "episode_index", pl.lit(LAYERS_AVG).alias("layer"), _NO_BLOCK)
        .join(tables[run.name], on=keys, how="inner", maintain_order="left")
        for run, table in zip(runs, episodes, strict=True)
        if run in having
    }
    first = sides.pop(runs[0].name)
    parts = [EMPTY]
    for name, other in sides.items():
        quantities = [column for column in tables[name].columns if column not in keys and column in first.columns]
        if not quantities:
            continue
        run = next(run for run in runs if run.name == name)
        joined = pair_episodes(first, other, quantities, same_episode=is_rerun(runs[0], run))
        rows = (
            paired_differences(joined, quantities, sampling)
            if joined.height
            else unpaired_differences(first, other, quantities, sampling)
        )
        named = pl.col("quantity").str.splitn(" ", 2).struct.rename_fields(["reader", "item"])
        parts.append(rows.with_columns(named.alias("_of"), run=pl.lit(name)).unnest("_of").select(EMPTY.columns))
    return with_adjusted(pl.concat(parts)), []


def _values(runs: Sequence[Run]) -> Mapping[str, pl.DataFrame]:
    """By run, one row per episode with a column `READER ITEM` for every effect."""
    units = {run.name: units_of_recorded(*run.stores) for run in runs}
    used = np.all([spread.used for spread in units.values()], axis=0)
    if not used.any():
        raise BadArgument("no dimension of the action is compared in all of the runs.")
    found = {
        run.name: recorded_effects(run.question, attention=False, spread=replace(units[run.name], used=used))
        for run in runs
    }
    return {name: _by_episode(effects.episodes()) for name, effects in found.items() if effects is not None}


def _by_episode(episodes: pl.DataFrame) -> pl.DataFrame:
    rows = episodes.filter(pl.col("reader").is_in(_READERS), kind="without")
    named = rows.with_columns(quantity=pl.format("{} {}", "reader", "item"))
    return named.pivot("quantity", index=EPISODE_ID, values="effect")
