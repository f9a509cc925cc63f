"""From steps to replans, episodes and tasks. Every level is a pair of tables (`frames.Tables`): cells and groups.

    level      a row of `cells` is                                        made by
    steps      (episode, replan, layer, denoise step[, head])             `steps.step_tables`
    replans    (episode, replan, layer or "layers_avg")                   `replan_tables`
    episodes   (episode, layer or "layers_avg")                           `episodes.episode_tables`
    tasks      (task, all tasks or all suites; layer or "layers_avg")     `task_tables`

From replans on, `layer` is a string (the number that the user typed, or "layers_avg") and `layer_number` the number,
null for the average. Ratios that are not finite are never dropped silently: every table has a column that counts them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.measures.episodes import (
    LAYER_KEYS,
    logs_of,
    replan_values,
    sorted_by_episode,
)
from vla_attention.analyze.measures.episodes import episode_tables as episode_tables
from vla_attention.analyze.measures.episodes import episode_tables_of as episode_tables_of
from vla_attention.analyze.measures.frames import (
    EPISODE_ID,
    EPISODE_KEYS,
    LAYERS_AVG,
    LayerAxis,
    Tables,
    float_values,
    long_table,
    replan_axis,
    tables_of_each,
)
from vla_attention.analyze.measures.masses import GROUP_MEASURES
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.measures.steps import MeasuredEpisode, in_order_of_episodes, measure_episodes
from vla_attention.analyze.statistics.episode_intervals import ABOUT_COLUMNS, Sampling, about_row
from vla_attention.analyze.statistics.intervals import (
    DEFAULT_LEVEL,
    POSITIVE,
    SHARE,
    EpisodeStatistic,
    estimates,
    geometric_mean_over_episodes,
    mean_over_episodes,
    means_over_tasks,
    named_interval,
    ratio_of_means_over_episodes,
)
from vla_attention.analyze.statistics.summaries import summarize_rows
from vla_attention.analyze.statistics.units import Units
from vla_attention.schemas.groupings.grouping import Grouping

#: The ratio that texts and pictures show first: with few episodes and strong spread, its interval alone covers the
#: truth as often as its level says (docs/benchmarks.md).
HEADLINE = "geometric_mean"


def replans_of(question: Question) -> Tables:
    """Measure a question's episodes and average them per replan; see `replan_tables`."""
    return replan_tables(measure_episodes(question), question.grouping)


def replan_tables(measured: Sequence[MeasuredEpisode], grouping: Grouping) -> Tables:
    """Every (episode, replan, layer), in the order of suite, task and episode.

    Masses are averaged over denoise steps and heads first; fractions, lifts and ratios follow from these means.

    In "layers_avg", as the published scripts define it, masses are means over the layers, fractions and lifts of groups
    follow from these means. `ratio` is the one ratio of a replan that texts, pictures and the viewer show: the
    geometric mean of the layers' finite positive ratios (the inverse ratio has the inverse mean), so that `ratio_lift`
    is ratio / uniform_ratio and `log2_ratio` its logarithm. `ratio_mean` is the mean of the layers' finite ratios (null
    when none is finite; the published scripts write 0 there).

    Returns:
        cells: `EPISODE_KEYS`, replan, env_step, layer, layer_number, block, row_sum, valid_mass, num_valid; with a
            ratio numerator_mass, denominator_mass, uniform_ratio, ratio, ratio_mean, nonfinite_layers (1 where the
            ratio is infinite or undefined; in "layers_avg" the number of layers left out), ratio_lift, log2_ratio.
        groups: suite, task_id, episode_index, replan, env_step, layer, layer_number, block, group, mass, fraction,
            keys, density, lift.
    """
    return tables_of_each(in_order_of_episodes(measured), partial(_episode_replans, grouping=grouping))


def _episode_replans(measured: MeasuredEpisode, grouping: Grouping) -> Tables:
    item, values = measured.item, replan_values(measured, grouping)
    axes = [replan_axis(item), LayerAxis.of(measured.selection).columns]
    return Tables(
        lambda: long_table(item, axes, values.cells, EPISODE_KEYS),
        lambda: long_table(item, [*axes, {"group": grouping.names}], values.groups()),
    )


