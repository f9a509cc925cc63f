"""`head_grid`: every head of every layer, coloured by its lift over uniform attention."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.heads.head_measures import main_group
from vla_attention.analyze.measures.frames import Tables, float_values
from vla_attention.analyze.show.numbers import format_percent, interval_name, of_tasks, plural
from vla_attention.analyze.show.plot_heat_map import draw_log2_map, label_axis, map_height
from vla_attention.analyze.show.plot_style import drawn_in_our_style, new_figure, save_figure
from vla_attention.analyze.show.plot_text import explain, named, ratio_name, title
from vla_attention.analyze.statistics.intervals import DEFAULT_LEVEL
from vla_attention.schemas.groupings.grouping import Grouping

STEM = "head_grid"


@drawn_in_our_style
def plot_head_grid(heads: Tables, grouping: Grouping, folder: Path) -> list[Path]:
    """Draw from `head_measures.heads_tables`; returns the paths of png, pdf and csv.

    With a ratio its lift over the uniform ratio (the ratio itself where a side has no keys), else the lift of the first
    group that has mass. A dot: the interval of the head holds the uniform value.
    """
    cells = heads.cells
    quantity = _quantity(cells, grouping)
    shown = cells if grouping.ratio is not None else heads.of_group(main_group(heads, grouping))
    layers = cells["layer"].unique(maintain_order=True).to_list()
    numbers = cells["head"].unique(maintain_order=True).to_list()
    log2, low, high = (
        _grid(shown, column, len(layers)) for column in (quantity, f"{quantity}_low", f"{quantity}_high")
    )
    label, about = "times uniform attention", f"{_name(grouping, heads)} relative to uniform attention"
    if quantity == "log2_ratio":
        label, about = "ratio", f"{_name(grouping, heads)} (no uniform baseline)"
    if quantity == "lift":
        with np.errstate(divide="ignore"):
            log2, low, high = np.log2(log2), np.log2(low), np.log2(high)
    if grouping.ratio is not None:
        log2 = _with_limits(cells, log2)
    uncertain = (low <= 0) & (high >= 0)
    figure = new_figure(max(5.6, 2.4 + 0.34 * len(numbers)), max(2.6, 1.7 + map_height(len(layers), len(numbers))))
    title(figure, f"Heads, {named(grouping)}: {about}", _note(cells, log2, bool((uncertain & np.isfinite(log2)).any())))
    axes = figure.subplots()
    if np.isnan(log2).all():
        explain(axes, f"No head has any attention on {_name(grouping, heads)}.")
    else:
        draw_log2_map(figure, axes, log2, uncertain, label)
        label_axis(axes, "x", [str(number) for number in numbers])
        label_axis(axes, "y", [str(layer) for layer in layers])
        axes.set_xlabel("head")
        axes.set_ylabel("layer")
    return save_figure(figure, folder, STEM, {"": cells, "_groups": heads.groups})


def _quantity(cells: pl.DataFrame, grouping: Grouping) -> str:
    if grouping.ratio is None:
        return "lift"
    return (
        "log2_ratio" if cells["log2_lift"].is_null().all() and cells["log2_ratio"].is_not_null().any() else "log2_lift"
    )


def _name(grouping: Grouping, heads: Tables) -> str:
    return main_group(heads, grouping) if grouping.ratio is None else ratio_name(grouping.ratio)


def _grid(heads: pl.DataFrame, column: str, num_layers: int) -> NDArray[np.float64]:
    return float_values(heads[column]).reshape(num_layers, -1)


def _with_limits(heads: pl.DataFrame, log2: NDArray[np.float64]) -> NDArray[np.float64]:
    """Infinite or zero where no replan of any episode has a finite logarithm, by the side that has all the mass."""
    above, below = (_grid(heads, f"{side}_fraction", len(log2)) > 0 for side in ("numerator", "denominator"))
    missing = np.isnan(log2)
    return np.where(missing & above & ~below, np.inf, np.where(missing & below & ~above, -np.inf, log2))


def _note(heads: pl.DataFrame, log2: NDArray[np.float64], dots: bool) -> str:
    episodes, tasks = int(heads["num_episodes"][0]), int(heads["num_tasks"][0])
    text = f"Means over {of_tasks(episodes, tasks)}."
    if dots:
        text += f" Dot: the head's {interval_name(DEFAULT_LEVEL)} holds the uniform value."
        text += f" By chance alone, {format_percent(1 - DEFAULT_LEVEL, 0)} of the heads have no dot."
    infinite = int(np.isinf(log2).sum())
    if infinite:
        text += f" ∞ or 0: {plural(infinite, 'head')} with no mass on one side at any replan."
    if np.isnan(log2).any():
        text += " Grey: no mass on either side."
    return text
