"""`attention_and_effect`: does attention to a group say what the action does without it? A point per group."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import polars as pl

from vla_attention.analyze.effects.conditions import Kind
from vla_attention.analyze.effects.effect_study import EffectStudy
from vla_attention.analyze.effects.group_rows import GroupRow, group_rows
from vla_attention.analyze.effects.plot_effects import bounded_axis
from vla_attention.analyze.show.numbers import interval_name, of_tasks
from vla_attention.analyze.show.plot_axes import legend_above, uniform_line
from vla_attention.analyze.show.plot_colours import DATA_COLOR
from vla_attention.analyze.show.plot_style import drawn_in_our_style, new_figure, save_figure
from vla_attention.analyze.show.plot_text import broken, explain, title
from vla_attention.analyze.statistics.intervals import DEFAULT_LEVEL

if TYPE_CHECKING:
    from matplotlib.axes import Axes

STEM = "attention_and_effect"
_NOISE_COLOR = "#C9B8D8"
_LABELS = {"mass": "mass of its attention (log)", "lift": "lift of its attention (log; 1: uniform)"}
#: Sizes of the names, in widths and heights of the axes: of a character, of the gap to a point, of a line.
_CHARACTER, _GAP, _LINE = 0.0155, 0.014, 0.042
#: What is drawn over what: bars, names on their white ground, points.
_BARS, _NAMES, _POINTS = 2.0, 3.0, 4.0
#: Where a name may stand: right or left of its point, and how many lines above it. Beside the bars before across one.
_PLACES = (("left", 0.6), ("right", 0.6), ("left", -0.6), ("right", -0.6), ("left", 0.0), ("right", 0.0), ("left", 1.3))
#: Left, right, bottom and top, in widths and heights of the axes.
_Box = tuple[float, float, float, float]


@drawn_in_our_style
def plot_attention_and_effect(study: EffectStudy, folder: Path) -> list[Path]:
    """Draw groups by mass and by lift (x) and by the effect of knocking them out (y); returns png, pdf and csv."""
    rows = [row for row in group_rows(study) if row.without is not None and row.attention["mass"]]
    figure = new_figure(9.4, 4.6)
    n = of_tasks(*study.measured)
    note = (
        f"Each point: a group of keys that was knocked out; n = {n}. Bars: {interval_name(DEFAULT_LEVEL)}s, about "
        f"{study.question.units.words}. Attention is the base's, in the same replans. "
        "Larger groups have more mass by their size alone. Names stand where there is room; very long bars are cut."
    )
    title(figure, "Attention to a group, and what the action does without it", note)
    table = _table(rows)
    if not rows:
        explain(figure.subplots(), "No group was knocked out that has attention in the base.")
        return save_figure(figure, folder, STEM, table)
    panels = figure.subplots(1, 2, sharey=True)
    for axes, measure in zip(panels, ("mass", "lift"), strict=True):
        _panel(axes, rows, measure, [study.of(one) for one in study.of_kind(Kind.NOISE)])
    panels[0].set_ylabel("effect without it (standard deviations)")
    # A few long intervals must not squeeze all points into the lower edge.
    largest = [row.without["effect"] for row in rows if row.without is not None]
    panels[0].set_ylim(0, 1.4 * max([*largest, *(study.of(one)["effect"] for one in study.of_kind(Kind.NOISE))]) or 1)
    for axes, measure in zip(panels, ("mass", "lift"), strict=True):
        _name_points(axes, [row for row in rows if row.attention[measure]], measure)
    return save_figure(figure, folder, STEM, table)


def _panel(axes: Axes, rows: list[GroupRow], measure: str, noise: list[dict[str, Any]]) -> None:
    shown = [row.without for row in rows if row.without is not None and row.without[measure]]
    if not shown:
        explain(axes, f"no group has a {measure}")
        return
    bounded_axis(axes.xaxis, shown, measure, *([1.0] if measure == "lift" else []))
    for row in noise:
        if row["effect_low"] is not None and row["effect_high"] is not None:
            axes.axhspan(row["effect_low"], row["effect_high"], color=_NOISE_COLOR, alpha=0.55, linewidth=0, zorder=-1)
        axes.axhline(row["effect"], color="#6A4C93", linewidth=1.1, linestyle=":", label="another noise seed")
    for row in shown:
        for name, across in ((measure, True), ("effect", False)):
            low, high = row[f"{name}_low"], row[f"{name}_high"]
            if low is not None and high is not None:
                along = [row["effect"]] * 2 if across else [row[measure]] * 2
                x, y = ([low, high], along) if across else (along, [low, high])
                axes.plot(x, y, color=DATA_COLOR, linewidth=0.9, alpha=0.6, zorder=_BARS)
        axes.plot(row[measure], row["effect"], "o", color=DATA_COLOR, markersize=5, zorder=_POINTS)
    if measure == "lift":
        uniform_line(axes, along="x")
    if noise and measure == "mass":
        legend_above(axes)
    axes.set_xlabel(_LABELS[measure])
    axes.grid()


def _name_points(axes: Axes, rows: list[GroupRow], measure: str) -> None:
    """Names beside points where there is room, those of larger effects first.

    A name covers no other name and no point. It stands where the fewest bars are, on a white ground over them.
    """
    (left, right), (bottom, top) = np.log(axes.get_xlim()), axes.get_ylim()

    def across(value: float) -> float:
        return float((np.log(value) - left) / (right - left))

    def up(effect: float) -> float:
        return (effect - bottom) / (top - bottom)

    shown = [(row.label, row.without) for row in rows if row.without is not None]
    places = [(across(row[measure]), up(row["effect"])) for _, row in shown]
    points = [(x - _GAP / 2, x + _GAP / 2, y - _LINE / 4, y + _LINE / 4) for x, y in places]
    bars: list[_Box] = []
    for (_, row), (x, y) in zip(shown, places, strict=True):
        if row[f"{measure}_low"] is not None and row[f"{measure}_high"] is not None:
            bars.append((across(row[f"{measure}_low"]), across(row[f"{measure}_high"]), y, y))
        if row["effect_low"] is not None and row["effect_high"] is not None:
            bars.append((x, x, up(row["effect_low"]), up(row["effect_high"])))
    names: list[_Box] = []
    for (name, _), (x, y) in sorted(zip(shown, places, strict=True), key=lambda item: -item[1][1]):
        text = broken(name, 24)
        lines_of_name = text.split("\n")
        width, tall = _CHARACTER * max(map(len, lines_of_name)), _LINE * len(lines_of_name)
        tried: list[tuple[int, str, float, _Box]] = []
        for align, lines in _PLACES:
            start, height = x + _GAP if align == "left" else x - _GAP - width, y + lines * _LINE
            box = (start, start + width, height - tall / 2, height + tall / 2)
            inside = box[0] >= 0 and box[1] <= 1 and box[2] >= 0 and box[3] <= 1
            if inside and not any(_overlap(box, other) for other in (*names, *points)):
                tried.append((sum(_overlap(box, bar) for bar in bars), align, height, box))
        if tried:
            _, align, height, box = min(tried, key=lambda place: place[0])
            axes.text(
                box[0] if align == "left" else box[1],
                height,
                text,
                transform=axes.transAxes,
                ha=align,
                va="center",
                size=7,
                zorder=_NAMES,
                bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.4},
            )
            names.append(box)


def _overlap(one: _Box, other: _Box) -> bool:
    return one[0] <= other[1] and other[0] <= one[1] and one[2] <= other[3] and other[2] <= one[3]


def _table(rows: list[GroupRow]) -> pl.DataFrame:
    names = [f"{name}{end}" for name in ("mass", "lift", "norm", "effect") for end in ("", "_low", "_high")]
    plotted = [
        {"group": row.label, "num_episodes": row.without["num_episodes"], "keys": row.without["keys"]}
        | {name: row.without[name] for name in names}
        for row in rows
        if row.without is not None
    ]
    schema: dict[str, Any] = {"group": pl.String, "num_episodes": pl.Int64}
    return pl.DataFrame(plotted, schema=schema | dict.fromkeys(("keys", *names), pl.Float64))