def task_tables(
    episodes: Tables,
    grouping: Grouping,
    sampling: Sampling,
    level: float = DEFAULT_LEVEL,
) -> Tables:
    """Every (task, layer) and, over tasks, cells with `task_id` null: means over tasks of the tasks' means.

    `scope` is "task", "all" (every task of one suite) or "combined" (every suite; only when there are several).
    `X_low` and `X_high` bound the interval of X (see `statistics.intervals`): over episodes inside a task, else about
    what the row's `intervals` says; null where there is none.

    Returns:
        cells: scope, suite, task_id, instruction, layer, layer_number, block, num_tasks, num_families and intervals
            (`episode_intervals.ABOUT_COLUMNS`), num_episodes, num_replans, success_rate; with a ratio ratio_std,
            ratio_median, ratio_min, ratio_max (over the episodes' mean ratios), episodes_without_ratio (episodes
            without a single finite ratio), num_nonfinite, geometric_left_out, nonfinite_layers (sums), numerator_mass,
            denominator_mass (means), uniform_ratio (geometric mean), and with bounds geometric_mean and ratio_lift
            (geometric means), ratio_mean, ratio_of_means.
        groups: scope, suite, task_id, instruction, layer, layer_number, block, group; mass, keys, density, lift
            (means); fraction, fraction_low, fraction_high.
    """
    cells = sorted_by_episode(episodes.cells)
    ordered = Tables(cells, sorted_by_episode(episodes.groups))
    # As arrays, once: there can be thousands of (task, layer) pairs. numpy has no null: NaN.
    columns = {name: float_values(cells[name]) for name in _columns_over_episodes(grouping)}
    units = sampling.units(cells)
    values = {name: ordered.values(name) for name in GROUP_MEASURES}
    rows, group_rows = [], []
    for scope, names, members in _scopes(cells):
        of_scope = {name: array[members] for name, array in columns.items()}
        of_groups = {name: array[members] for name, array in values.items()}
        of_tasks = units.of_tasks(units.tasks[members[0]])  # the episodes of all layers are the same
        for row, bounds, layer in zip(*_task_rows(of_scope, of_groups, grouping, of_tasks, level), names, strict=True):
            rows.append({**scope, **layer, **row})
            group_rows += [{**scope, **layer, **bound} for bound in bounds]
    return Tables(_task_frame(rows, _cell_schema(grouping)), _task_frame(group_rows, _GROUP_SCHEMA))


#: The columns of `task_tables(...).groups` with a fraction and its interval, and those that are means alone.
FRACTION_COLUMNS = ("fraction", "fraction_low", "fraction_high")
_WITHOUT_BOUNDS = tuple(name for name in GROUP_MEASURES if name != "fraction")


def layer_order(table: pl.DataFrame) -> list[str]:
    """The layers of any of these tables by number, "layers_avg" last."""
    layers = table.select("layer", "layer_number").unique().sort("layer_number", "layer", nulls_last=True)
    return layers["layer"].to_list()


def overall_layer(table: pl.DataFrame) -> str:
    """The layer that a summary in one number is about: "layers_avg" where there is one, else the first layer."""
    layers = layer_order(table)
    return LAYERS_AVG if LAYERS_AVG in layers else layers[0]


def overall_rows(tasks: Tables) -> Tables:
    """The part of `task_tables` over everything: all suites when there are several, else the suite."""
    scope = "combined" if (tasks.cells["scope"] == "combined").any() else "all"
    return tasks.filter(pl.col("scope") == scope)


def _columns_over_episodes(grouping: Grouping) -> tuple[str, ...]:
    """The columns of `episode_tables(...).cells` that tasks are computed from."""
    columns: tuple[str, ...] = ("num_replans", "success")
    if grouping.ratio:
        columns += ("numerator_mass", "denominator_mass", "ratio_mean", "log_ratio_mean", "num_nonfinite")
        columns += ("geometric_left_out", "nonfinite_layers", "uniform_ratio", "ratio_lift")
    return columns


