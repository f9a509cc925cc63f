"""`paired_differences_RUN`: the differences of all pairs per task, with the means of tasks and over tasks."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import polars as pl

from vla_attention.analyze.compare.comparison import LOG2_RATIO, Comparison
from vla_attention.analyze.compare.plot_forest import factor_axis
from vla_attention.analyze.measures.frames import layer_name
from vla_attention.analyze.show.numbers import interval_name, plural
from vla_attention.analyze.show.plot_axes import note_at_row
from vla_attention.analyze.show.plot_colours import NOTE_COLOR, STRIPE_COLOR
from vla_attention.analyze.show.plot_rows import MANY_ROWS, draw_dots, draw_estimate, label_rows, legend_of_rows
from vla_attention.analyze.show.plot_style import drawn_in_our_style, new_figure, save_figure
from vla_attention.analyze.show.plot_text import explain, named, task_label, title, wrapped
from vla_attention.analyze.statistics.intervals import DEFAULT_LEVEL

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def stem_of(name: str) -> str:
    """File name of the picture of a run."""
    return "paired_differences_" + re.sub(r"[^A-Za-z0-9._-]+", "_", name)


@drawn_in_our_style
def plot_paired_differences(
    comparison: Comparison, name: str, folder: Path, layer: str | None = None, level: float = DEFAULT_LEVEL
) -> list[Path]:
    """Draw one run against the first one; returns the paths of png, pdf and csv. `layer`: "layers_avg" unless given."""
    layer = layer or comparison.overall_layer
    quantity = comparison.quantities[0]
    of_run = (pl.col("run") == name, pl.col("layer") == layer)
    rows = comparison.differences.filter(*of_run, pl.col("quantity") == quantity, pl.col("scope") != "suite")
    pairs = comparison.pairs.filter(*of_run, pl.col("quantity") == quantity)
    tasks = rows.filter(pl.col("scope") == "task")
    few = tasks.height <= MANY_ROWS
    figure = new_figure(9, 1.7 + (0.42 if few else 0.2) * (rows.height + 0.5))
    which = layer_name(layer, "mean over layers", "block")
    first = comparison.names[0]
    paired = pairs.height > 0
    equal = "task and initial state" if comparison.ignores_seed else "task, initial state and seed"
    note = (
        f"{plural(pairs.height, 'pair')} of episodes of {plural(tasks.height, 'task')}, equal in {equal}. n counts "
        "pairs."
        if paired
        else f"Not paired: no two episodes are equal in {equal}. n counts episodes of either run."
    )
    title(figure, f"{name} against {first}: {named(comparison.grouping)}, {which}", note)
    axes = figure.subplots()
    if tasks.is_empty():
        explain(axes, "The runs have no task in common.")
        return save_figure(figure, folder, stem_of(name), rows)
    is_ratio = quantity == LOG2_RATIO
    dots = pairs["difference"].drop_nulls().to_numpy()
    values = np.concatenate([rows[column].drop_nulls().to_numpy() for column in ("difference", "low", "high")] + [dots])
    values = values[np.isfinite(values)]
    if not values.size:
        explain(axes, "No pair has a finite ratio in both runs.")
        return save_figure(figure, folder, stem_of(name), rows)
    if is_ratio:
        factor_axis(axes.xaxis, np.append(2.0**values, 1.0))
        axes.set_xlabel(f"ratio of {wrapped(name, 30, 1)} as a factor of that of {wrapped(first, 30, 1)} (logarithmic)")
    else:
        axes.set_xlabel(f"difference in the fraction of '{quantity.removesuffix('_fraction')}', {name} minus {first}")
    axes.axvline(1.0 if is_ratio else 0.0, color=NOTE_COLOR, linewidth=1.0, zorder=1)
    generator = np.random.default_rng(0)
    for place, row in enumerate(rows.iter_rows(named=True)):
        _draw_row(axes, place, row, pairs, quantity, generator, few)
    several = tasks["suite"].n_unique() > 1
    shown = rows.iter_rows(named=True)
    label_rows(axes, ["all tasks" if row["scope"] == "all" else task_label(row, several, few) for row in shown])
    interval = interval_name(level) if rows["low"].is_not_null().any() else ""
    legend_of_rows(axes, 3, "mean", interval, "single pair" if paired else "")
    return save_figure(figure, folder, stem_of(name), rows)


def _draw_row(
    axes: Axes,
    place: int,
    row: dict[str, Any],
    pairs: pl.DataFrame,
    quantity: str,
    generator: np.random.Generator,
    few: bool,
) -> None:
    def scaled(values: Any) -> Any:
        return 2.0**values if quantity == LOG2_RATIO else values

    total = row["scope"] != "task"
    if total:
        axes.axhspan(place - 0.5, place + 0.5, color=STRIPE_COLOR, linewidth=0, zorder=0)
    else:
        of_task = pairs.filter((pl.col("suite") == row["suite"]) & (pl.col("task_id") == row["task_id"]))
        values = of_task["difference"].drop_nulls().to_numpy()
        values = values[np.isfinite(values)]
        draw_dots(axes, place, scaled(values), generator, few)
    if row["difference"] is not None:
        bounds = [None if row[end] is None else scaled(row[end]) for end in ("low", "high")]
        draw_estimate(axes, place, scaled(row["difference"]), bounds, marker="D" if total else "o", few=few)
    else:
        note_at_row(axes, place, "no difference to show", x=0.01)
    n = f"n = {row['num_pairs']}" if row["paired"] else f"n = {row['num_first']}, {row['num_other']}"
    note_at_row(axes, place, n)
