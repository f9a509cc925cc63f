"""Differences of episodes' values between two runs: of pairs, or of means of independent episodes. Pure functions.

A table of a run has one row per (episode, layer) with `PAIR_KEYS`, `instruction`, `episode_index`, `block` (null where
the layer is no single one) and a column per quantity.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import polars as pl

from vla_attention.analyze.measures.frames import LAYERS_AVG, float_values
from vla_attention.analyze.statistics.effect_sizes import contrast, standardised_mean
from vla_attention.analyze.statistics.episode_intervals import ABOUT_COLUMNS, Sampling, about_row
from vla_attention.analyze.statistics.intervals import Estimate, ends, estimates, mean_over_episodes, named_interval
from vla_attention.analyze.statistics.many_looks import adjusted_p_values

#: The effect sizes: of pairs, and of independent episodes.
D_Z, HEDGES_G = "d_z", "hedges_g"
#: Two episodes with equal values here are a pair; `occurrence` counts the episodes of a run with the same first state.
PAIR_KEYS = ("suite", "task_id", "initial_state_digest", "seed", "occurrence")


def pair_episodes(
    first: pl.DataFrame, other: pl.DataFrame, quantities: Sequence[str], same_episode: bool = False
) -> pl.DataFrame:
    """Pairs (pair, layer) with `X_first`, `X_other` and `X_difference`, and both episode indices.

    `same_episode`: the other run is a rerun, whose episodes have the same numbers; it may lack some.
    """
    # A seed that was allowed to differ is null, and null equals nothing in a join.
    keys = [*(key for key in PAIR_KEYS if key != "seed" or first["seed"].null_count() == 0), "layer"]

    def side(table: pl.DataFrame, name: str, *more: str) -> pl.DataFrame:
        values = (pl.col(quantity).alias(f"{quantity}_{name}") for quantity in quantities)
        return table.select(*keys, *more, pl.col("episode_index").alias(f"episode_{name}"), *values)

    mine, theirs = side(first, "first", "instruction", "block"), side(other, "other")
    if same_episode:
        theirs = theirs.drop("occurrence").with_columns(pl.col("episode_other").alias("episode_first"))
        keys = ["episode_first" if key == "occurrence" else key for key in keys]
    joined = mine.join(theirs, on=keys, how="inner")
    return joined.with_columns(
        (pl.col(f"{q}_other") - pl.col(f"{q}_first")).alias(f"{q}_difference") for q in quantities
    ).sort("suite", "task_id", "episode_first", "block", nulls_last=True)


def paired_differences(joined: pl.DataFrame, quantities: Sequence[str], sampling: Sampling) -> pl.DataFrame:
    """Means of the differences of pairs (`pair_episodes`), with the columns of `DIFFERENCE_SCHEMA`."""
    rows: list[dict[str, Any]] = []
    for scope, part in _scopes(joined):
        given = sampling.units(part)
        units = given.decided()
        values = [float_values(part[f"{quantity}_difference"]) for quantity in quantities]
        statistics = [mean_over_episodes(value) for value in values]
        differences = estimates(statistics, units)
        for quantity, value, statistic, one in zip(quantities, values, statistics, differences, strict=True):
            used = statistic.used
            counts = {"num_tasks": units.part(used).num_tasks, **about_row(given)}
            counts |= dict.fromkeys(("num_pairs", "num_first", "num_other"), int(used.sum()))
            sides = {
                f"mean_{side}": estimates(
                    [mean_over_episodes(np.where(used, float_values(part[f"{quantity}_{side}"]), np.nan))], units
                )[0].value
                for side in ("first", "other")
            }
            of = {**scope, "quantity": quantity, "paired": True, **counts, **sides}
            rows.append(of | _difference_row(one) | _effect(D_Z, standardised_mean(value[used], units.part(used))))
    return pl.DataFrame(rows, schema=DIFFERENCE_SCHEMA)


def unpaired_differences(
    first: pl.DataFrame, other: pl.DataFrame, quantities: Sequence[str], sampling: Sampling
) -> pl.DataFrame:
    """Differences of means of independent episodes.

    A task that both runs have moves both means, and its difference has less noise than two different tasks.
    """
    both = pl.concat(
        [
            table.select(*PAIR_KEYS, "instruction", "layer", "block", *quantities, pl.lit(number).alias("_run"))
            for number, table in enumerate((first, other))
        ]
    )
    rows: list[dict[str, Any]] = []
    for scope, part in _scopes(both):
        is_other = part["_run"].to_numpy() == 1
        units = sampling.units(part)
        if is_other.all() or not is_other.any():
            continue  # a task of one run only
        for quantity in quantities:
            difference = contrast(float_values(part[quantity]), is_other, units)
            rows.append(
                {
                    **scope,
                    "quantity": quantity,
                    "paired": False,
                    "num_tasks": units.num_tasks,
                    "num_families": units.num_families,
                    "intervals": difference.estimand.value,
                    "num_pairs": 0,
                    "num_first": difference.num_second,
                    "num_other": difference.num_first,
                    "mean_first": difference.mean_second,
                    "mean_other": difference.mean_first,
                }
                | _difference_row(difference.difference)
                | _effect(HEDGES_G, difference.hedges_g)
            )
    return pl.DataFrame(rows, schema=DIFFERENCE_SCHEMA)


def _difference_row(one: Estimate) -> dict[str, Any]:
    low, high = ends(one.interval())
    return {"difference": one.value, "low": low, "high": high, "p": one.p_value(0.0)}


def _effect(name: str, one: Estimate) -> dict[str, Any]:
    """An effect size with its interval; without an interval, none at all: it would look more certain than it is."""
    interval = one.interval()
    return named_interval(name, None if interval is None else one.value, interval)


DIFFERENCE_SCHEMA = {
    **dict.fromkeys(("scope", "suite"), pl.String),
    "task_id": pl.Int64,
    **dict.fromkeys(("instruction", "layer"), pl.String),
    "block": pl.Int64,
    "quantity": pl.String,
    "paired": pl.Boolean,
    "num_tasks": pl.Int64,
    **ABOUT_COLUMNS,
    **dict.fromkeys(("num_pairs", "num_first", "num_other"), pl.Int64),
    **dict.fromkeys(("mean_first", "mean_other", "difference", "low", "high", "p"), pl.Float64),
    **{f"{name}{end}": pl.Float64 for name in (D_Z, HEDGES_G) for end in ("", "_low", "_high")},
}


def with_adjusted(differences: pl.DataFrame) -> pl.DataFrame:
    """The columns `q` and `layers_q` of `Comparison.differences`."""
    whole, single = pl.col("scope") == "all", pl.col("layer") != LAYERS_AVG
    looks = (
        ("q", pl.col("scope") == "task", ("run", "layer", "quantity")),
        ("q", pl.col("scope") != "task", ("run", "scope", "suite", "layer")),
        ("layers_q", whole & single, ("run", "quantity")),
    )
    numbered = differences.with_columns(pl.int_range(pl.len()).alias("_row"))
    columns: dict[str, list[float | None]] = {"q": [None] * numbered.height, "layers_q": [None] * numbered.height}
    for name, which, family in looks:
        for part in numbered.filter(which).partition_by(family, maintain_order=True):
            for row, q in zip(part["_row"], adjusted_p_values(part["p"].to_list()), strict=True):
                columns[name][row] = q
    return differences.with_columns(pl.Series(name, q, dtype=pl.Float64) for name, q in columns.items())


def _scopes(table: pl.DataFrame) -> list[tuple[dict[str, Any], pl.DataFrame]]:
    """Every (task, layer), every (suite, layer) when there are several suites, then every layer over all tasks."""
    scopes = []
    for part in table.partition_by("suite", "task_id", "layer", maintain_order=True):
        row = part.row(0, named=True)
        names = {name: row[name] for name in ("suite", "task_id", "instruction", "layer", "block")}
        scopes.append(({"scope": "task", **names}, part))
    only = table["suite"][0] if table["suite"].n_unique() == 1 else None
    wider = [("all", only, part) for part in table.partition_by("layer", maintain_order=True)]
    if only is None:
        of_suites = table.partition_by("suite", "layer", maintain_order=True)
        wider = [("suite", part["suite"][0], part) for part in of_suites] + wider
    for scope, suite, part in wider:
        names = {"suite": suite, "task_id": None, "instruction": None}
        scopes.append(({"scope": scope, **names, "layer": part["layer"][0], "block": part["block"][0]}, part))
    return scopes
