"""From steps to replans, episodes and tasks: tables in polars. Formulas are in the docstrings, statistics in `statistics`.

    steps      one row per (episode, replan, layer, denoise step[, head])       from `tables`
    replans    one row per (episode, replan, layer or "layers_avg")             `per_replan`, `add_layers_avg`
    episodes   one row per (episode, layer or "layers_avg")                     `episodes_table`
    tasks      one row per (task or all tasks, layer or "layers_avg")           `tasks_table`

From replans on, `layer` is a string (the number that the user typed, or "layers_avg") and `layer_number` the number, null for
the average. Non-finite ratios are never dropped silently: every table has a column that counts them.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.statistics.bootstrap import (
    DEFAULT_LEVEL,
    DEFAULT_RESAMPLES,
    DEFAULT_SEED,
    POSITIVE,
    SHARE,
    EpisodeStatistic,
    Resamples,
    geometric_mean_over_episodes,
    mean_over_episodes,
    ratio_of_means_over_episodes,
    resample_episodes,
    summarize,
    values_with_intervals,
)
from vla_attention.schemas.groupings.grouping import Grouping

LAYERS_AVG = "layers_avg"
#: What makes an episode one; the rest of these columns is constant inside it.
EPISODE_KEYS = ("suite", "task_id", "instruction", "episode_index", "success", "num_steps")
_REPLAN_KEYS = (*EPISODE_KEYS, "replan", "env_step")
_LAYER_KEYS = ("layer", "layer_number", "block")
_TASK = "_task_of_suite"


def per_replan(steps: pl.DataFrame, grouping: Grouping) -> pl.DataFrame:
    """Average over denoise steps and heads: mean of the masses, then fractions, lifts and ratio from those means.

    The number of keys and the uniform ratio do not depend on denoise step and head and are taken over. Adds
    `nonfinite_layers`, 1 where the ratio is infinite or undefined (when the grouping has a ratio).
    """
    masses = [
        *_mass_columns(grouping),
        "row_sum",
        "valid_mass",
        "num_valid",
        *(f"{name}_keys" for name in grouping.names),
    ]
    constant = ["uniform_ratio"] if grouping.ratio else []
    averaged = (
        steps.with_columns(pl.col("layer").alias("layer_number"), pl.col("layer").cast(pl.String))
        .group_by(*_REPLAN_KEYS, *_LAYER_KEYS)
        .agg(*(pl.col(column).mean() for column in masses), *(pl.col(column).first() for column in constant))
    )
    if grouping.ratio:
        averaged = averaged.with_columns(
            _quotient(pl.col("numerator_mass"), pl.col("denominator_mass")).alias("ratio")
        ).with_columns((~_is_finite("ratio")).cast(pl.Int64).alias("nonfinite_layers"))
    return _sorted(_with_derived(averaged, grouping), "replan")


def add_layers_avg(replans: pl.DataFrame, grouping: Grouping) -> pl.DataFrame:
    """Append one row per replan with `layer` = "layers_avg", as the published scripts define it.

    Masses are means over the layers; the ratio is the mean of the layers' finite ratios (null when none is finite; the published
    scripts write 0 there); fractions and lifts come from the averaged masses. `nonfinite_layers` counts the layers left out.
    """
    means = [
        *_mass_columns(grouping),
        "row_sum",
        "valid_mass",
        "num_valid",
        *(f"{name}_keys" for name in grouping.names),
    ]
    ratio = (
        [
            pl.col("uniform_ratio").first(),
            _finite("ratio").mean().alias("ratio"),
            pl.col("nonfinite_layers").sum(),
        ]
        if grouping.ratio
        else []
    )
    # A block that was named both ways (as 8 and as the recorded call 26) is one layer, not two.
    average = (
        replans.unique([*_REPLAN_KEYS, "block"], keep="first", maintain_order=True)
        .group_by(*_REPLAN_KEYS)
        .agg(*(pl.col(column).mean() for column in means), *ratio)
        .with_columns(
            pl.lit(LAYERS_AVG).alias("layer"),
            pl.lit(None, dtype=replans.schema["layer_number"]).alias("layer_number"),
            pl.lit(None, dtype=replans.schema["block"]).alias("block"),
        )
    )
    return _sorted(pl.concat([replans, _with_derived(average, grouping).select(replans.columns)]), "replan")


def episodes_table(replans: pl.DataFrame, grouping: Grouping) -> pl.DataFrame:
    """One row per (episode, layer), over the episode's replans.

    Columns, beside the episode's and the layer's: `num_replans`; `row_sum`, `num_valid`; per group `{g}_mass`, `{g}_mass_std`,
    `{g}_fraction`, `{g}_fraction_std`, `{g}_keys`, `{g}_density`, `{g}_lift` (means; std with ddof 0). With a ratio also
        ratio_mean, ratio_std, ratio_median, ratio_min, ratio_max   over the finite ratios
        ratio_of_means    mean numerator mass / mean denominator mass
        geometric_mean    exp(log_ratio_mean), log_ratio_mean = mean log ratio over finite positive ratios
        num_nonfinite     replans whose ratio is infinite or undefined
        geometric_left_out  replans whose ratio has no finite logarithm (not finite, or 0)
        nonfinite_layers  sum over replans of the layers left out of "layers_avg"
        uniform_ratio     mean of the ratios that uniform attention would give
        ratio_lift        mean over replans of ratio / uniform_ratio, finite ones
    """
    columns = [pl.len().cast(pl.Int64).alias("num_replans"), pl.col("row_sum").mean(), pl.col("num_valid").mean()]
    for name in grouping.names:
        for kind in ("mass", "fraction"):
            column = pl.col(f"{name}_{kind}")
            columns += [column.mean(), column.std(ddof=0).alias(f"{name}_{kind}_std")]
        columns += [pl.col(f"{name}_keys").mean(), pl.col(f"{name}_density").mean()]
        columns += [_finite(f"{name}_lift").mean().alias(f"{name}_lift")]
    if grouping.ratio:
        ratio = _finite("ratio")
        columns += [
            pl.col("numerator_mass").mean(),
            pl.col("denominator_mass").mean(),
            ratio.mean().alias("ratio_mean"),
            ratio.std(ddof=0).alias("ratio_std"),
            ratio.median().alias("ratio_median"),
            ratio.min().alias("ratio_min"),
            ratio.max().alias("ratio_max"),
            _quotient(pl.col("numerator_mass").mean(), pl.col("denominator_mass").mean()).alias("ratio_of_means"),
            (_finite("log2_ratio").mean() * np.log(2.0)).alias("log_ratio_mean"),
            (~_is_finite("ratio")).sum().cast(pl.Int64).alias("num_nonfinite"),
            (~_is_finite("log2_ratio")).sum().cast(pl.Int64).alias("geometric_left_out"),
            pl.col("nonfinite_layers").sum(),
            _finite("uniform_ratio").mean().alias("uniform_ratio"),
            _finite("ratio_lift").mean().alias("ratio_lift"),
        ]
    table = replans.group_by(*EPISODE_KEYS, *_LAYER_KEYS).agg(*columns)
    if grouping.ratio:
        table = table.with_columns(pl.col("log_ratio_mean").exp().alias("geometric_mean"))
    return _sorted(table)


def tasks_table(
    episodes: pl.DataFrame,
    grouping: Grouping,
    num_resamples: int = DEFAULT_RESAMPLES,
    level: float = DEFAULT_LEVEL,
    seed: int = DEFAULT_SEED,
) -> pl.DataFrame:
    """One row per (task, layer) and, over tasks, rows with `task_id` null. Episodes are the unit and weigh the same.

    `scope` is "task", "all" (every task of one suite) or "combined" (every suite; only when there are several).
    `X_low` and `X_high` bound the interval of X (see `statistics`): over episodes inside a task, two-level over tasks; null
    with fewer than two episodes. X is each of `{g}_fraction` and, with a ratio, `ratio_mean`, `ratio_of_means`, `geometric_mean`
    and `ratio_lift`. `ratio_std`, `ratio_median`, `ratio_min`, `ratio_max` are over the episodes' mean ratios.
    `episodes_without_ratio` counts episodes without a single finite ratio; the counts of `episodes_table` are summed.
    """
    # NaN instead of null, once: there can be thousands of (task, layer) pairs, and numpy knows no null.
    episodes = _sorted(episodes).with_columns(pl.col(pl.Float64).fill_null(float("nan")))
    # Task ids repeat between suites; a task is a pair of both.
    episodes = episodes.with_columns(pl.struct("suite", "task_id").rank("dense").cast(pl.Int64).alias(_TASK))
    rows = []
    for part, scope in _scopes(episodes):
        draws = resample_episodes(part[_TASK].to_numpy(), num_resamples, seed)
        rows.append({**scope, **_task_row(part, grouping, draws, level)})
    table = pl.DataFrame(rows, schema_overrides=_task_schema(grouping), infer_schema_length=None)
    order = pl.col("scope").replace_strict({"task": 0, "all": 1, "combined": 2}, return_dtype=pl.Int64)
    return table.sort(
        pl.col("suite").is_null(), "suite", order, "task_id", "layer_number", nulls_last=True, maintain_order=True
    )


def layer_order(table: pl.DataFrame) -> list[str]:
    """The layers of any of these tables by number, "layers_avg" last."""
    layers = table.select("layer", "layer_number").unique().sort("layer_number", "layer", nulls_last=True)
    return layers["layer"].to_list()


def overall_layer(table: pl.DataFrame) -> str:
    """The layer that speaks for the whole: "layers_avg" where there is one, else the first layer."""
    layers = layer_order(table)
    return LAYERS_AVG if LAYERS_AVG in layers else layers[0]


def overall_rows(tasks: pl.DataFrame) -> pl.DataFrame:
    """The rows of `tasks_table` over everything, one per layer: all suites when there are several, else the suite."""
    scope = "combined" if (tasks["scope"] == "combined").any() else "all"
    return tasks.filter(pl.col("scope") == scope)


def _scopes(episodes: pl.DataFrame) -> Iterable[tuple[pl.DataFrame, dict[str, object]]]:
    several = episodes["suite"].n_unique() > 1
    for (layer,), of_layer in episodes.partition_by("layer", as_dict=True, maintain_order=True).items():
        first = of_layer.row(0, named=True)
        names = {"layer": layer, "layer_number": first["layer_number"], "block": first["block"]}
        for (suite,), of_suite in of_layer.partition_by("suite", as_dict=True, maintain_order=True).items():
            for (task,), part in of_suite.partition_by("task_id", as_dict=True, maintain_order=True).items():
                known = {"scope": "task", "suite": suite, "task_id": task, "instruction": part["instruction"][0]}
                yield part, {**known, **names}
            yield of_suite, {"scope": "all", "suite": suite, "task_id": None, "instruction": None, **names}
        if several:
            yield of_layer, {"scope": "combined", "suite": None, "task_id": None, "instruction": None, **names}


def _task_row(
    part: pl.DataFrame, grouping: Grouping, resamples: Resamples, level: float
) -> dict[str, float | int | None]:
    def values(column: str) -> NDArray[np.float64]:
        return part[column].to_numpy()

    row: dict[str, float | int | None] = {
        "num_tasks": len(np.unique(values(_TASK))),
        "num_episodes": part.height,
        "num_replans": int(part["num_replans"].sum()),
        "success_rate": float(part["success"].to_numpy().mean()),
    }
    bounded: dict[str, EpisodeStatistic] = {}
    plain = [f"{name}_{kind}" for name in grouping.names for kind in ("mass", "keys", "density", "lift")]
    for name in grouping.names:
        bounded[f"{name}_fraction"] = mean_over_episodes(values(f"{name}_fraction"), SHARE)
    if grouping.ratio:
        plain += ["numerator_mass", "denominator_mass", "uniform_ratio"]
        spread = summarize(values("ratio_mean"))
        row |= {f"ratio_{name}": getattr(spread, name) for name in ("std", "median", "min", "max")}
        row["episodes_without_ratio"] = spread.num_nonfinite
        row |= {name: int(part[name].sum()) for name in ("num_nonfinite", "geometric_left_out", "nonfinite_layers")}
        bounded["ratio_mean"] = mean_over_episodes(values("ratio_mean"), POSITIVE)
        bounded["ratio_of_means"] = ratio_of_means_over_episodes(values("numerator_mass"), values("denominator_mass"))
        bounded["geometric_mean"] = geometric_mean_over_episodes(values("log_ratio_mean"))
        bounded["ratio_lift"] = mean_over_episodes(values("ratio_lift"), POSITIVE)
    row |= dict(zip(plain, _finite_means(part.select(plain).to_numpy()), strict=True))
    return row | values_with_intervals(bounded, resamples, level)


def _finite_means(columns: NDArray[np.float64]) -> list[float | None]:
    """Mean over the finite values of each column of (episode, column); None without any."""
    finite = np.isfinite(columns)
    sums, counts = np.where(finite, columns, 0.0).sum(axis=0), finite.sum(axis=0)
    return [float(total / count) if count else None for total, count in zip(sums, counts, strict=True)]


def _task_schema(grouping: Grouping) -> dict[str, type[pl.DataType]]:
    """Types of the columns that may hold nothing but null."""
    floats = [f"{name}_{kind}" for name in grouping.names for kind in ("mass", "keys", "density", "lift")]
    bounded = [f"{name}_fraction" for name in grouping.names]
    if grouping.ratio:
        floats += ["ratio_std", "ratio_median", "ratio_min", "ratio_max"]
        floats += ["numerator_mass", "denominator_mass", "uniform_ratio"]
        bounded += ["ratio_mean", "ratio_of_means", "geometric_mean", "ratio_lift"]
    floats += [f"{name}{end}" for name in bounded for end in ("", "_low", "_high")]
    integers = ["task_id", "layer_number", "block"]
    strings = ["scope", "suite", "instruction", "layer"]
    return {
        **dict.fromkeys(strings, pl.String),
        **dict.fromkeys(integers, pl.Int64),
        **dict.fromkeys(floats, pl.Float64),
    }


def _mass_columns(grouping: Grouping) -> list[str]:
    return [f"{name}_mass" for name in grouping.names] + (
        ["numerator_mass", "denominator_mass"] if grouping.ratio else []
    )


def _with_derived(table: pl.DataFrame, grouping: Grouping) -> pl.DataFrame:
    """Add fractions, densities and lifts from masses and keys; `ratio_lift` and `log2_ratio` from `ratio`.

    fraction = mass / sum of all groups' masses; density = mass / keys; lift = density / (valid_mass / num_valid); null where
    0 / 0, and density and lift null without keys.
    """
    total = pl.sum_horizontal(f"{name}_mass" for name in grouping.names)
    uniform = pl.col("valid_mass") / pl.col("num_valid")
    columns = []
    for name in grouping.names:
        mass, keys = pl.col(f"{name}_mass"), pl.col(f"{name}_keys")
        columns.append(_quotient(mass, total).alias(f"{name}_fraction"))
        columns.append(pl.when(keys > 0).then(_quotient(mass, keys)).alias(f"{name}_density"))
        columns.append(pl.when(keys > 0).then(_quotient(mass / keys, uniform)).alias(f"{name}_lift"))
    if grouping.ratio:
        columns.append(_quotient(pl.col("ratio"), pl.col("uniform_ratio")).alias("ratio_lift"))
        columns.append(pl.col("ratio").log(2.0).alias("log2_ratio"))
    return table.with_columns(*columns)


def _quotient(above: pl.Expr, below: pl.Expr) -> pl.Expr:
    """above / below; +inf over zero, null for 0 / 0."""
    return (above / below).fill_nan(None)


def _is_finite(column: str) -> pl.Expr:
    return pl.col(column).is_finite().fill_null(False)


def _finite(column: str) -> pl.Expr:
    return pl.col(column).filter(_is_finite(column))


def _sorted(table: pl.DataFrame, *further: str) -> pl.DataFrame:
    """In the order of identity, so that nothing downstream depends on the order in which episodes were read."""
    return table.sort("suite", "task_id", "episode_index", *further, "layer_number", nulls_last=True)
