"""Differences between runs: paired where they share initial states and seeds, otherwise between independent episodes.

Two episodes are a pair when suite, task, initial state (by its digest) and seed are equal: the same scene, the same
noise, other weights. Differences within pairs do not contain differences between scenes. The first run is what the
others are compared with; every difference is other run minus first run.

A rerun of the first run (`vla-capture rerun`) repeats its policy calls: it pairs by episode and replan, and ratios are
compared in the replans where both have one.

Quantities, one value per episode: `log2_ratio` (mean over replans of log2 of the ratio: 1 more is twice the ratio),
`{group}_fraction` (mean over replans), and `success` (0 or 1).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import polars as pl

from vla_attention.analyze.compare.replan_pairs import intervention_notes, is_rerun, with_paired_replans
from vla_attention.analyze.compare.runs import Run, RunArgument, check_comparable, noted_differences, open_runs
from vla_attention.analyze.measures.aggregate import (
    baseline_logs,
    episode_tables,
    episode_tables_of,
    overall_layer,
    replan_tables,
)
from vla_attention.analyze.measures.frames import LAYERS_AVG, Tables, concat_tables, float_values
from vla_attention.analyze.measures.question_settings import AnalysisSettings
from vla_attention.analyze.measures.steps import measure_episodes
from vla_attention.analyze.measures.task_families import relation_remarks, sampling_of, units_of
from vla_attention.analyze.statistics.effect_sizes import contrast, standardised_mean
from vla_attention.analyze.statistics.episode_intervals import ABOUT_COLUMNS, Sampling, about_row
from vla_attention.analyze.statistics.intervals import (
    SHARE,
    Estimate,
    ends,
    estimates,
    geometric_mean_over_episodes,
    mean_over_episodes,
    named_interval,
)
from vla_attention.analyze.statistics.many_looks import adjusted_p_values
from vla_attention.analyze.statistics.units import Units
from vla_attention.schemas.groupings.grouping import Grouping

LOG2_RATIO, SUCCESS = "log2_ratio", "success"
#: The effect sizes: of pairs, and of independent episodes.
D_Z, HEDGES_G = "d_z", "hedges_g"
#: Two episodes with equal values here are a pair; `occurrence` counts the episodes of a run with the same first state.
PAIR_KEYS = ("suite", "task_id", "initial_state_digest", "seed", "occurrence")


@dataclass(frozen=True)
class Comparison:
    """The results of `compare`.

    Attributes:
        runs: the runs; the others are compared with the first one.
        grouping: groups of the comparison.
        quantities: what is compared, in order.
        estimates: one row per (run, suite, layer, quantity): `num_tasks`, `num_families`, `intervals` (what they are
            about), `num_episodes`, `value`, `low`, `high`. Quantities are `ratio` (geometric mean), `ratio_lift`, every
            fraction and `success`. On rows of the ratio also `uniform_ratio`, `episodes_without_ratio` (no finite
            positive ratio in any replan) and `num_nonfinite` (replans without a finite ratio).
        differences: one row per (run, scope, layer, quantity) for every run but the first: scope "task", "suite" (only
            when there are several) or "all"; `paired`; `num_pairs`, `num_first`, `num_other`, `num_tasks`,
            `num_families`, `intervals`; `mean_first`, `mean_other`, `difference`, `low`, `high`, `p` (of no
            difference). From five pairs on `d_z` (mean / standard deviation of the paired differences, corrected for
            small samples), of independent episodes `hedges_g`, each with `_low` and `_high`. `q` is p adjusted
            (Benjamini-Hochberg): of a task over the tasks, of a suite or of all over the quantities; `layers_q` over
            the single layers.
        pairs: one row per (run, pair, layer, quantity): `episode_first`, `episode_other`, `first`, `other`,
            `difference`.
        unpaired: one row per episode that has no partner: `run`, `compared_with`, its suite, task and episode index.
        notes: one line per difference between the runs that was allowed, or that has no effect on the numbers.
        units: what intervals over all tasks are about.
        ignores_seed: whether episodes of different seeds may be pairs.
    """

    runs: tuple[Run, ...]
    grouping: Grouping
    quantities: tuple[str, ...]
    estimates: pl.DataFrame
    differences: pl.DataFrame
    pairs: pl.DataFrame
    unpaired: pl.DataFrame
    notes: tuple[str, ...]
    units: Units
    ignores_seed: bool = False

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the runs."""
        return tuple(run.name for run in self.runs)

    @property
    def reruns(self) -> tuple[str, ...]:
        """The runs that repeat the policy calls of the first one: they pair replan by replan."""
        return tuple(run.name for run in self.runs[1:] if is_rerun(self.runs[0], run))

    @property
    def overall_layer(self) -> str:
        """The layer that numbers over all tasks are about, see `aggregate.overall_layer`."""
        return overall_layer(self.estimates.select("layer", pl.col("block").alias("layer_number")))

    @property
    def runs_with_common_tasks(self) -> tuple[str, ...]:
        """The runs that have a task in common with the first one."""
        known = set(self.differences.filter(pl.col("scope") == "task")["run"])
        return tuple(name for name in self.names if name in known)


