"""Pictures of frames: a function for each kind. A command names the kind and the columns; nothing here knows commands.

The options of a figure, by kind:

    forest        value, label: columns. color: a column of categories, with `colors` (category -> colour) and `names`
                  (category -> text). baseline: the line of no effect, or `uniform`, a column with one for each row;
                  baseline_name. dots: a frame of label and value, single episodes. log: a logarithmic axis. xlabel.
    lines         x, value; color: a column of series. uniform: a column, drawn dashed. log, xlabel, ylabel.
    courses       x from 0 to 1, value, label: a column of series, each in a strip of its own, on a logarithmic axis.
                  reference: the series that all strips show. color, colors, names: as of a forest. xlabel, ylabel.
    stacked       x, value, color: a column of parts, which are stacked in their order. mean: the x of all others
                  together, drawn apart, whose values the legend says. num_episodes. ylabel, xlabel.
    distribution  x, value: a box for each x, with a dot for each row. uniform, log, xlabel, ylabel.
    heat_map      x, y, value: factors around 1, or shares with share=True, from `low` on. xlabel, ylabel,
                  label. beside: y -> a picture (row, column, 3), which stands left of its row.
    scatter       x, y, label: points with names, y_low and y_high as bars; both axes are logarithmic. color, colors,
                  names, baseline (of y), baseline_name: as of a forest. x_baseline, xlabel, ylabel.
    pictures      see `render.pictures`.

NAME_low and NAME_high of a value are its interval; `num_episodes`, if the frame has it, is said.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.core.result import Column, Figure
from vla_attention.analyze.render.files import replacing
from vla_attention.analyze.render.numbers import cell
from vla_attention.analyze.render.pictures import pictures
from vla_attention.analyze.render.point_names import name_points
from vla_attention.analyze.render.style import (
    BASELINE_COLOR,
    DOT_COLOR,
    NOTE_COLOR,
    SERIES_COLORS,
    Style,
    explain,
    group_styles,
    is_narrow,
    label_positions,
    letters,
    ratio_axis,
    scattered,
    share_ticks,
    whole_numbers,
    wrapped,
)
from vla_attention.analyze.render.terminal import shortened

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Canvas

#: Columns and looks of a figure.
Options: TypeAlias = Mapping[str, Any]
#: Rows of a forest; the table has all.
_MOST_ROWS = 60
#: With more values than this a box has no dots.
_MOST_DOTS = 300
#: More labels than this along an axis would touch.
_MOST_LABELS = 24
#: A forest with more rows than this has low ones; so many points need high axes.
_MOST_HIGH_ROWS, _MANY_POINTS = 30, 16
#: Of a row's height, the interval stands so far above its middle where episodes are below it.
_ABOVE_DOTS = 0.16
#: Of the room for a series, its strip; of the width of a bar, the gap before the one of all others together.
_STRIP, _APART = 0.84, 0.7
#: What the line of attention without a preference is called, in every picture.
BASELINE_NAME = "if spread evenly"

_FOR_LATEX = str.maketrans({
    "\\": r"\textbackslash{}", "{": r"\{", "}": r"\}", "$": r"\$", "&": r"\&", "#": r"\#", "_": r"\_", "%": r"\%",
    "~": r"\textasciitilde{}", "^": r"\textasciicircum{}",
})  # fmt: skip


def draw(figure: Figure, style: Style | None = None) -> Canvas:
    """The picture as a matplotlib figure."""
    style = style or Style()
    with style.settings():
        return _plot(figure, style)


def content(figure: Figure, style: Style, kinds: Sequence[str]) -> tuple[list[bytes], float]:
    """The picture as the bytes of a file of each kind, and its width in inches."""
    with style.settings():  # once: ticks are made at drawing, and matplotlib's settings take long to change
        canvas = _plot(figure, style)
        return [style.content(canvas, kind) for kind in kinds], canvas.get_figwidth()


def save(figure: Figure, folder: Path, style: Style | None = None, formats: Sequence[str] = ()) -> list[Path]:
    """Draw into a folder: NAME.png (and other formats), for a paper NAME_caption.md and .tex too; returns the paths."""
    style = style or Style()
    # A paper's pictures are vectors; the PNG is to look at.
    kinds = formats or (("png", "pdf") if style.paper else ("png",))
    contents, _ = content(figure, style, kinds)
    files = {f"{figure.name}.{kind}": one for kind, one in zip(kinds, contents, strict=True)}
    if style.paper:
        caption = f"{figure.title}. {figure.caption}".strip()
        files[f"{figure.name}_caption.md"] = f"{caption}\n".encode()
        files[f"{figure.name}_caption.tex"] = f"\\caption{{{caption.translate(_FOR_LATEX)}}}\n".encode()
    for name, one in files.items():
        with replacing(folder / name) as temporary:
            temporary.write_bytes(one)
    return [folder / name for name in files]


def _plot(figure: Figure, style: Style) -> Canvas:
    if figure.kind == "pictures":
        return pictures(figure, style)
    o: Options = figure.options
    rows = figure.frame
    if figure.kind not in ("lines", "heat_map"):  # these show where a value is missing
        measured = [o["value"]] if "value" in o else [o["x"], o["y"]]
        values = [pl.col(name).cast(pl.Float64) for name in measured]
        positive = o.get("log") or figure.kind in ("courses", "scatter")
        rows = rows.filter(value.is_finite() & ((value > 0) | (not positive)) for value in values)
    rows = rows.head(_MOST_ROWS) if figure.kind == "forest" else rows
    canvas = style.canvas(style.width(wide=False), 1)
    axes, height = canvas.add_subplot(), 1.0
    if rows.is_empty() or (figure.kind == "lines" and not rows[o["value"]].cast(pl.Float64).is_finite().any()):
        explain(axes, "No value is finite and positive: there is nothing to draw.")
    else:
        height = _KINDS[figure.kind](axes, rows, o)
        xlabel = o.get("xlabel", o["value"] if figure.kind == "forest" else o["x"])
        axes.set_xlabel(wrapped(xlabel, int((8 if figure.kind == "forest" else 10) * canvas.get_figwidth()), 2))
        axes.set_ylabel(o.get("ylabel", "" if figure.kind == "forest" else o.get("y") or o["value"]))
        if figure.kind in ("forest", "lines", "scatter") and "num_episodes" in rows.columns:
            _say_counts(axes, rows["num_episodes"].to_list(), style)
        elif "num_episodes" in o:
            _say_counts(axes, [o["num_episodes"]], style)
        if figure.kind == "stacked":
            axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), reverse=True, borderaxespad=0, handlelength=1.4,
                        labelspacing=0.4, alignment="left", title="all [95% interval]" if "mean" in o else None,
                        title_fontsize=7)  # fmt: skip
    _framed(canvas, figure, height, style)
    if figure.kind == "scatter" and rows.height:
        name_points(axes, rows[o["label"]].to_list(), rows[o["x"]].to_numpy(), *_bounds(rows, o["y"]))
    return canvas


def _framed(canvas: Canvas, figure: Figure, height: float, style: Style) -> None:
    """Title and legend above the axes, which get `height` inches of a screen, and everything in its place.

    A paper has no title: its caption file has it. Sizes are counted in letters; only the axes' own texts are measured.
    """
    handles, labels = canvas.axes[0].get_legend_handles_labels() if canvas.axes[0].get_legend() is None else ([], [])
    width, letter = canvas.get_figwidth(), 0.062 if style.paper else 0.07
    lengths = [0.42 + letter * len(label) for label in labels]
    columns = len(labels) if sum(lengths) < width - 0.1 else max(1, int((width - 0.1) / max(lengths)))
    said = wrapped(figure.title, int(13 * width), 2)
    title = 0.05 if style.paper else 0.28 + 0.16 * said.count("\n")
    top = title + (0.17 * -(-len(labels) // columns) if labels else 0)
    whole = top + height * (0.72 if style.paper else 1)
    canvas.set_figheight(whole)
    if not style.paper:
        canvas.text(0.08 / width, 1 - 0.07 / whole, said, va="top", size=10)
    if handles:
        canvas.legend(handles, labels, loc="upper left", bbox_to_anchor=(0.03 / width, 1 - title / whole),
                      ncols=columns, borderaxespad=0, handlelength=1.4, columnspacing=1.0, borderpad=0.1)  # fmt: skip
    # Labels are measured once: layouts of matplotlib measure them several times, which takes longer than all else.
    axes = canvas.axes[0]
    axes.set_position((0.1, 0.1, 0.8, 0.8))
    outer: Any = axes.get_tightbbox(for_layout_only=True)
    room = np.abs(outer.extents - axes.get_window_extent().extents) / canvas.dpi + 0.06
    left, bottom, right, over = room / (width, whole, width, whole)
    axes.set_position((left, bottom, 1 - left - right, 1 - bottom - over - top / whole))


def _forest(axes: Axes, rows: pl.DataFrame, o: Options) -> float:
    value, low, high = _bounds(rows, o["value"])
    uniform = rows[o["uniform"]].cast(pl.Float64).to_numpy() if "uniform" in o else np.array([])
    baseline, dots, name = o.get("baseline"), o.get("dots"), o.get("baseline_name")
    places, colors = np.arange(rows.height), _colors_of(axes, rows, o)
    at = places.astype(np.float64)
    if dots is not None:
        at -= _ABOVE_DOTS * _dots(axes, rows, dots, o)
    if o.get("log"):
        single = dots[o["value"]].drop_nulls().to_numpy() if dots is not None else np.array([])
        fixed = [baseline] if baseline is not None else []
        ratio_axis(axes.xaxis, np.concatenate([value, low[low > 0], high[np.isfinite(high)], uniform, single, fixed]))
    left, right = axes.get_xlim() if o.get("log") else (-np.inf, np.inf)
    axes.hlines(at, np.clip(low, left, right), np.clip(high, left, right), color=colors, linewidth=2)
    axes.scatter(value, at, c=colors, s=20, zorder=3)
    line: Any = {"color": BASELINE_COLOR, "linestyle": "--", "linewidth": 1, "label": name}
    if baseline is not None:
        axes.axvline(baseline, **line)
    if uniform.size:
        axes.vlines(uniform, places - 0.4, places + 0.4, **line)
    few = rows.height <= _MOST_HIGH_ROWS
    names = [wrapped(str(label), letters(axes, 0.45), 1 + few) for label in rows[o["label"]]]
    axes.set_yticks(places, names, linespacing=1.0)
    axes.tick_params(axis="y", length=0)
    axes.set_ylim(rows.height - 0.4, -0.6)
    axes.grid(axis="x")
    row = 0.34 if any("\n" in one for one in names) else 0.28 if few and dots is not None else 0.21 if few else 0.17
    return (0.85 if is_narrow(axes) else 0.55) + row * max(rows.height, 2)


def _bounds(rows: pl.DataFrame, name: str) -> tuple[NDArray[np.float64], ...]:
    """Values and both ends of their intervals; the value itself where there is none."""
    ends = [
        pl.coalesce(f"{name}_{end}", name) if f"{name}_{end}" in rows.columns else pl.col(name)
        for end in ("low", "high")
    ]
    return tuple(rows.select(one.cast(pl.Float64)).to_series().to_numpy() for one in (pl.col(name), *ends))


def _dots(axes: Axes, rows: pl.DataFrame, dots: pl.DataFrame, o: Options) -> NDArray[np.bool_]:
    """Single episodes, below the interval of their row, which hides none; returns which rows have some."""
    generator, having = np.random.default_rng(0), np.zeros(rows.height, dtype=bool)
    for place, label in enumerate(rows[o["label"]]):
        of_row = dots.filter(pl.col(o["label"]) == label)[o["value"]].drop_nulls().to_numpy()
        having[place] = len(of_row)
        axes.scatter(of_row, scattered(generator, place + 0.26, len(of_row), 0.12), s=9, color=DOT_COLOR, alpha=0.8,
                     linewidths=0, zorder=2, label=None if place else "one episode")  # fmt: skip
    return having


def _colors_of(axes: Axes, rows: pl.DataFrame, o: Options) -> list[str]:
    """The colour of each row, and an entry of the legend for each category."""
    if "color" not in o:
        return [SERIES_COLORS[0]] * rows.height
    of = {
        kind: o.get("colors", {}).get(kind, SERIES_COLORS[i % len(SERIES_COLORS)])
        for i, kind in enumerate(rows[o["color"]].unique(maintain_order=True))
    }
    for kind, color in of.items():
        axes.plot([], [], "o", color=color, markersize=4, label=str(o.get("names", {}).get(kind, kind)))
    return [of[kind] for kind in rows[o["color"]]]


def _say_counts(axes: Axes, counts: Sequence[int | None], style: Style) -> None:
    """How many episodes: once where all rows have as many (in a paper the caption says it), else beside each row."""
    known = [count for count in counts if count is not None]
    small: Any = {"color": NOTE_COLOR, "size": 7}
    if known and axes.yaxis_inverted() and len(set(counts)) > 1:  # a forest
        for place, count in enumerate(counts):
            axes.text(1.01, place, str(count), transform=axes.get_yaxis_transform(), va="center", **small)
        axes.text(1.01, 1.0, "n", transform=axes.transAxes, **small)
    elif known and not (style.paper and len(set(known)) == 1):
        n = f"{min(known)} to {max(known)}" if len(set(known)) > 1 else known[0]
        axes.text(1.0, 1.01, f"n = {n} episodes", transform=axes.transAxes, ha="right", **small)


def lines(axes: Axes, rows: pl.DataFrame, o: Options) -> float:
    """Lines over a numerical axis, broken where a value does not exist."""
    names = rows[o["color"]].unique(maintain_order=True).to_list() if "color" in o else [None]
    styles = group_styles([str(name) for name in names]) if "color" in o else {"None": {"color": SERIES_COLORS[0]}}
    for name in names:
        part = rows if name is None else rows.filter(pl.col(o["color"]) == name)
        value, low, high = _bounds(part, o["value"])
        color = o.get("colors", {}).get(name) or styles[str(name)]["color"]
        shown = np.where(np.isfinite(value) & ((value > 0) | (not o.get("log"))), value, np.nan)
        axes.plot(part[o["x"]], shown, "o-", color=color, markersize=3, label=None if name is None else str(name))
        axes.fill_between(
            part[o["x"]].to_numpy(), low, high, color=color, alpha=0.18 if len(names) < 4 else 0.08, linewidth=0
        )
    if "uniform" in o:
        part = rows.filter(pl.col(o["uniform"]).is_not_null()).unique(o["x"], maintain_order=True)
        axes.plot(part[o["x"]], part[o["uniform"]], "--", color=BASELINE_COLOR, linewidth=1, label=BASELINE_NAME)
    if o.get("log"):
        uniform = rows[o["uniform"]].drop_nulls().to_list() if "uniform" in o else []
        _log_axis(axes, rows[o["x"]].to_numpy(), _bounds(rows, o["value"]), uniform)
    else:
        axes.set_ylim(bottom=0)
    if rows[o["x"]].dtype.is_integer():
        whole_numbers(axes.xaxis)
    axes.grid(axis="y")
    return 3.0


def _log_axis(axes: Axes, x: NDArray[Any], bounds: Sequence[NDArray[np.float64]], more: Iterable[float]) -> None:
    """A logarithmic y axis around values; an interval far beyond them is cut at the frame, where a triangle says so."""
    value, low, high = bounds
    finite = value[np.isfinite(value) & (value > 0)]
    ends = np.clip([low, high], finite.min() / 3, finite.max() * 3).ravel()
    ratio_axis(axes.yaxis, np.concatenate([finite, ends, [*more]]))
    bottom, top = axes.get_ylim()
    for mark, cut, at in (("v", low < bottom, 0.015), ("^", high > top, 0.985)):
        axes.plot(x[cut], np.full(cut.sum(), at), mark, color=NOTE_COLOR, markersize=4, markeredgewidth=0, alpha=0.8,
                  clip_on=False, transform=axes.get_xaxis_transform())  # fmt: skip
    if (low < bottom).any() or (high > top).any():
        axes.plot([], [], "^", color=NOTE_COLOR, markersize=4, label="the interval goes on")


def _courses(axes: Axes, rows: pl.DataFrame, o: Options) -> float:
    """Bands of different series share no place, so that none hides another."""
    is_reference = rows[o["label"]] == o.get("reference", "")
    reference, rows = rows.filter(is_reference), rows.filter(~is_reference)
    series, colors = rows[o["label"]].to_numpy(), np.array(_colors_of(axes, rows, o))
    names: list[str] = list(dict.fromkeys(series))
    x = np.array([names.index(name) for name in series]) + _STRIP * (rows[o["x"]].to_numpy() - 0.5)
    bounds, (middle, least, most) = _bounds(rows, o["value"]), _bounds(reference, o["value"])
    _log_axis(axes, x, bounds, [*middle, *np.clip([least, most], middle / 3, middle * 3).ravel()])
    for place, name in enumerate(names):
        at = place + _STRIP * (reference[o["x"]].to_numpy() - 0.5)
        axes.plot(at, middle, "--", color=BASELINE_COLOR, linewidth=1,
                  label=o["reference"] if reference.height and not place else None)  # fmt: skip
        axes.fill_between(at, least, most, facecolor="none", edgecolor="#CCCCCC", hatch="//////", linewidth=0, zorder=0)
        here = series == name
        value, low, high = (ends[here] for ends in bounds)
        axes.fill_between(x[here], low, high, color=colors[here][0], alpha=0.25, linewidth=0)
        axes.plot(x[here], value, "o-", color=colors[here][0], markersize=2.5)
        axes.text(place, 1.01, f"n = {max(rows['num_episodes'].filter(here))}", transform=axes.get_xaxis_transform(),
                  ha="center", color=NOTE_COLOR, size=7)  # fmt: skip
        axes.axvline(place + 0.5, color="#E3E3E3", linewidth=0.7, zorder=0)
    room = letters(axes, 0.85 / len(names))
    turned = max(len(word) for name in names for word in name.split()) > room
    look: Any = {"rotation": 40, "ha": "right", "rotation_mode": "anchor"} if turned else {}
    axes.set_xticks(range(len(names)), [wrapped(name, 26 if turned else room, 3) for name in names], **look)
    axes.tick_params(axis="x", length=0)
    axes.set_xlim(-0.5, len(names) - 0.5)
    axes.grid(axis="y")
    return 3.0


def stacked(axes: Axes, rows: pl.DataFrame, o: Options) -> float:
    """Bars of parts that are stacked in their order."""
    names, mean = rows[o["color"]].unique(maintain_order=True).to_list(), o.get("mean")
    places = sorted(rows[o["x"]].unique(maintain_order=True).to_list(), key=lambda place: place == mean)
    x = np.array([i + _APART * (place == mean) for i, place in enumerate(places)])
    styles, bottom, between = group_styles(names), np.zeros(len(places)), "\n" if is_narrow(axes) else "  "
    for name in names:
        part = {row[o["x"]]: row for row in rows.filter(pl.col(o["color"]) == name).iter_rows(named=True)}
        values = np.array([part[place][o["value"]] if place in part else 0.0 for place in places])
        if not values.any():
            continue
        said = [cell(part[mean], Column(o["value"], "percent"))] if mean in part else []
        axes.bar(x, values, 0.8, bottom, facecolor=styles[name]["color"], hatch=styles[name]["hatch"],
                 edgecolor="white", linewidth=0.4, label=between.join([shortened(name, 26), *said]))  # fmt: skip
        bottom = bottom + values
    label_positions(axes.xaxis, [str(place) for place in places if place != mean], _most_labels(axes))
    if mean in places:
        ticks, labels = axes.get_xticks(), [text.get_text() for text in axes.get_xticklabels()]
        axes.set_xticks([*ticks, x[-1]], [*labels, "all"])
    axes.set_ylim(0, max(1.0, float(bottom.max(initial=0))))
    share_ticks(axes.yaxis)
    axes.set_xlim(-0.6, x[-1] + 0.6)
    return max(3.0, 0.2 * (1 + (1 + between.count("\n")) * len(names)))


def _distribution(axes: Axes, rows: pl.DataFrame, o: Options) -> float:
    places = rows[o["x"]].unique(maintain_order=True).to_list()
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
        axes.axhline(float(np.median(uniform)), color=BASELINE_COLOR, linestyle="--", linewidth=1, label=BASELINE_NAME)
        if (low := uniform.min()) < (high := uniform.max()):
            axes.axhspan(low, high, color="#E6E6E6", linewidth=0, zorder=0, label="its range over the episodes")
    label_positions(axes.xaxis, [str(place) for place in places], _most_labels(axes))
    axes.grid(axis="y")
    return 3.0


def _scatter(axes: Axes, rows: pl.DataFrame, o: Options) -> float:
    x, (y, low, high) = rows[o["x"]].cast(pl.Float64).to_numpy(), _bounds(rows, o["y"])
    colors = _colors_of(axes, rows, o)
    baseline, even = ([o[name]] if name in o else [] for name in ("baseline", "x_baseline"))
    ends = x.min(), x.max()
    room = (ends[1] / ends[0]) ** 0.08  # for names
    ratio_axis(axes.xaxis, [*even, ends[0] / room, ends[1] * room])
    _log_axis(axes, x, (y, low, high), baseline)
    axes.vlines(x, low, high, color=colors, linewidth=0.8, alpha=0.5)
    axes.scatter(x, y, c=colors, s=14, zorder=3)
    for at in even:
        axes.axvline(at, color=BASELINE_COLOR, linestyle=":", linewidth=0.8, label=BASELINE_NAME)
    for at in baseline:
        axes.axhline(at, color=BASELINE_COLOR, linestyle="--", linewidth=0.8, label=o.get("baseline_name"))
    axes.grid()
    return 3.4 if rows.height < _MANY_POINTS else 4.6


#: The colours of a map: less than uniform attention (as the linguistic group), as much, more (as the visual group), and
#: no value. They span at least this factor on either side of 1: tiny differences must not look large.
_STOPS, _NO_VALUE, _LEAST_FACTOR = ("#A63C00", "#E69A6B", "#F7F7F7", "#7FB2D3", "#00507D"), "#D9D9D9", 1.4
#: Height of a row with a picture, in inches.
_ROW = 0.42
#: With more cells than this, numbers in them could not be read; with more in a row, they would touch.
_MOST_NUMBERS, _MOST_NUMBERED_COLUMNS = 64, 12


def _heat_map(axes: Axes, rows: pl.DataFrame, o: Options) -> float:
    """Factors as colours around 1, the first row at the bottom; infinite ones and 0 have the ends of the colours.

    With `share` the values are shares: 0 to 1, from white on. In a small map every cell also shows its number.
    """
    from matplotlib.colors import LinearSegmentedColormap, LogNorm, Normalize

    columns, lines = (rows[o[axis]].unique(maintain_order=True).to_list() for axis in ("x", "y"))
    factors = np.full((len(lines), len(columns)), np.nan)
    for x, y, value in rows.select(o["x"], o["y"], o["value"]).drop_nulls().iter_rows():
        factors[lines.index(y), columns.index(x)] = value
    known = factors[np.isfinite(factors) & (factors > 0)]
    most = float(np.maximum(known, 1 / known).max(initial=_LEAST_FACTOR))
    shares = bool(o.get("share"))
    low, high = (o.get("low", 0.0), 1.0) if shares else (1 / most, most)
    shown, scale = np.clip(factors, low, high), Normalize(low, high) if shares else LogNorm(low, high)
    stops, written = (_STOPS[2:], _percent) if shares else (_STOPS, _factor)
    colors = LinearSegmentedColormap.from_list("less_more", stops).with_extremes(bad=_NO_VALUE)
    image = axes.imshow(shown, colors, scale, origin="lower", aspect="auto", interpolation="none")
    numbered = factors.size <= _MOST_NUMBERS and len(columns) <= _MOST_NUMBERED_COLUMNS
    for row, column in np.argwhere(np.isinf(factors) | (factors == 0) | (numbered & ~np.isnan(factors))):
        place = float(scale(shown[row, column]))
        ink = "white" if place > 0.8 or (place < 0.2 and not shares) else "black"
        axes.text(column, row, written(factors[row, column]), ha="center", va="center", color=ink, size=7)
    canvas: Any = axes.figure
    bar = canvas.colorbar(image, axes.inset_axes((1.02, 0.05, 0.025, 0.9)))
    if not shares:
        ratio_axis(bar.ax.yaxis, [low, high])
        bar.ax.set_ylim(low, high)
    bar.ax.yaxis.set_major_formatter(lambda value, _: written(value))
    bar.set_label(wrapped(o.get("label", o["value"]), 20, 3))
    bar.outline.set_visible(False)
    label_positions(axes.xaxis, [str(one) for one in columns], _most_labels(axes))
    beside = o.get("beside")
    label_positions(axes.yaxis, [wrapped(str(one), 36, 3) if beside else str(one) for one in lines], _MOST_LABELS)
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)
    if beside:
        _pictures_beside(axes, [beside[line] for line in lines])
        return 0.9 + _ROW * len(lines)
    return 0.9 + min(6.0, 0.3 * len(lines))


def _pictures_beside(axes: Axes, shown: Sequence[NDArray[np.uint8]]) -> None:
    """A picture between each row's label and its cells."""
    from matplotlib.offsetbox import AnnotationBbox, OffsetImage

    side = 0.9 * 72 * _ROW  # in points
    for row, picture in enumerate(shown):
        image = OffsetImage(picture, zoom=side / max(picture.shape[:2]))
        axes.add_artist(
            AnnotationBbox(
                image, (0, row), (-0.6 * side, 0), ("axes fraction", "data"), boxcoords="offset points", frameon=False,
                pad=0, annotation_clip=False,
            )
        )  # fmt: skip
    axes.tick_params(axis="y", pad=1.2 * side)


def _most_labels(axes: Axes) -> int:
    return min(_MOST_LABELS, letters(axes, 0.2))


def _percent(value: float) -> str:
    return f"{100 * value:.0f} %"


def _factor(value: float) -> str:
    """4, 1/4, 0 or ∞."""
    if value == 0 or np.isinf(value):
        return "∞" if value else "0"
    return f"{value:.3g}" if f"{value:.3g}" == "1" or value > 1 else f"1/{1 / value:.3g}"


#: Kind -> its function, which returns the inches that its axes are high.
_KINDS: dict[str, Callable[[Axes, pl.DataFrame, Options], float]] = {
    "forest": _forest, "lines": lines, "courses": _courses, "stacked": stacked, "distribution": _distribution,
    "heat_map": _heat_map, "scatter": _scatter,
}  # fmt: skip
