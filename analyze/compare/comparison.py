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

import numpy as np
import polars as pl

from vla_attention.analyze.compare.differences import (
    pair_episodes,
    paired_differences,
    unpaired_differences,
    with_adjusted,
)
from vla_attention.analyze.compare.effect_differences import effect_differences
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
from vla_attention.analyze.measures.task_families import sampling_of, units_of
from vla_attention.analyze.statistics.episode_intervals import ABOUT_COLUMNS, Sampling, about_row
from vla_attention.analyze.statistics.intervals import (
    SHARE,
    ends,
    estimates,
    geometric_mean_over_episodes,
    mean_over_episodes,
)
from vla_attention.analyze.statistics.units import Units
from vla_attention.analyze.stores.run_notes import prompt_notes
from vla_attention.schemas.groupings.grouping import Grouping

LOG2_RATIO, SUCCESS = "log2_ratio", "success"


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
        effects: differences of recorded effects, see `effect_differences`.
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
    effects: pl.DataFrame
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
    notes += dict.fromkeys(
        line
        for run in runs
        for line in (*run.question.skipped, *prompt_notes(run.question.episodes), *run.question.notes)
    )
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
        joined = pair_episodes(tables[0], table, quantities)
        if is_rerun(runs[0], run):
            base, again = (concat_tables(replan_tables(one, grouping).parts) for one in (measured[0], of_run))
            sides = with_paired_replans(base, again, run.name)
            first, other = (
                _episode_values(one, episode_tables(side, grouping), filled, False)
                for one, side in zip((runs[0], run), sides, strict=True)
            )
            joined = pair_episodes(first, other, quantities, same_episode=True)
        pairs.append(_pairs_table(run.name, joined, quantities))
        unpaired += [_without_partner(tables[0], joined, "first", runs[0].name, run.name)]
        unpaired += [_without_partner(table, joined, "other", run.name, runs[0].name)]
        rows = (
            paired_differences(joined, quantities, sampling)
            if joined.height
            else unpaired_differences(tables[0], table, quantities, sampling)
        )
        differences.append(rows.select(pl.lit(run.name).alias("run"), pl.all()))
    effects, notes_on_effects = effect_differences(runs, tables, sampling)
    return Comparison(
        runs=tuple(runs),
        effects=effects,
        grouping=grouping,
        quantities=quantities,
        estimates=of_runs,
        differences=with_adjusted(pl.concat(differences)),
        pairs=pl.concat(pairs),
        unpaired=pl.concat(unpaired),
        notes=(*notes, *notes_on_effects),
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


def _pairs_table(run: str, joined: pl.DataFrame, quantities: Sequence[str]) -> pl.DataFrame:
    """The table `Comparison.pairs`, from `pair_episodes`."""
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