def compare_stores(
    arguments: Sequence[RunArgument], settings: AnalysisSettings, allowed: Sequence[str] = ()
) -> Comparison:
    """Open runs (`runs.open_runs`) and compare every one with the first (`compare`)."""
    return compare(open_runs(arguments, settings, allowed), allowed)


def compare(runs: Sequence[Run], allowed: Sequence[str] = ()) -> Comparison:
    """Compare every run with the first one.

    Args:
        runs: two or more, see `runs.open_runs`.
        allowed: fields that may differ, see `runs.check_comparable`.

    Raises:
        MixedPolicies, RunsDiffer: see `runs.check_comparable`.
    """
    notes = [*check_comparable(runs, allowed), *noted_differences(runs)]
    notes += [line for run in runs[1:] for line in intervention_notes(runs[0], run)]
    notes += dict.fromkeys(line for run in runs for line in (*run.question.skipped, *run.question.notes))
    grouping = runs[0].question.grouping
    selected = [item for run in runs for item in run.question.selected]
    sampling = sampling_of(runs[0].question.settings.intervals, selected)
    measured = [measure_episodes(run.question) for run in runs]
    levels = [episode_tables_of(of_run, grouping) for of_run in measured]
    having = {name for level in levels for name in level.groups_with_mass()}
    filled = [name for name in grouping.names if name in having]
    tables = [_episode_values(run, level, filled, "seed" in allowed) for run, level in zip(runs, levels, strict=True)]
    quantities = ((LOG2_RATIO,) if grouping.ratio else ()) + tuple(f"{name}_fraction" for name in filled) + (SUCCESS,)
    of_runs = pl.concat(
        [_estimates(run.name, table, quantities, sampling) for run, table in zip(runs, tables, strict=True)]
    )
    differences, pairs, unpaired = [], [], []
    for run, table, of_run in zip(runs[1:], tables[1:], measured[1:], strict=True):
        joined = _pair(tables[0], table, quantities)
        if is_rerun(runs[0], run):
            base, again = (concat_tables(replan_tables(one, grouping).parts) for one in (measured[0], of_run))
            sides = with_paired_replans(base, again, run.name)
            first, other = (
                _episode_values(one, episode_tables(side, grouping), filled, False)
                for one, side in zip((runs[0], run), sides, strict=True)
            )
            joined = _pair(first, other, quantities, same_episode=True)
        pairs.append(_pairs_table(run.name, joined, quantities))
        unpaired += [_without_partner(tables[0], joined, "first", runs[0].name, run.name)]
        unpaired += [_without_partner(table, joined, "other", run.name, runs[0].name)]
        rows = (
            _paired(joined, quantities, sampling)
            if joined.height
            else _unpaired(tables[0], table, quantities, sampling)
        )
        differences.append(rows.select(pl.lit(run.name).alias("run"), pl.all()))
    return Comparison(
        runs=tuple(runs),
        grouping=grouping,
        quantities=quantities,
        estimates=of_runs,
        differences=_with_adjusted(pl.concat(differences)),
        pairs=pl.concat(pairs),
        unpaired=pl.concat(unpaired),
        notes=(*notes, *relation_remarks(sampling, selected)),
        units=units_of(sampling, selected).decided(),
        ignores_seed="seed" in allowed and len({run.stores[0].attributes.protocol.seed for run in runs}) > 1,
    )


def _episode_values(run: Run, episodes: Tables, groups: Sequence[str], ignore_seed: bool) -> pl.DataFrame:
    """One row per (episode, layer) with a column per quantity, and what pairs it; layers are named as block numbers."""
    question = run.question
    table = episodes.cells.with_columns(
        episodes.of_group(name)["fraction"].alias(f"{name}_fraction") for name in groups
    )
    origin = pl.DataFrame(
        [
            (
                item.store.suite,
                item.episode.attributes.task_id,
                item.episode.attributes.episode_index,
                item.episode.attributes.initial_state,
                # With another seed allowed, episodes pair by their initial state alone.
                None if ignore_seed else item.store.attributes.protocol.seed,
            )
            for item in question.selected
        ],
        schema={
            "suite": pl.String,
            "task_id": pl.Int64,
            "episode_index": pl.Int64,
            "initial_state_digest": pl.String,
            "seed": pl.Int64,
        },
        orient="row",
    ).with_columns(
        pl.col("episode_index")
        .rank("ordinal")
        .over("suite", "task_id", "initial_state_digest", "seed")
        .alias("occurrence")
    )
    # Two runs may name one block by different numbers (7 and 25): layers are compared by block.
    table = table.with_columns(
        pl.when(pl.col("layer") == LAYERS_AVG)
        .then(pl.lit(LAYERS_AVG))
        .otherwise(pl.col("block").cast(pl.String))
        .alias("layer"),
        pl.col("success").cast(pl.Float64),
    ).unique(["suite", "task_id", "episode_index", "layer"], keep="first", maintain_order=True)
    if question.grouping.ratio:
        table = table.with_columns((pl.col("log_ratio_mean") / np.log(2.0)).alias(LOG2_RATIO))
    return table.join(origin, on=["suite", "task_id", "episode_index"], how="left").sort(
        "suite", "task_id", "episode_index", "block", nulls_last=True
    )


