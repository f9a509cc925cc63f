"""`ratio_distribution`: how the ratio is spread over replans (histogram) and over layers (boxes, episodes as dots)."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.measures.aggregate import layer_order, overall_layer
from vla_attention.analyze.measures.frames import LAYERS_AVG, layer_name
from vla_attention.analyze.show.numbers import of_tasks, plural
from vla_attention.analyze.show.plot_axes import (
    BASELINE_LABEL,
    legend_beside,
    note_at_row,
    ratio_axis,
    scattered,
    uniform_line,
    whole_numbers,
)
from vla_attention.analyze.show.plot_colours import BASELINE_COLOR, DATA_COLOR, NOTE_COLOR
from vla_attention.analyze.show.plot_style import drawn_in_our_style, new_figure, save_figure
from vla_attention.analyze.show.plot_text import explain, named, ratio_name, title
from vla_attention.schemas.groupings.grouping import Grouping

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

STEM = "ratio_distribution"
#: The columns of `aggregate.replan_tables` that are drawn.
COLUMNS = (
    *("suite", "task_id", "episode_index", "replan", "env_step", "layer", "layer_number"),
    *("ratio", "uniform_ratio"),
)
_BASELINE_RANGE_COLOR = "#E6E6E6"
_MEDIAN_COLOR, _BOX_COLOR, _DOT_COLOR = "#D55E00", "#CFE3F1", "#333333"


@drawn_in_our_style
def plot_ratio_distribution(
    replans: pl.DataFrame,
    grouping: Grouping,
    folder: Path,
    *,
    stem: str = STEM,
    about: str | None = None,
    note: str = "",
) -> list[Path]:
    """Draw the ratios of all replans; returns the paths of png, pdf and csv.

    Args:
        replans: `COLUMNS` of the cells of `aggregate.replan_tables`.
        grouping: its groups and ratio.
        folder: where the files go.
        stem: name of the files, without ending.
        about: what the title names as the source; the grouping unless given.
        note: a sentence to add below the title.
    """
    layers = layer_order(replans)
    if len(layers) == 2 and LAYERS_AVG in layers:
        layers.remove(LAYERS_AVG)  # of one layer, the mean over layers has the same numbers
    chosen = overall_layer(replans) if len(layers) > 1 else layers[0]
    rows = replans.filter(pl.col("layer").is_in(layers))
    columns = ["suite", "task_id", "episode_index", "replan", "env_step", "layer"]
    if grouping.ratio is None:
        figure = new_figure(8, 3)
        explain(figure.subplots(), f"Grouping '{grouping.name}' defines no ratio.")
        return save_figure(figure, folder, stem, rows.select(columns))
    data = rows.select(*columns, "ratio", "uniform_ratio")
    overall = rows.filter(pl.col("layer") == chosen)
    height = 2.9 + 0.24 * len(layers) + 0.9
    figure = new_figure(8, height)
    shown = rows.filter(_drawable())
    title(
        figure,
        f"Ratio over replans, {about or named(grouping)}",
        f"{_counts(overall, rows, chosen)} {note}" if shown.height else "",
    )
    if shown.is_empty():
        explain(figure.subplots(), _why_empty(rows))
        return save_figure(figure, folder, stem, data)
    top, bottom = figure.subplots(2, 1, sharex=True, height_ratios=[2.2, 0.5 + 0.24 * len(layers)])
    uniform = rows["uniform_ratio"].drop_nulls().to_numpy()
    uniform = uniform[np.isfinite(uniform) & (uniform > 0)]
    ratio_axis(top.xaxis, np.concatenate([shown["ratio"].to_numpy(), uniform]))
    _histogram(top, overall, chosen)
    _boxes(bottom, shown, layers)
    for axes in (top, bottom):
        _baseline(axes, uniform)
        axes.grid(axis="x")
    legend_beside(top, handles=_legend(uniform))
    bottom.set_xlabel(f"ratio of masses, {ratio_name(grouping.ratio)} (logarithmic)")
    return save_figure(figure, folder, stem, data)


def _drawable() -> pl.Expr:
    return (pl.col("ratio").is_finite() & (pl.col("ratio") > 0)).fill_null(False)


def _histogram(axes: Axes, overall: pl.DataFrame, chosen: str) -> None:
    values = overall.filter(_drawable())["ratio"].to_numpy()
    name = layer_name(chosen, LAYERS_AVG)
    axes.set_title(f"{name}: {plural(len(values), 'replan')}", loc="left")
    axes.set_ylabel("replans")
    whole_numbers(axes.yaxis)
    if len(values) == 0:
        axes.text(0.5, 0.5, "no finite ratio in this layer", transform=axes.transAxes, ha="center", color=NOTE_COLOR)
        return
    low, high = axes.get_xlim()
    # Bins of equal width on the logarithmic axis, over the visible range so that few values do not fill the picture.
    edges = np.geomspace(low, high, 41).tolist()
    axes.hist(values, bins=edges, color=DATA_COLOR, alpha=0.85, edgecolor="white", linewidth=0.5)
    axes.axvline(float(np.median(values)), color=_MEDIAN_COLOR, linewidth=1.4)


def _boxes(axes: Axes, shown: pl.DataFrame, layers: list[str]) -> None:
    positions = list(range(len(layers)))
    generator = np.random.default_rng(0)
    for position, layer in zip(positions, layers, strict=True):
        rows = shown.filter(pl.col("layer") == layer)
        if rows.is_empty():
            note_at_row(axes, position, "no finite ratio", x=0.01)
            continue
        # Percentiles throughout, not multiples of the interquartile range: they mean the same on a logarithmic axis.
        least, low, middle, high, most = np.quantile(rows["ratio"].to_numpy(), [0.05, 0.25, 0.5, 0.75, 0.95])
        axes.plot([least, most], [position, position], "|-", color=DATA_COLOR, linewidth=0.9, markersize=6, zorder=1)
        axes.barh(position, high - low, 0.62, low, color=_BOX_COLOR, edgecolor=DATA_COLOR, linewidth=0.9, zorder=2)
        axes.plot([middle, middle], [position - 0.31, position + 0.31], color=_MEDIAN_COLOR, linewidth=1.4, zorder=4)
        means = rows.group_by("suite", "task_id", "episode_index", maintain_order=True).agg(pl.col("ratio").mean())
        places = scattered(generator, position, means.height, 0.2)
        axes.scatter(means["ratio"].to_numpy(), places, s=6, color=_DOT_COLOR, alpha=0.55, linewidths=0, zorder=5)
    axes.set_yticks(positions, layers)
    axes.set_ylim(len(layers) - 0.4, -0.6)
    axes.set_ylabel("layer")


def _baseline(axes: Axes, uniform: NDArray[np.float64]) -> None:
    if uniform.size == 0:
        return
    if _differs(uniform):
        axes.axvspan(float(uniform.min()), float(uniform.max()), color=_BASELINE_RANGE_COLOR, linewidth=0, zorder=0)
    uniform_line(axes, float(np.median(uniform)), along="x", linewidth=1.2)


def _differs(uniform: NDArray[np.float64]) -> bool:
    """Whether the replans have different baselines, because their prompts have different lengths."""
    return bool(uniform.max() > uniform.min() * 1.001)


def _legend(uniform: NDArray[np.float64]) -> list[Artist]:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles: list[Artist] = [
        Line2D([], [], color=_MEDIAN_COLOR, linewidth=1.4, label="median of replans"),
        Patch(facecolor=_BOX_COLOR, edgecolor=DATA_COLOR, label="box: quartiles of replans;\nwhiskers: 5 % to 95 %"),
        Line2D([], [], color=_DOT_COLOR, marker="o", markersize=3, linewidth=0, label="dot: mean of an episode"),
    ]
    if uniform.size:
        several = _differs(uniform)
        label = f"{BASELINE_LABEL}, median" if several else BASELINE_LABEL
        handles.append(Line2D([], [], color=BASELINE_COLOR, linestyle="--", linewidth=1.2, label=label))
        if several:
            handles.append(
                Patch(facecolor=_BASELINE_RANGE_COLOR, label=f"{BASELINE_LABEL}: range over\nreplans (prompts differ)")
            )
    return handles


def _counts(overall: pl.DataFrame, rows: pl.DataFrame, chosen: str) -> str:
    episodes = overall.select("suite", "task_id", "episode_index").n_unique()
    tasks = overall.select("suite", "task_id").n_unique()
    left_out = overall.height - int(overall["ratio"].is_finite().fill_null(False).sum())
    zeros = int((overall["ratio"] == 0).fill_null(False).sum())
    name = layer_name(chosen, LAYERS_AVG)
    text = f"n = {of_tasks(episodes, tasks)}, {plural(overall.height, 'replan')}."
    if left_out:
        text += f" {left_out} of {overall.height} ratios of {name} are not finite and not drawn."
    if zeros:
        text += f" {zeros} are 0, which a logarithmic axis cannot show."
    single = rows.filter(pl.col("layer") != chosen)
    elsewhere = single.filter(~_drawable()).height
    if elsewhere:
        text += f" In the single layers, {elsewhere} of {single.height} are not drawn."
    return text


def _why_empty(rows: pl.DataFrame) -> str:
    if rows["layer"].n_unique() > 1:
        rows = rows.filter(pl.col("layer") != LAYERS_AVG)  # its ratio is missing only where those of all layers are
    infinite = int(rows["ratio"].is_infinite().fill_null(False).sum())
    undefined = rows["ratio"].null_count()
    counts = {
        "infinite (no denominator mass)": infinite,
        "undefined (no mass on either side)": undefined,
        "0, which a logarithmic axis cannot show": rows.height - infinite - undefined,
    }
    parts = [f"{count} of {rows.height} are {what}" for what, count in counts.items() if count]
    return f"No ratio can be drawn: {'; '.join(parts)}."
