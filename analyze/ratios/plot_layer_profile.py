"""`layer_profile`: ratio and fractions of every layer, with intervals over episodes and the uniform baseline."""

from __future__ import annotations

from pathlib import Path

import polars as pl

from vla_attention.analyze.measures.aggregate import FRACTION_COLUMNS, layer_order, overall_rows
from vla_attention.analyze.measures.frames import LAYERS_AVG, Tables
from vla_attention.analyze.ratios.plot_profile_panels import draw_profile, shown_groups
from vla_attention.analyze.show.numbers import of_tasks
from vla_attention.analyze.show.plot_style import drawn_in_our_style, new_figure, save_figure
from vla_attention.analyze.show.plot_text import named, title
from vla_attention.analyze.statistics.intervals import DEFAULT_LEVEL
from vla_attention.schemas.groupings.grouping import Grouping

STEM = "layer_profile"


@drawn_in_our_style
def plot_layer_profile(tasks: Tables, grouping: Grouping, folder: Path, *, note: str = "") -> list[Path]:
    """Draw the rows of `aggregate.task_tables` over all tasks; returns the paths of pictures and data.

    `note`: a sentence to add below the title.
    """
    level = overall_rows(tasks).filter(pl.col("layer") != LAYERS_AVG)
    rows, layers = level.cells, layer_order(level.cells)
    figure = new_figure(max(6.6, 3.2 + 0.3 * min(len(layers), 28)), 3.1 if grouping.ratio is None else 5.0)
    about = f"Means over {of_tasks(rows['num_episodes'][0], rows['num_tasks'][0])}."
    if grouping.ratio is not None and rows["num_nonfinite"].sum():
        about += f" {rows['num_nonfinite'].sum()} of {rows['num_replans'].sum()} ratios are not finite and in no mean."
    title(figure, f"Layers, {named(grouping)}", f"{about} {note}")
    draw_profile(figure, level, grouping, layers, "layer", DEFAULT_LEVEL)
    names = ["layer", "block", "num_episodes", "num_replans"]
    if grouping.ratio is not None:
        names += ["geometric_mean", "geometric_mean_low", "geometric_mean_high", "uniform_ratio", "num_nonfinite"]
    groups = level.groups.filter(pl.col("group").is_in(shown_groups(level, grouping)))
    data = {"": rows.select(names), "_groups": groups.select("layer", "block", "group", *FRACTION_COLUMNS)}
    return save_figure(figure, folder, STEM, data)
