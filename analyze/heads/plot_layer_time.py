"""`layer_time`: every layer over the course of the episodes, coloured by its lift over uniform attention."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import polars as pl

from vla_attention.analyze.measures.frames import Tables, float_values
from vla_attention.analyze.show.numbers import interval_name, of_tasks
from vla_attention.analyze.show.plot_heat_map import draw_log2_map, label_axis, map_height
from vla_attention.analyze.show.plot_style import drawn_in_our_style, new_figure, save_figure
from vla_attention.analyze.show.plot_text import explain, named, ratio_name, title, wrapped
from vla_attention.analyze.statistics.intervals import DEFAULT_LEVEL
from vla_attention.schemas.groupings.grouping import Grouping

if TYPE_CHECKING:
    pass

STEM = "layer_time"


@drawn_in_our_style
def plot_layer_time(table: pl.DataFrame, replans: Tables, grouping: Grouping, folder: Path) -> list[Path]:
    """Draw `layer_time.layer_time_table` of `aggregate.replan_tables`; returns the paths of png, pdf and csv.

    With a ratio one map of its lift over the uniform ratio; else a map of fractions for each of the first groups. A
    dot: the interval of the cell holds the uniform value.
    """
    quantities = table["quantity"].unique(maintain_order=True).to_list()
    layers, bins = table["layer"].unique(maintain_order=True).to_list(), table["bin"].n_unique()
    figure = new_figure(max(6.4, 3.6 * len(quantities) + 1.0), max(2.7, 1.6 + map_height(len(layers), bins)))
    episodes = replans.cells.select("suite", "task_id", "episode_index").unique()
    note = f"Means over {of_tasks(episodes.height, episodes.select('suite', 'task_id').n_unique())}."
    shared = figure.subplots(1, len(quantities), squeeze=False, sharey=True)[0]
    undefined, dots = False, False
    for axes, quantity in zip(shared, quantities, strict=True):
        part = table.filter(pl.col("quantity") == quantity)
        mean, low, high = (float_values(part[column]).reshape(len(layers), bins) for column in ("mean", "low", "high"))
        if np.isnan(mean).all():
            explain(axes, "No ratio is finite and above 0." if grouping.ratio else "No group has any mass.")
            continue
        undefined = undefined or bool(np.isnan(mean).any())
        if grouping.ratio is not None:
            label = "times uniform attention" if quantity == "log2_lift" else "ratio"
            uncertain = (low <= 0) & (high >= 0)
            dots = dots or bool(uncertain.any())
            draw_log2_map(figure, axes, mean, uncertain, label)
        else:
            image = axes.imshow(mean, origin="lower", aspect="auto", interpolation="none", cmap="cividis", vmin=0.0)
            bar = figure.colorbar(image, ax=axes, shrink=0.9, aspect=24, pad=0.02)
            bar.outline.set_visible(False)
            axes.set_title(wrapped(quantity.removesuffix("_fraction"), 30, 1))
            bar.set_label("fraction")
        label_axis(axes, "y", layers)
        axes.set_xticks(np.linspace(-0.5, bins - 0.5, 6), [f"{share:.1f}" for share in np.linspace(0, 1, 6)])
        axes.set_xlabel("episode time (0: first replan, 1: end)")
        if axes is shared[0]:
            axes.set_ylabel("layer")
    if dots:
        note += f" Dot: the cell's {interval_name(DEFAULT_LEVEL)} holds the uniform value."
    if undefined and grouping.ratio is not None:
        note += " Grey: no finite logarithm (infinite, undefined or zero ratios take no part)."
    about = ""
    if grouping.ratio is not None:
        base = "relative to uniform attention" if quantities == ["log2_lift"] else "(no uniform baseline)"
        about = f": {ratio_name(grouping.ratio)} {base}"
    title(figure, f"Layers over the episodes' time, {named(grouping)}{about}", note)
    return save_figure(figure, folder, STEM, table)
