"""Differences between runs: paired where they share initial states and seeds, otherwise between independent episodes.

Two episodes are a pair when suite, task, initial state (by its digest) and seed are equal: the same scene, the same
noise, other weights. Differences within pairs do not contain differences between scenes; their intervals are two-level
bootstraps over tasks and pairs. The first run is what the others are compared with; every difference is other run minus
first run.

Quantities, one value per episode: `log2_ratio` (mean over replans of log2 of the ratio: 1 more is twice the ratio),
`{group}_fraction` (mean over replans), and `success` (0 or 1).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.compare.runs import Run, RunArgument, check_comparable, noted_differences, open_runs
from vla_attention.analyze.measures.aggregate import episode_tables, overall_layer, replans_of
from vla_attention.analyze.measures.frames import LAYERS_AVG, Tables, float_values
from vla_attention.analyze.measures.question_settings import AnalysisSettings
from vla_attention.analyze.statistics.bootstrap import (
    POSITIVE,
    SHARE,
    Resamples,
    bootstrap_intervals,
    ends,
    geometric_mean_over_episodes,
    mean_over_episodes,
    resample_episodes,
)
from vla_attention.analyze.statistics.effect_sizes import contrast
from vla_attention.schemas.groupings.grouping import Grouping

LOG2_RATIO, SUCCESS = "log2_ratio", "success"
#: Two episodes with equal values here are a pair; `occurrence` counts the episodes of a run with the same first state.
PAIR_KEYS = ("suite", "task_id", "initial_state_digest", "seed", "occurrence")


@dataclass(frozen=True)
class Comparison:
    """The results of `compare`.

    Attributes:
        runs: the runs; the others are compared with the first one.
        grouping: groups of the comparison.
        quantities: what is compared, in order.
        estimates: one row per (run, suite, layer, quantity): `num_tasks`, `num_episodes`, `value`, `low`, `high`.
            Quantities are `ratio` (geometric mean), `ratio_lift`, every fraction and `success`. On rows of the ratio
            also `uniform_ratio`, `episodes_without_ratio` (no finite positive ratio in any replan) and `num_nonfinite`
            (replans without a finite ratio).
        differences: one row per (run, scope, layer, quantity) for every run but the first: scope "task", "suite" (only
            when there are several) or "all"; `paired`; `num_pairs`, `num_first`, `num_other`, `num_tasks`;
            `mean_first`, `mean_other`, `difference`, `low`, `high`; `effect` (mean / standard deviation of the paired
            differences, or Hedges' g).
        pairs: one row per (run, pair, layer, quantity): `episode_first`, `episode_other`, `first`, `other`,
            `difference`.
        unpaired: one row per episode that has no partner: `run`, `compared_with`, its suite, task and episode index.
        notes: one line per difference between the runs that was allowed, or that has no effect on the numbers.
    """

    runs: tuple[Run, ...]
    grouping: Grouping
    quantities: tuple[str, ...]
    estimates: pl.DataFrame
    differences: pl.DataFrame
    pairs: pl.DataFrame
    unpaired: pl.DataFrame
    notes: tuple[str, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the runs."""
        return tuple(run.name for run in self.runs)

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
    notes += dict.fromkeys(line for run in runs for line in run.question.remarks)
    grouping = runs[0].question.grouping
    seed = runs[0].question.settings.seed
    levels = [episode_tables(replans_of(run.question), run.question.grouping) for run in runs]
    having = {name for level in levels for name in level.groups_with_mass()}
    filled = [name for name in grouping.names if name in having]
    tables = [_episode_values(run, level, filled, "seed" in allowed) for run, level in zip(runs, levels, strict=True)]
    quantities = ((LOG2_RATIO,) if grouping.ratio else ()) + tuple(f"{name}_fraction" for name in filled) + (SUCCESS,)
    estimates = pl.concat(
        [_estimates(run.name, table, quantities, seed) for run, table in zip(runs, tables, strict=True)]
    )
    differences, pairs, unpaired = [], [], []
    for run, table in zip(runs[1:], tables[1:], strict=True):
        joined = _pair(tables[0], table, quantities)
        pairs.append(_pairs_table(run.name, joined, quantities))
        unpaired += [_without_partner(tables[0], joined, "first", runs[0].name, run.name)]
        unpaired += [_without_partner(table, joined, "other", run.name, runs[0].name)]
        rows = _paired(joined, quantities, seed) if joined.height else _unpaired(tables[0], table, quantities, seed)
        differences.append(rows.select(pl.lit(run.name).alias("run"), pl.all()))
    return Comparison(
        runs=tuple(runs),
        grouping=grouping,
        quantities=quantities,
        estimates=estimates,
        differences=pl.concat(differences),
        pairs=pl.concat(pairs),
        unpaired=pl.concat(unpaired),
        notes=tuple(notes),
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
                item.episode.attributes.initial_state_digest,
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


def _pair(first: pl.DataFrame, other: pl.DataFrame, quantities: Sequence[str]) -> pl.DataFrame:
    """Pairs (pair, layer) with `X_first`, `X_other` and `X_difference`, and both episode indices."""
    # A seed that was allowed to differ is null, and null equals nothing in a join.
    keys = [*(key for key in PAIR_KEYS if key != "seed" or first["seed"].null_count() == 0), "layer"]

    def side(table: pl.DataFrame, name: str, *more: str) -> pl.DataFrame:
        values = (pl.col(quantity).alias(f"{quantity}_{name}") for quantity in quantities)
        return table.select(*keys, *more, pl.col("episode_index").alias(f"episode_{name}"), *values)

    joined = side(first, "first", "instruction", "block").join(side(other, "other"), on=keys, how="inner")
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
    found = joined.select("suite", "task_id", pl.col(f"episode_{side}").alias("episode_index")).unique()
    alone = table.select(keys).unique(maintain_order=True).join(found, on=keys, how="anti", maintain_order="left")
    return alone.select(pl.lit(run).alias("run"), pl.lit(other).alias("compared_with"), pl.all())


def _paired(joined: pl.DataFrame, quantities: Sequence[str], seed: int) -> pl.DataFrame:
    rows: list[dict[str, Any]] = []
    for scope, part in _scopes(joined):
        tasks = _tasks(part)
        resamples = resample_episodes(tasks, seed=seed)
        values = [_numbers(part, f"{quantity}_difference") for quantity in quantities]
        statistics = [mean_over_episodes(value) for value in values]
        intervals = bootstrap_intervals(statistics, resamples)
        for quantity, value, statistic, interval in zip(quantities, values, statistics, intervals, strict=True):
            used = statistic.used
            certain = quantity == SUCCESS and bool(used.any()) and not np.ptp(value[used])
            # Where all pairs end alike, all resamples do too, and the interval would have no width.
            low, high = ends(None if certain else interval)
            rows.append(
                {
                    **scope,
                    "quantity": quantity,
                    "paired": True,
                    "num_tasks": len(set(tasks[used])),
                    "num_pairs": int(used.sum()),
                    "num_first": int(used.sum()),
                    "num_other": int(used.sum()),
                    "mean_first": _mean(_numbers(part, f"{quantity}_first")[used]),
                    "mean_other": _mean(_numbers(part, f"{quantity}_other")[used]),
                    "difference": statistic.value,
                    "low": low,
                    "high": high,
                    "effect": _standardised(value[used]),
                }
            )
    return pl.DataFrame(rows, schema=_DIFFERENCE_SCHEMA)


def _unpaired(first: pl.DataFrame, other: pl.DataFrame, quantities: Sequence[str], seed: int) -> pl.DataFrame:
    """Differences of means of independent episodes.

    Tasks that both runs have are drawn together, others in each run alone.
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
        tasks = _tasks(part)
        if is_other.all() or not is_other.any():
            continue  # a task of one run only
        resamples = _independent_draws(tasks, is_other, seed)
        for quantity in quantities:
            values = _numbers(part, quantity)
            certain = quantity == SUCCESS and not np.ptp(values[is_other]) and not np.ptp(values[~is_other])
            found = contrast(values, is_other, resamples)
            low, high = ends(None if certain else found.difference_interval)
            rows.append(
                {
                    **scope,
                    "quantity": quantity,
                    "paired": False,
                    "num_tasks": len(set(tasks)),
                    "num_pairs": 0,
                    "num_first": found.num_second,
                    "num_other": found.num_first,
                    "mean_first": found.mean_second,
                    "mean_other": found.mean_first,
                    "difference": found.difference,
                    "low": low,
                    "high": high,
                    "effect": found.hedges_g,
                }
            )
    return pl.DataFrame(rows, schema=_DIFFERENCE_SCHEMA)


def _independent_draws(tasks: NDArray[np.int64], is_other: NDArray[np.bool_], seed: int) -> Resamples:
    if set(tasks[is_other]) == set(tasks[~is_other]):
        # Both runs have the same tasks, which are drawn for both at once.
        return resample_episodes(tasks, seed=seed)
    parts = [
        resample_episodes(tasks[member], seed=seed + number) for number, member in enumerate((~is_other, is_other))
    ]
    counts = np.empty((len(parts[0].counts), len(tasks)))
    counts[:, ~is_other], counts[:, is_other] = parts[0].counts, parts[1].counts
    return Resamples(counts, tasks)


_DIFFERENCE_SCHEMA = {
    **dict.fromkeys(("scope", "suite"), pl.String),
    "task_id": pl.Int64,
    **dict.fromkeys(("instruction", "layer"), pl.String),
    "block": pl.Int64,
    "quantity": pl.String,
    "paired": pl.Boolean,
    **dict.fromkeys(("num_tasks", "num_pairs", "num_first", "num_other"), pl.Int64),
    **dict.fromkeys(("mean_first", "mean_other", "difference", "low", "high", "effect"), pl.Float64),
}


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


def _estimates(run: str, table: pl.DataFrame, quantities: Sequence[str], seed: int) -> pl.DataFrame:
    rows = []
    for part in table.partition_by("suite", "layer", maintain_order=True):
        tasks = _tasks(part)
        statistics = {
            ("ratio" if quantity == LOG2_RATIO else quantity): geometric_mean_over_episodes(
                _numbers(part, "log_ratio_mean")
            )
            if quantity == LOG2_RATIO
            else mean_over_episodes(_numbers(part, quantity), SHARE)
            for quantity in quantities
        }
        if LOG2_RATIO in quantities:
            statistics["ratio_lift"] = mean_over_episodes(_numbers(part, "ratio_lift"), POSITIVE)
        names = {"run": run, "suite": part["suite"][0], "layer": part["layer"][0], "block": part["block"][0]}
        counts = {"num_tasks": len(set(tasks)), "num_episodes": part.height}
        intervals = bootstrap_intervals(list(statistics.values()), resample_episodes(tasks, seed=seed))
        for (name, statistic), interval in zip(statistics.items(), intervals, strict=True):
            # Where all episodes end alike, all resamples do too, and the interval would have no width.
            certain = name == SUCCESS and statistic.value in (0.0, 1.0)
            low, high = ends(None if certain else interval)
            row = {**names, **counts, "quantity": name, "value": statistic.value, "low": low, "high": high}
            if name == "ratio":
                row["uniform_ratio"] = mean_over_episodes(_numbers(part, "uniform_ratio")).value
                row["episodes_without_ratio"] = statistic.num_left_out
                row["num_nonfinite"] = int(part["num_nonfinite"].sum())
            rows.append(row)
    return pl.DataFrame(rows, schema=_ESTIMATE_SCHEMA)


_ESTIMATE_SCHEMA = {
    **dict.fromkeys(("run", "suite", "layer"), pl.String),
    **dict.fromkeys(("block", "num_tasks", "num_episodes"), pl.Int64),
    "quantity": pl.String,
    **dict.fromkeys(("value", "low", "high", "uniform_ratio"), pl.Float64),
    **dict.fromkeys(("episodes_without_ratio", "num_nonfinite"), pl.Int64),
}


def _tasks(part: pl.DataFrame) -> NDArray[np.int64]:
    return part.select(pl.struct("suite", "task_id").rank("dense").cast(pl.Int64)).to_series().to_numpy()


def _numbers(part: pl.DataFrame, column: str) -> NDArray[np.float64]:
    return float_values(part[column])


def _mean(values: NDArray[np.float64]) -> float | None:
    return float(values.mean()) if len(values) else None


def _standardised(differences: NDArray[np.float64]) -> float | None:
    """Mean / standard deviation (ddof 1) of paired differences (Cohen 1988, d_z); None without any spread."""
    spread = float(differences.std(ddof=1)) if len(differences) > 1 else 0.0
    return float(differences.mean() / spread) if spread > 0 else None
