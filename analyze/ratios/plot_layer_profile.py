"""`layer_profile`: ratio and fractions of every layer, with intervals over episodes and the uniform baseline."""

from __future__ import annotations

from pathlib import Path

import polars as pl

from vla_attention.analyze.measures.aggregate import LAYERS_AVG, layer_order, overall_rows
from vla_attention.analyze.show.numbers import plural
from vla_attention.analyze.show.plot_profile import draw_profile, shown_groups
from vla_attention.analyze.show.plot_style import drawn_in_our_style, new_figure, save_figure
from vla_attention.analyze.show.plot_text import named, title
from vla_attention.analyze.statistics.bootstrap import DEFAULT_LEVEL
from vla_attention.schemas.groupings.grouping import Grouping

STEM = "layer_profile"


@drawn_in_our_style
def plot_layer_profile(tasks: pl.DataFrame, grouping: Grouping, folder: Path) -> list[Path]:
    """Draw from `aggregate.tasks_table` (its rows over everything); returns the paths of png, pdf and csv."""
    rows = overall_rows(tasks)
    layers = [layer for layer in layer_order(rows) if layer != LAYERS_AVG]
    rows = rows.filter(pl.col("layer") != LAYERS_AVG).sort("layer_number")
    figure = new_figure(max(6.6, 3.2 + 0.3 * min(len(layers), 28)), 3.1 if grouping.ratio is None else 5.0)
    note = f"Means over {plural(rows['num_episodes'][0], 'episode')} of {plural(rows['num_tasks'][0], 'task')}."
    if grouping.ratio is not None and rows["num_nonfinite"].sum():
        note += f" {rows['num_nonfinite'].sum()} of {rows['num_replans'].sum()} ratios are not finite and in no mean."
    title(figure, f"Layers, {named(grouping)}", note)
    draw_profile(figure, rows, grouping, layers, "layer", DEFAULT_LEVEL)
    columns = [f"{name}_fraction{end}" for name in shown_groups(rows, grouping) for end in ("", "_low", "_high")]
    if grouping.ratio is not None:
        columns = ["ratio_mean", "ratio_mean_low", "ratio_mean_high", "uniform_ratio", "num_nonfinite", *columns]
    return save_figure(figure, folder, STEM, rows.select("layer", "block", "num_episodes", "num_replans", *columns))
