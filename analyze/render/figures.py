"""Pictures of frames: a function for each kind. A command names the kind and the columns; nothing here knows commands.

The options of a figure, by kind:

    forest        value, label: columns. color: a column of categories, with `colors` (category -> colour) and `names`
                  (category -> text). baseline: the line of no effect, or `uniform`, a column with one for each row;
                  baseline_name. dots: a frame of label and value, single episodes. log: a logarithmic axis. xlabel.
    lines         x, value; color: a column of series. uniform: a column, drawn dashed. log, xlabel, ylabel.
    stacked       x, value, color: a column of parts, which are stacked in their order. ylabel, xlabel.
    distribution  x, value: a box for each x, with a dot for each row. uniform, log, xlabel, ylabel.
    heat_map      x, y, value: factors around 1. xlabel, ylabel, label.
    scatter       x, y, label: points with names, NAME_low and NAME_high as bars. log (both axes), xlabel, ylabel.
    pictures      none; see `pictures.pictures` for the columns.

    pictures      see `render.pictures`.

NAME_low and NAME_high of a value are its interval; `num_episodes`, if the frame has it, is said.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.core.result import Figure
from vla_attention.analyze.render.pictures import pictures
from vla_attention.analyze.render.plot_axes import label_positions, ratio_axis, scattered, share_ticks, whole_numbers
from vla_attention.analyze.render.plot_colours import (
    BASELINE_COLOR,
    DOT_COLOR,
    NOTE_COLOR,
    SERIES_COLORS,
    group_styles,
)
from vla_attention.analyze.render.plot_heat_map import draw_log2_map, label_axis
from vla_attention.analyze.render.plot_text import explain, shortened, wrapped
from vla_attention.analyze.render.style import Style, new_canvas, save_canvas

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Canvas

#: Rows of a forest; the table has all.
_MOST_ROWS = 60
#: With more values than this a box has no dots.
_MOST_DOTS = 300
#: What the line that evenly spread attention gives is called.
BASELINE_NAME = "evenly spread attention"


def draw(figure: Figure, style: Style | None = None) -> Canvas:
    """The picture as a matplotlib figure."""
    style = style or Style()
    with style.settings():
        return _KINDS[figure.kind](figure, style)


def save(figure: Figure, folder: Path, style: Style | None = None, formats: Sequence[str] = ()) -> list[Path]:
    """Draw into a folder; returns the paths of the files."""
    style = style or Style()
    with style.settings():
        return save_canvas(_KINDS[figure.kind](figure, style), figure, folder, style, formats)


def _titled(canvas: Canvas, figure: Figure, style: Style) -> None:
    """One line of title on a screen; none in a paper, whose caption file has it."""
    if not style.paper:
        width = int(canvas.get_figwidth() * style.characters_per_inch)
        canvas.suptitle(wrapped(figure.title, width, 1), x=0.01, ha="left", size=10)


def _forest(figure: Figure, style: Style) -> Canvas:
    o: Any = figure.options
    known = pl.col(o["value"]).is_not_null()
    rows = figure.frame.filter(known & (pl.col(o["value"]) > 0) if o.get("log") else known).head(_MOST_ROWS)
    high_row = 0.19 if rows.height > 30 else 0.26
    canvas = new_canvas(style.width(wide=False), style.scaled(1.2 + high_row * max(rows.height, 2)))
    _titled(canvas, figure, style)
    axes = canvas.subplots()
    if rows.is_empty():
        explain(axes, "There is nothing to draw.")
        return canvas
    value, low, high = _bounds(rows, o["value"])
    uniform = rows[o["uniform"]].cast(pl.Float64).to_numpy() if "uniform" in o else np.array([])
    dots = o.get("dots")
    baseline = o.get("baseline")
    if o.get("log"):
        single = dots[o["value"]].drop_nulls().to_numpy() if dots is not None else np.array([])
        fixed = [baseline] if baseline is not None else []
        ratio_axis(axes.xaxis, np.concatenate([value, low[low > 0], high[np.isfinite(high)], uniform, single, fixed]))
    left, right = axes.get_xlim() if o.get("log") else (-np.inf, np.inf)
    places = np.arange(rows.height)
    if dots is not None:
        _dots(axes, rows, dots, o)
    colors = _colors_of(rows, o)
    axes.hlines(places, np.clip(low, left, right), np.clip(high, left, right), color=colors, linewidth=2)
    axes.scatter(value, places, c=colors, s=20, zorder=3)
    name = o.get("baseline_name")
    if baseline is not None:
        axes.axvline(baseline, color=BASELINE_COLOR, linestyle="--", linewidth=1, label=name)
    if uniform.size:
        axes.vlines(uniform, places - 0.4, places + 0.4, color=BASELINE_COLOR, linestyle="--", linewidth=1, label=name)
    axes.set_yticks(places, [shortened(str(label), 24 if style.paper else 44) for label in rows[o["label"]]])
    axes.tick_params(axis="y", length=0)
    axes.set_ylim(rows.height - 0.4, -0.6)
    axes.set_xlabel(str(o.get("xlabel", o["value"])))
    axes.grid(axis="x")
    _say_counts(axes, rows, style)
    _legend(axes, rows, o)
    return canvas


def _bounds(rows: pl.DataFrame, name: str) -> tuple[NDArray[np.float64], ...]:
    """Values and both ends of their intervals; the value itself where there is none."""
    value = rows[name].cast(pl.Float64).to_numpy()
    ends = (
        rows.select(pl.coalesce(pl.col(f"{name}_{end}", name)).cast(pl.Float64)).to_series().to_numpy()
        if f"{name}_{end}" in rows.columns
        else value
        for end in ("low", "high")
    )
    return value, *ends


def _dots(axes: Axes, rows: pl.DataFrame, dots: pl.DataFrame, o: Any) -> None:
    """Single episodes, around the middle of their row."""
    generator = np.random.default_rng(0)
    for place, label in enumerate(rows[o["label"]]):
        of_row = dots.filter(pl.col(o["label"]) == label)[o["value"]].drop_nulls().to_numpy()
        axes.scatter(of_row, scattered(generator, place, len(of_row)), s=9, color=DOT_COLOR, linewidths=0, zorder=2,
                     label="one episode" if place == 0 else None)  # fmt: skip


def _colors_of(rows: pl.DataFrame, o: Any) -> list[str]:
    if "color" not in o:
        return [SERIES_COLORS[0]] * rows.height
    kinds = rows[o["color"]].unique(maintain_order=True).to_list()
    given = o.get("colors", {})
    of = {kind: given.get(kind, SERIES_COLORS[i % len(SERIES_COLORS)]) for i, kind in enumerate(kinds)}
    return [of[kind] for kind in rows[o["color"]]]


def _say_counts(axes: Axes, rows: pl.DataFrame, style: Style) -> None:
    """How many episodes: once where all rows have as many (in a paper the caption says it), else beside each row."""
    if "num_episodes" not in rows.columns:
        return
    counts = rows["num_episodes"].to_list()
    small: Any = {"color": NOTE_COLOR, "size": 7}
    if len(set(counts)) == 1:
        if style.paper:
            return
        axes.text(1.0, 1.01, f"n = {counts[0]} episodes", transform=axes.transAxes, ha="right", **small)
        return
    axes.text(1.01, -0.75, "n", transform=axes.get_yaxis_transform(), va="center", **small)
    for place, count in enumerate(counts):
        axes.text(1.01, place, str(count), transform=axes.get_yaxis_transform(), va="center", **small)


def _legend(axes: Axes, rows: pl.DataFrame, o: Any) -> None:
    handles, labels = axes.get_legend_handles_labels()
    if "color" in o:
        names = o.get("names", {})
        for kind, color in dict(zip(rows[o["color"]], _colors_of(rows, o), strict=True)).items():
            handles.append(axes.plot([], [], "o", color=color, markersize=4)[0])
            labels.append(str(names.get(kind, kind)))
    if handles:
        _legend_above(axes, handles, labels)


def _legend_above(axes: Axes, handles: Sequence[Any], labels: Sequence[str]) -> None:
    figure = axes.get_figure(root=True)
    width = 8.4 if figure is None else figure.get_figwidth()
    columns = 4 if width > 6 else 3 if width > 4 else 2
    axes.legend(handles, labels, loc="lower left", bbox_to_anchor=(0, 1), ncols=columns, borderaxespad=0.1,
                handlelength=1.4, columnspacing=1.0)  # fmt: skip


def _lines(figure: Figure, style: Style) -> Canvas:
    o: Any = figure.options
    rows = figure.frame.filter(pl.col(o["value"]).is_not_null())
    canvas = new_canvas(style.width(wide=False), style.scaled(3.6))
    _titled(canvas, figure, style)
    axes = canvas.subplots()
    if rows.is_empty():
        explain(axes, "There is nothing to draw.")
        return canvas
    names = rows[o["color"]].unique(maintain_order=True).to_list() if "color" in o else [None]
    styles = group_styles([str(name) for name in names]) if "color" in o else {"None": {"color": SERIES_COLORS[0]}}
    for name in names:
        part = rows if name is None else rows.filter(pl.col(o["color"]) == name)
        x, (value, low, high) = part[o["x"]].to_numpy(), _bounds(part, o["value"])
        color = o.get("colors", {}).get(name) or styles[str(name)]["color"]
        axes.plot(x, value, "o-", color=color, markersize=3, label=None if name is None else str(name))
        axes.fill_between(x, low, high, color=color, alpha=0.18, linewidth=0)
    if "uniform" in o:
        part = rows.filter(pl.col(o["uniform"]).is_not_null()).unique(o["x"], maintain_order=True)
        axes.plot(part[o["x"]], part[o["uniform"]], "--", color=BASELINE_COLOR, linewidth=1, label=BASELINE_NAME)
    if o.get("log"):
        uniform = rows[o["uniform"]].drop_nulls().to_list() if "uniform" in o else []
        value, low, high = _bounds(rows, o["value"])
        # A band that runs far beyond all values is cut at the frame.
        ends = np.clip([low, high], value.min() / 3, value.max() * 3).ravel()
        ratio_axis(axes.yaxis, np.concatenate([value, ends, uniform]))
    else:
        axes.set_ylim(bottom=0)
    if rows[o["x"]].dtype.is_integer():
        whole_numbers(axes.xaxis)
    axes.set_xlabel(str(o.get("xlabel", o["x"])))
    axes.set_ylabel(str(o.get("ylabel", o["value"])))
    axes.grid(axis="y")
    if "num_episodes" in rows.columns and rows["num_episodes"].n_unique() == 1:
        _say_counts(axes, rows, style)
    handles, labels = axes.get_legend_handles_labels()
    if handles:
        _legend_above(axes, handles, labels)
    return canvas


def _stacked(figure: Figure, style: Style) -> Canvas:
    o: Any = figure.options
    rows = figure.frame.filter(pl.col(o["value"]).is_not_null())
    names = rows.filter(pl.col(o["value"]) > 0)[o["color"]].unique(maintain_order=True).to_list()
    places = rows[o["x"]].unique(maintain_order=True).to_list()
    canvas = new_canvas(style.width(wide=False), style.scaled(3.8))
    _titled(canvas, figure, style)
    axes = canvas.subplots()
    styles, bottom = group_styles(names), np.zeros(len(places))
    for name in names:
        part = dict(rows.filter(pl.col(o["color"]) == name).select(o["x"], o["value"]).iter_rows())
        values = np.array([part.get(place, 0.0) for place in places])
        axes.bar(range(len(places)), values, 0.8, bottom, facecolor=styles[name]["color"], hatch=styles[name]["hatch"],
                 edgecolor="white", linewidth=0.4, label=shortened(name, 26))  # fmt: skip
        bottom = bottom + values
    label_positions(axes.xaxis, [str(place) for place in places], 24)
    axes.set_ylim(0, max(1.0, float(bottom.max(initial=0))))
    share_ticks(axes.yaxis, 6)
    axes.set_xlabel(str(o.get("xlabel", o["x"])))
    axes.set_ylabel(str(o.get("ylabel", o["value"])))
    handles, labels = axes.get_legend_handles_labels()
    canvas.legend(handles[::-1], labels[::-1], loc="outside right center")
    return canvas


def _distribution(figure: Figure, style: Style) -> Canvas:
    o: Any = figure.options
    rows = figure.frame.filter(pl.col(o["value"]).is_finite())
    if o.get("log"):
        rows = rows.filter(pl.col(o["value"]) > 0)
    places = rows[o["x"]].unique(maintain_order=True).to_list()
    canvas = new_canvas(style.width(wide=False), style.scaled(3.8))
    _titled(canvas, figure, style)
    axes = canvas.subplots()
    if rows.is_empty():
        explain(axes, "No value is finite and positive: there is nothing to draw.")
        return canvas
    generator = np.random.default_rng(0)
    for place, name in enumerate(places):
        values = rows.filter(pl.col(o["x"]) == name)[o["value"]].to_numpy()
        # Percentiles throughout, not multiples of the interquartile range: they mean the same on a logarithmic axis.
        least, low, middle, high, most = np.quantile(values, [0.05, 0.25, 0.5, 0.75, 0.95])
        axes.plot([place, place], [least, most], "_-", color=SERIES_COLORS[0], linewidth=0.9, markersize=6, zorder=1)
        axes.bar(place, high - low, 0.6, low, color="#CFE3F1", edgecolor=SERIES_COLORS[0], linewidth=0.9, zorder=2)
        axes.plot([place - 0.3, place + 0.3], [middle, middle], color=SERIES_COLORS[1], linewidth=1.4, zorder=4)
        if len(values) <= _MOST_DOTS:
            axes.scatter(scattered(generator, place, len(values), 0.2), values, s=6, color="#333333", alpha=0.55,
                         linewidths=0, zorder=5)  # fmt: skip
    uniform = rows[o["uniform"]].drop_nulls().to_numpy() if "uniform" in o else np.array([])
    if o.get("log"):
        ratio_axis(axes.yaxis, np.concatenate([rows[o["value"]].to_numpy(), uniform]))
    if uniform.size:
        axes.axhspan(uniform.min(), uniform.max(), color="#E6E6E6", linewidth=0, zorder=0)
        axes.axhline(float(np.median(uniform)), color=BASELINE_COLOR, linestyle="--", linewidth=1, label=BASELINE_NAME)
        _legend_above(axes, *axes.get_legend_handles_labels())
    label_positions(axes.xaxis, [str(place) for place in places], 24)
    axes.set_xlabel(str(o.get("xlabel", o["x"])))
    axes.set_ylabel(str(o.get("ylabel", o["value"])))
    axes.grid(axis="y")
    return canvas


def _heat_map(figure: Figure, style: Style) -> Canvas:
    o: Any = figure.options
    frame = figure.frame
    columns, lines = (frame[o[axis]].unique(maintain_order=True).to_list() for axis in ("x", "y"))
    values = np.full((len(lines), len(columns)), np.nan)
    for x, y, value in frame.select(o["x"], o["y"], o["value"]).iter_rows():
        with np.errstate(divide="ignore"):
            values[lines.index(y), columns.index(x)] = np.nan if value is None else np.log2(value)
    canvas = new_canvas(style.width(wide=False), style.scaled(1.3 + min(6.0, 0.3 * len(lines))))
    _titled(canvas, figure, style)
    axes = canvas.subplots()
    certain = np.zeros(values.shape, dtype=bool)
    draw_log2_map(canvas, axes, values, certain, str(o.get("label", o["value"])))
    label_axis(axes, "x", [str(column) for column in columns])
    label_axis(axes, "y", [str(line) for line in lines])
    axes.set_xlabel(str(o.get("xlabel", o["x"])))
    axes.set_ylabel(str(o.get("ylabel", o["y"])))
    return canvas


def _scatter(figure: Figure, style: Style) -> Canvas:
    o: Any = figure.options
    rows = figure.frame.filter(pl.col(o["x"]).is_not_null() & pl.col(o["y"]).is_not_null())
    canvas = new_canvas(style.width(wide=False), style.scaled(4.2))
    _titled(canvas, figure, style)
    axes = canvas.subplots()
    if rows.is_empty():
        explain(axes, "There is nothing to draw.")
        return canvas
    (x, left, right), (y, low, high) = _bounds(rows, o["x"]), _bounds(rows, o["y"])
    colors = _colors_of(rows, o)
    axes.hlines(y, left, right, color=colors, linewidth=1)
    axes.vlines(x, low, high, color=colors, linewidth=1)
    axes.scatter(x, y, c=colors, s=18, zorder=3)
    for at, up, label in zip(x, y, rows[o["label"]], strict=True):
        axes.annotate(shortened(str(label), 24), (at, up), (4, 3), textcoords="offset points", size=7)
    if o.get("log"):
        ratio_axis(axes.xaxis, np.concatenate([x, left, right]))
        ratio_axis(axes.yaxis, np.concatenate([y, low, high]))
    axes.set_xlabel(str(o.get("xlabel", o["x"])))
    axes.set_ylabel(str(o.get("ylabel", o["y"])))
    axes.grid()
    _legend(axes, rows, o)
    return canvas


_KINDS: dict[str, Callable[[Figure, Style], Canvas]] = {
    "forest": _forest,
    "lines": _lines,
    "stacked": _stacked,
    "distribution": _distribution,
    "heat_map": _heat_map,
    "scatter": _scatter,
    "pictures": pictures,
}