def _pair(
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


def _pairs_table(run: str, joined: pl.DataFrame, quantities: Sequence[str]) -> pl.DataFrame:
    """The table `Comparison.pairs`, from `_pair`."""
    values = {f"{quantity}_{end}" for quantity in quantities for end in ("first", "other", "difference")}
    identity = [name for name in joined.columns if name not in values]
    parts = [
        joined.select(
            pl.lit(run).alias("run"),
            *identity,
            pl.lit(quantity).alias("quantity"),
            *(pl.col(f"{quantity}_{end}").alias(end) for end in ("first", "other", "difference")),
        )
        for quantity in quantities
    ]
    return pl.concat(parts)


def _without_partner(table: pl.DataFrame, joined: pl.DataFrame, side: str, run: str, other: str) -> pl.DataFrame:
    keys = ["suite", "task_id", "episode_index"]
    paired = joined.select("suite", "task_id", pl.col(f"episode_{side}").alias("episode_index")).unique()
    alone = table.select(keys).unique(maintain_order=True).join(paired, on=keys, how="anti", maintain_order="left")
    return alone.select(pl.lit(run).alias("run"), pl.lit(other).alias("compared_with"), pl.all())


def _paired(joined: pl.DataFrame, quantities: Sequence[str], sampling: Sampling) -> pl.DataFrame:
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
    return pl.DataFrame(rows, schema=_DIFFERENCE_SCHEMA)


def _unpaired(first: pl.DataFrame, other: pl.DataFrame, quantities: Sequence[str], sampling: Sampling) -> pl.DataFrame:
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
    return pl.DataFrame(rows, schema=_DIFFERENCE_SCHEMA)


def _difference_row(one: Estimate) -> dict[str, Any]:
    low, high = ends(one.interval())
    return {"difference": one.value, "low": low, "high": high, "p": one.p_value(0.0)}


def _effect(name: str, one: Estimate) -> dict[str, Any]:
    """An effect size with its interval; without an interval, none at all: it would look more certain than it is."""
    interval = one.interval()
    return named_interval(name, None if interval is None else one.value, interval)


_DIFFERENCE_SCHEMA = {
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


def _with_adjusted(differences: pl.DataFrame) -> pl.DataFrame:
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


def _estimates(run: str, table: pl.DataFrame, quantities: Sequence[str], sampling: Sampling) -> pl.DataFrame:
    rows = []
    for part in table.partition_by("suite", "layer", maintain_order=True):
        units = sampling.units(part)
        statistics = {
            ("ratio" if quantity == LOG2_RATIO else quantity): geometric_mean_over_episodes(
                float_values(part["log_ratio_mean"])
            )
            if quantity == LOG2_RATIO
            else mean_over_episodes(float_values(part[quantity]), SHARE)
            for quantity in quantities
        }
        if LOG2_RATIO in quantities:
            statistics["ratio_lift"] = geometric_mean_over_episodes(np.log(float_values(part["ratio_lift"])))
        names = {"run": run, "suite": part["suite"][0], "layer": part["layer"][0], "block": part["block"][0]}
        counts = {"num_tasks": units.num_tasks, **about_row(units), "num_episodes": part.height}
        values = estimates(list(statistics.values()), units.decided())
        for (name, statistic), one in zip(statistics.items(), values, strict=True):
            low, high = ends(one.interval())
            row = {**names, **counts, "quantity": name, "value": one.value, "low": low, "high": high}
            if name == "ratio":
                logs = baseline_logs(float_values(part["uniform_ratio"]), float_values(part["log_ratio_mean"]))
                baseline = geometric_mean_over_episodes(logs)
                row["uniform_ratio"] = estimates([baseline], units)[0].value
                row["episodes_without_ratio"] = statistic.num_left_out
                row["num_nonfinite"] = int(part["num_nonfinite"].sum())
            rows.append(row)
    return pl.DataFrame(rows, schema=_ESTIMATE_SCHEMA)


_ESTIMATE_SCHEMA = {
    **dict.fromkeys(("run", "suite", "layer"), pl.String),
    **dict.fromkeys(("block", "num_tasks"), pl.Int64),
    **ABOUT_COLUMNS,
    "num_episodes": pl.Int64,
    "quantity": pl.String,
    **dict.fromkeys(("value", "low", "high", "uniform_ratio"), pl.Float64),
    **dict.fromkeys(("episodes_without_ratio", "num_nonfinite"), pl.Int64),
}