def _scopes(cells: pl.DataFrame) -> Iterator[tuple[dict[str, object], list[dict[str, object]], NDArray[np.int64]]]:
    """The cells that belong together: what they share, what names each layer, and positions (layer, episode).

    Layers of the same episodes come together. `cells` are sorted by episode.
    """
    by_rank = cells.select(LAYER_KEYS).unique("layer").sort("layer").rows(named=True)
    layer, episode = (
        cells.select(of.rank("dense").cast(pl.Int64)).to_series().to_numpy()
        for of in (pl.col("layer"), pl.struct(EPISODE_ID))
    )

    def by_layer(
        scope: dict[str, object], first: int, count: int
    ) -> Iterator[tuple[dict[str, object], list[dict[str, object]], NDArray[np.int64]]]:
        found: dict[bytes, tuple[list[dict[str, object]], list[NDArray[np.int64]]]] = {}
        positions = first + np.argsort(layer[first : first + count], kind="stable")
        for of_layer in np.split(positions, np.flatnonzero(np.diff(layer[positions])) + 1):
            names, members = found.setdefault(episode[of_layer].tobytes(), ([], []))
            names.append(by_rank[layer[of_layer[0]] - 1])
            members.append(of_layer)
        for names, members in found.values():
            yield scope, names, np.stack(members)

    runs = cells.group_by("suite", "task_id", maintain_order=True).agg(pl.first("instruction"), pl.len())
    first = 0
    for of_suite in runs.partition_by("suite", maintain_order=True):
        begin = first
        for suite, task, instruction, count in of_suite.iter_rows():
            task_scope = {"scope": "task", "suite": suite, "task_id": task, "instruction": instruction}
            yield from by_layer(task_scope, first, count)
            first += count
        whole = {"scope": "all", "suite": of_suite["suite"][0], "task_id": None, "instruction": None}
        yield from by_layer(whole, begin, first - begin)
    if runs["suite"].n_unique() > 1:
        yield from by_layer({"scope": "combined", "suite": None, "task_id": None, "instruction": None}, 0, first)


def _task_rows(
    columns: Mapping[str, NDArray[Any]],
    groups: Mapping[str, NDArray[np.float64]],
    grouping: Grouping,
    units: Units,
    level: float,
) -> tuple[list[dict[str, Any]], list[list[dict[str, Any]]]]:
    """For each layer of a scope the cell's row, and a row per group.

    columns: (layer, episode) each; groups: (layer, episode, group) each; units: of the episodes, not decided.
    """
    # Outcomes that are not known are NaN, and in no mean.
    plain: dict[str, EpisodeStatistic] = {"success_rate": mean_over_episodes(columns["success"])}
    bounded: dict[str, EpisodeStatistic] = {}
    counts: dict[str, list[int]] = {"num_replans": columns["num_replans"].sum(axis=1).astype(int).tolist()}
    if grouping.ratio:
        plain |= {name: mean_over_episodes(columns[name]) for name in ("numerator_mass", "denominator_mass")}
        # With the mean and the episodes of the headline, so that ratio / uniform ratio is the lift.
        uniform = baseline_logs(columns["uniform_ratio"], columns["log_ratio_mean"])
        plain["uniform_ratio"] = geometric_mean_over_episodes(uniform)
        bounded = {
            "ratio_mean": mean_over_episodes(columns["ratio_mean"], POSITIVE),
            "ratio_of_means": ratio_of_means_over_episodes(columns["numerator_mass"], columns["denominator_mass"]),
            "geometric_mean": geometric_mean_over_episodes(columns["log_ratio_mean"]),
            "ratio_lift": geometric_mean_over_episodes(logs_of(columns["ratio_lift"])),
        }
        for name in ("num_nonfinite", "geometric_left_out", "nonfinite_layers"):
            counts[name] = columns[name].sum(axis=1).astype(int).tolist()
    shares = mean_over_episodes(groups["fraction"].swapaxes(1, 2), SHARE)
    found = iter(estimates([*plain.values(), *bounded.values(), shares], units.decided()))
    layers = range(len(columns["success"]))
    of_plain, of_bounded = ({name: [next(found) for _ in layers] for name in which} for which in (plain, bounded))
    means = {name: means_over_tasks(groups[name], units.tasks).tolist() for name in _WITHOUT_BOUNDS}
    spreads = summarize_rows(columns["ratio_mean"]) if grouping.ratio else []
    rows, group_rows = [], []
    for i in layers:
        row: dict[str, Any] = {"num_tasks": units.num_tasks, **about_row(units), "num_episodes": len(units.tasks)}
        row |= {name: count[i] for name, count in counts.items()}
        if grouping.ratio:
            row |= {f"ratio_{name}": getattr(spreads[i], name) for name in ("std", "median", "min", "max")}
            row["episodes_without_ratio"] = spreads[i].num_nonfinite
        row |= {name: of_layers[i].value for name, of_layers in of_plain.items()}
        for name, of_layers in of_bounded.items():
            row |= named_interval(name, of_layers[i].value, of_layers[i].interval(level))
        rows.append(row)
        of_groups = []
        for j, name in enumerate(grouping.names):
            share = next(found)
            values = {measure: None if math.isnan(of[i][j]) else of[i][j] for measure, of in means.items()}
            of_groups.append(
                {"group": name, **values, **named_interval("fraction", share.value, share.interval(level))}
            )
        group_rows.append(of_groups)
    return rows, group_rows


