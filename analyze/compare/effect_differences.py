"""Differences of recorded effects between runs: what the action depended on in one, and does in the other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

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
from vla_attention.analyze.effects.conditions import Reader
from vla_attention.analyze.effects.effect_study import EffectStudy, study_effects
from vla_attention.analyze.effects.item_rows import item_rows
from vla_attention.analyze.effects.paired_replans import ALL
from vla_attention.analyze.effects.reruns import recorded_conditions
from vla_attention.analyze.measures.frames import EPISODE_ID, LAYERS_AVG
from vla_attention.analyze.statistics.episode_intervals import Sampling
from vla_attention.schemas.errors import BadArgument, listing

#: The readers whose effects are compared; see `conditions.Reader`.
_READERS: tuple[Reader, ...] = ("total", "direct")
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
    having = [run for run in runs if any(recorded_conditions(store) for store in run.stores)]
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
    studies = {run.name: _studies(run) for run in runs}
    used = np.all([study.spread.used for of_run in studies.values() for study in of_run], axis=0)
    if not used.any():
        raise BadArgument("no dimension of the action is compared in all of the runs.")
    dimensions = [int(number) for number in np.flatnonzero(used)]
    if any((study.spread.used != used).any() for of_run in studies.values() for study in of_run):
        studies = {run.name: _studies(run, dimensions) for run in runs}
    return {
        name: pl.concat([_by_episode(study) for study in of_run], how="diagonal") for name, of_run in studies.items()
    }


def _studies(run: Run, dimensions: Sequence[int] | None = None) -> list[EffectStudy]:
    settings = run.question.settings
    return [study_effects(store.path, [], settings, dimensions) for store in run.stores if recorded_conditions(store)]


def _by_episode(study: EffectStudy) -> pl.DataFrame:
    columns = {
        f"{reader} {item.name}": item.by_reader[reader]["condition"]
        for item in item_rows(study)
        for reader in _READERS
        if reader in item.by_reader
    }
    whole = study.episodes.filter(phase=ALL)
    table = whole.select(EPISODE_ID).unique(maintain_order=True)
    for name, condition in columns.items():
        of = whole.filter(condition=condition).select(*EPISODE_ID, pl.col("effect").alias(name))
        table = table.join(of, on=EPISODE_ID, how="left", maintain_order="left")
    return table.select("suite", "task_id", "episode_index", *columns)
