"""Pictures of frames: a function for each kind. A command names the kind and the columns; nothing here knows commands.

The options of a figure, by kind:

    forest   value, label: columns. color: a column of categories, with `colors` (category -> colour) and `names`
             (category -> text). log: a logarithmic axis. baseline, baseline_name: the line of no effect. xlabel.
             NAME_low and NAME_high of the value are its interval; `num_episodes`, if there is one, is said.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import polars as pl

from vla_attention.analyze.core.result import Figure
from vla_attention.analyze.render.style import Style, new_canvas, save_canvas
from vla_attention.analyze.show.plot_axes import ratio_axis
from vla_attention.analyze.show.plot_colours import BASELINE_COLOR, NOTE_COLOR, SERIES_COLORS
from vla_attention.analyze.show.plot_text import explain, shortened, wrapped

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Canvas

#: Rows of a forest; the table has all.
_MOST_ROWS = 60


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
    canvas = new_canvas(style.width(wide=False), style.scaled(1.2 + (0.19 if rows.height > 30 else 0.26) * rows.height))
    _titled(canvas, figure, style)
    axes = canvas.subplots()
    if rows.is_empty():
        explain(axes, "There is nothing to draw.")
        return canvas
    value = rows[o["value"]].to_numpy()
    low, high = (
        rows[f"{o['value']}_{end}"].cast(pl.Float64).to_numpy() if f"{o['value']}_{end}" in rows.columns else value
        for end in ("low", "high")
    )
    baseline = o.get("baseline")
    if o.get("log"):
        ratio_axis(axes.xaxis, np.concatenate([value, low[low > 0], high[np.isfinite(high)], [baseline or 1.0]]))
    left, right = axes.get_xlim() if o.get("log") else (-np.inf, np.inf)
    places = np.arange(rows.height)
    colors = _colors_of(rows, o)
    axes.hlines(places, np.clip(low, left, right), np.clip(high, left, right), color=colors, linewidth=2)
    axes.scatter(value, places, c=colors, s=20, zorder=3)
    if baseline is not None:
        axes.axvline(baseline, color=BASELINE_COLOR, linestyle="--", linewidth=1, label=o.get("baseline_name"))
    axes.set_yticks(places, [shortened(str(label), 24 if style.paper else 40) for label in rows[o["label"]]])
    axes.tick_params(axis="y", length=0)
    axes.set_ylim(rows.height - 0.4, -0.6)
    axes.set_xlabel(str(o.get("xlabel", o["value"])))
    axes.grid(axis="x")
    _say_counts(axes, rows)
    _legend(axes, rows, o)
    return canvas


def _colors_of(rows: pl.DataFrame, o: Any) -> list[str]:
    if "color" not in o:
        return [SERIES_COLORS[0]] * rows.height
    kinds = rows[o["color"]].unique(maintain_order=True).to_list()
    given = o.get("colors", {})
    of = {kind: given.get(kind, SERIES_COLORS[i % len(SERIES_COLORS)]) for i, kind in enumerate(kinds)}
    return [of[kind] for kind in rows[o["color"]]]


def _say_counts(axes: Axes, rows: pl.DataFrame) -> None:
    """How many episodes: once where all rows have as many, else beside each row."""
    if "num_episodes" not in rows.columns:
        return
    counts = rows["num_episodes"].to_list()
    if len(set(counts)) == 1:
        axes.text(
            1.0, 1.01, f"n = {counts[0]} episodes", transform=axes.transAxes, ha="right", color=NOTE_COLOR, size=7
        )
        return
    for place, count in enumerate(counts):
        axes.text(
            1.01, place, f"n = {count}" if place == 0 else str(count), transform=axes.get_yaxis_transform(),
            va="center", color=NOTE_COLOR, size=7,
        )  # fmt: skip


def _legend(axes: Axes, rows: pl.DataFrame, o: Any) -> None:
    handles, labels = axes.get_legend_handles_labels()
    if "color" in o:
        names = o.get("names", {})
        for kind, color in dict(zip(rows[o["color"]], _colors_of(rows, o), strict=True)).items():
            handles.append(axes.plot([], [], "o", color=color, markersize=4)[0])
            labels.append(str(names.get(kind, kind)))
    if len(handles) > 1 or "color" in o:
        axes.legend(
            handles, labels, loc="lower left", bbox_to_anchor=(0, 1), ncols=4, borderaxespad=0.1, handlelength=1.2,
            columnspacing=1.0,
        )  # fmt: skip


_KINDS: dict[str, Callable[[Figure, Style], Canvas]] = {"forest": _forest}
