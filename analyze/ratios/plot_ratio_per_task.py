"""`ratio_per_task`: geometric mean ratio of every task with interval and uniform baseline, single episodes as dots."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import polars as pl

from vla_attention.analyze.measures.aggregate import overall_layer
from vla_attention.analyze.measures.frames import LAYERS_AVG, layer_name
from vla_attention.analyze.show.numbers import interval_name, of_tasks
from vla_attention.analyze.show.plot_axes import note_at_row, ratio_axis
from vla_attention.analyze.show.plot_colours import STRIPE_COLOR
from vla_attention.analyze.show.plot_rows import (
    MANY_ROWS,
    draw_dots,
    draw_estimate,
    draw_uniform,
    label_rows,
    legend_of_rows,
)
from vla_attention.analyze.show.plot_style import drawn_in_our_style, new_figure, save_figure
from vla_attention.analyze.show.plot_text import explain, named, ratio_name, task_label, title
from vla_attention.analyze.statistics.intervals import DEFAULT_LEVEL
from vla_attention.schemas.groupings.grouping import Grouping

if TYPE_CHECKING:
    from matplotlib.axes import Axes

STEM = "ratio_per_task"
_COLUMNS = (
    "geometric_mean",
    "geometric_mean_low",
    "geometric_mean_high",
    "uniform_ratio",
    "episodes_without_ratio",
    "num_nonfinite",
)


@drawn_in_our_style
def plot_ratio_per_task(
    episodes: pl.DataFrame,
    tasks: pl.DataFrame,
    grouping: Grouping,
    folder: Path,
    layer: str | None = None,
    level: float = DEFAULT_LEVEL,
    *,
    stem: str = STEM,
    about: str | None = None,
    note: str = "",
) -> list[Path]:
    """Draw one layer; returns the paths of png, pdf and csv.

    Args:
        episodes: the cells of `aggregate.episode_tables`.
        tasks: the cells of `aggregate.task_tables`.
        grouping: its groups and ratio.
        folder: where the files go.
        layer: "layers_avg" unless given.
        level: level of the intervals in `tasks`.
        stem: name of the files, without ending.
        about: what the title names as the source; the grouping unless given.
        note: a sentence to add below the title.
    """
    layer = layer or overall_layer(tasks)
    rows = tasks.filter((pl.col("layer") == layer) & (pl.col("scope") == "task"))
    overall = tasks.filter((pl.col("layer") == layer) & (pl.col("scope") != "task"))
    dots = episodes.filter(pl.col("layer") == layer)
    identity = ["scope", "suite", "task_id", "instruction", "layer", "num_episodes"]
    if grouping.ratio is None:
        figure = new_figure(8, 3)
        explain(figure.subplots(), f"Grouping '{grouping.name}' defines no ratio.")
        return save_figure(figure, folder, stem, rows.select(identity))
    data = pl.concat([rows, overall]).select(*identity, *_COLUMNS)
    # With one task, the row over all tasks would repeat it.
    shown = pl.concat([rows, overall]) if rows.height > 1 else rows
    few = rows.height <= MANY_ROWS
    figure = new_figure(9, 1.6 + (0.46 if few else 0.2) * (shown.height + 0.5))
    name = layer_name(layer, LAYERS_AVG)
    title(figure, f"Ratio per task, {name}, {about or named(grouping)}", f"{_counts(rows, dots)} {note}")
    axes = figure.subplots()
    values = [data[column].drop_nulls().to_numpy() for column in _COLUMNS[:4]] + [
        dots["geometric_mean"].drop_nulls().to_numpy()
    ]
    if not np.isfinite(np.concatenate(values[:3])).any():
        left_out = int(dots["num_nonfinite"].sum())
        explain(
            axes,
            f"No episode has a finite ratio: all {left_out} ratios are infinite (no denominator mass) or undefined.",
        )
        return save_figure(figure, folder, stem, data)
    ratio_axis(axes.xaxis, np.concatenate(values))
    _draw_rows(axes, shown, dots, few)
    several = rows["suite"].n_unique() > 1
    label_rows(axes, [_label(row, several, few) for row in shown.iter_rows(named=True)])
    axes.set_xlabel(f"ratio of masses, {ratio_name(grouping.ratio)} (logarithmic)")
    interval = interval_name(level) if shown["geometric_mean_low"].is_not_null().any() else ""
    uniform = bool(shown["uniform_ratio"].is_not_null().any())
    legend_of_rows(axes, 4, "geometric mean", interval, "single episode", uniform)
    return save_figure(figure, folder, stem, data)


def _draw_rows(axes: Axes, shown: pl.DataFrame, dots: pl.DataFrame, few: bool) -> None:
    generator = np.random.default_rng(0)
    for position, row in enumerate(shown.iter_rows(named=True)):
        total = row["scope"] != "task"
        if total:
            axes.axhspan(position - 0.5, position + 0.5, color=STRIPE_COLOR, linewidth=0, zorder=0)
        else:
            of_task = dots.filter((pl.col("suite") == row["suite"]) & (pl.col("task_id") == row["task_id"]))
            values = of_task["geometric_mean"].drop_nulls().to_numpy()
            values = values[values > 0]
            draw_dots(axes, position, values, generator, few)
        mean, low, high = row["geometric_mean"], row["geometric_mean_low"], row["geometric_mean_high"]
        if mean is not None and mean > 0:
            draw_estimate(axes, position, mean, (low, high), marker="D" if total else "o", few=few)
        else:
            note_at_row(axes, position, "no finite ratio", x=0.01)
        uniform = row["uniform_ratio"]
        if uniform is not None and uniform > 0:
            draw_uniform(axes, position, uniform)
        left_out = f" ({row['episodes_without_ratio']} without)" if row["episodes_without_ratio"] else ""
        text = f"n = {row['num_episodes']}{left_out}"
        note_at_row(axes, position, text)


def _label(row: dict[str, Any], several: bool, few: bool) -> str:
    if row["scope"] == "combined":
        return "all suites"
    if row["scope"] == "all":
        return f"all tasks of {row['suite']}"
    return task_label(row, several, few)


def _counts(rows: pl.DataFrame, dots: pl.DataFrame) -> str:
    text = f"{of_tasks(dots.height, rows.height)}; n counts episodes."
    left_out = int(dots["num_nonfinite"].sum())
    if left_out:
        text += f" {left_out} of {int(dots['num_replans'].sum())} ratios are not finite and not in any mean."
    if rows["geometric_mean_low"].null_count() and rows["geometric_mean"].is_not_null().any():
        text += " No interval where there can be none (one episode, no spread)."
    return text