def baseline_logs(uniform: NDArray[np.float64], log_ratios: NDArray[np.float64]) -> NDArray[np.float64]:
    """Logarithms of uniform ratios (..., episode) of the episodes that have a ratio; of all where none has."""
    having = np.isfinite(log_ratios)
    return np.where(having | ~having.any(axis=-1, keepdims=True), logs_of(uniform), np.nan)


_NAMES: dict[str, type[pl.DataType]] = {
    **dict.fromkeys(("scope", "suite"), pl.String),
    "task_id": pl.Int64,
    **dict.fromkeys(("instruction", "layer"), pl.String),
    **dict.fromkeys(("layer_number", "block"), pl.Int64),
}
_GROUP_SCHEMA: dict[str, type[pl.DataType]] = {
    **_NAMES,
    "group": pl.String,
    **dict.fromkeys((*_WITHOUT_BOUNDS, *FRACTION_COLUMNS), pl.Float64),
}


def _cell_schema(grouping: Grouping) -> dict[str, type[pl.DataType]]:
    """Columns of the cells and their types, which cannot be taken from a column that is null throughout."""
    counts = dict.fromkeys(("num_episodes", "num_replans"), pl.Int64)
    schema: dict[str, type[pl.DataType]] = {**_NAMES, "num_tasks": pl.Int64, **ABOUT_COLUMNS, **counts}
    schema["success_rate"] = pl.Float64
    if grouping.ratio:
        whole = ("episodes_without_ratio", "num_nonfinite", "geometric_left_out", "nonfinite_layers")
        plain = ("ratio_std", "ratio_median", "ratio_min", "ratio_max")
        means = ("numerator_mass", "denominator_mass", "uniform_ratio")
        bounded = ("ratio_mean", "ratio_of_means", "geometric_mean", "ratio_lift")
        schema |= dict.fromkeys(plain, pl.Float64) | dict.fromkeys(whole, pl.Int64) | dict.fromkeys(means, pl.Float64)
        schema |= dict.fromkeys((f"{name}{end}" for name in bounded for end in ("", "_low", "_high")), pl.Float64)
    return schema


def _task_frame(rows: Sequence[dict[str, Any]], schema: dict[str, type[pl.DataType]]) -> pl.DataFrame:
    order = pl.col("scope").replace_strict({"task": 0, "all": 1, "combined": 2}, return_dtype=pl.Int64)
    return pl.DataFrame(rows, schema=schema).sort(
        pl.col("suite").is_null(), "suite", order, "task_id", "layer_number", nulls_last=True, maintain_order=True
    )
