"""`effects_by_condition`: the change of the action in every condition, beside noise and attention."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import polars as pl

from vla_attention.analyze.effects.conditions import Condition, Kind, change_name, reader_of
from vla_attention.analyze.effects.effect_study import EffectStudy
from vla_attention.analyze.effects.group_rows import group_rows
from vla_attention.analyze.effects.item_rows import item_rows
from vla_attention.analyze.show.numbers import format_number, interval_name, of_tasks, row_interval
from vla_attention.analyze.show.plot_axes import legend_above, note_at_row, ratio_axis, uniform_line
from vla_attention.analyze.show.plot_colours import NOTE_COLOR, STRIPE_COLOR
from vla_attention.analyze.show.plot_style import drawn_in_our_style, new_figure, save_figure
from vla_attention.analyze.show.plot_text import broken, explain, title
from vla_attention.analyze.statistics.intervals import DEFAULT_LEVEL

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

STEM = "effects_by_condition"
#: Colour, marker and filling of each kind of point: told apart without colour, too.
_STYLES: dict[str, dict[str, Any]] = {
    "without": {"color": "#D55E00", "marker": "o", "label": "without it"},
    "direct": {"color": "#CC79A7", "marker": "v", "label": "for the action queries"},
    "only": {"color": "#0072B2", "marker": "s", "markerfacecolor": "white", "label": "with it alone"},
    "random": {"color": "#4D4D4D", "marker": "x", "label": "random keys"},
    "other": {"color": "#009E73", "marker": "D", "label": "other change"},
}
#: Points of one row stand a little apart.
_OFFSETS = {"without": -0.2, "direct": -0.07, "only": 0.2, "random": 0.07, "other": 0.0}
_NOISE_COLOR = "#C9B8D8"
#: Rows in the picture; the tables have all.
_MOST = 40
#: An interval of an attention that reaches further than this factor beyond all values is cut.
_MOST_REACH = 3.0
#: The same of effects.
_MOST_EFFECT = 1.5
#: Effects that differ by a larger factor are drawn on a logarithmic axis.
_WIDE = 50


@dataclass(frozen=True)
class _Row:
    """One row of the picture: its label, its points by kind, and the lift of its group."""

    label: str
    points: dict[str, dict[str, Any]]
    lift: dict[str, Any] | None


@drawn_in_our_style
def plot_effects(study: EffectStudy, folder: Path) -> list[Path]:
    """Draw every condition; returns the paths of png, pdf and csv."""
    rows, noise = _rows(study), [study.of(condition) for condition in study.of_kind(Kind.NOISE)]
    shown = rows[:_MOST]
    lines = [max(1.0, 0.6 * (row.label.count("\n") + 1)) for row in shown]
    figure = new_figure(9.4, 1.9 + 0.34 * max(sum(lines), 3))
    _title(figure, study, len(rows))
    table = _table(rows, noise)
    if not shown:
        explain(figure.subplots(), "The only reruns change the noise: there is nothing to hold against it.")
        return save_figure(figure, folder, STEM, table)
    left, right = figure.subplots(1, 2, sharey=True, width_ratios=[2.4, 1])
    _effects_panel(left, shown, noise)
    _lift_panel(right, shown)
    left.set_yticks(range(len(shown)), [row.label for row in shown])
    left.set_ylim(len(shown) - 0.4, -0.6)
    for axes in (left, right):
        axes.tick_params(axis="y", length=0)
        for place in range(1, len(shown), 2):
            axes.axhspan(place - 0.5, place + 0.5, color=STRIPE_COLOR, zorder=-2, linewidth=0)
    return save_figure(figure, folder, STEM, table)


def _title(figure: Figure, study: EffectStudy, num_rows: int) -> None:
    note = (
        f"n = {of_tasks(*study.measured)}. Bars: {interval_name(DEFAULT_LEVEL)}s, about "
        f"{study.question.units.words}; none where there can be none, and very long ones are cut."
    )
    headline = study.analysis.headline
    if headline is not None and headline.value is not None:
        bounds = row_interval({"low": headline.lift_low, "high": headline.lift_high})
        lift = f"lift {format_number(headline.lift)}{'' if bounds == '-' else f' {bounds}'}"
        note += f" The base's ratio {headline.what}: {format_number(headline.value)}, {lift}."
    if num_rows > _MOST:
        note += f" The first {_MOST} of {num_rows} rows."
    title(figure, "What the action does without a group of keys, or with it alone; effects do not add up", note)


def _rows(study: EffectStudy) -> list[_Row]:
    rows = []
    direct = {item.name: item.by_reader.get("direct") for item in item_rows(study)} if study.is_recorded else {}
    for group in group_rows(study):
        points = {"without": group.without, "only": group.only, "random": _random_of(study, group.condition)}
        if reader_of(group.condition) == "total":
            points["direct"] = direct.get(group.label)
        known = next(row for row in (group.without, group.only) if row is not None)
        rows.append(_Row(broken(group.label, 30), {k: row for k, row in points.items() if row is not None}, known))
    floor = (Kind.WITHOUT, Kind.ONLY, Kind.RANDOM, Kind.NOISE)
    for condition in study.conditions:
        if condition.kind not in floor:
            row = study.of(condition)
            rows.append(_Row(broken(change_name(condition), 30), {"other": row}, row))
    return rows


def _random_of(study: EffectStudy, condition: Condition) -> dict[str, Any] | None:
    """The floor of random keys of a condition; it has an interval where there is one such rerun."""
    controls = [other for other in study.conditions if other.is_control_of(condition)]
    if len(controls) == 1:
        return study.of(controls[0])
    row = study.of(condition)
    return None if row["random"] is None else {
        "effect": row["random"], "effect_low": row["random_low"], "effect_high": row["random_high"],
        "num_episodes": row["random_episodes"], "condition": f"random keys for {condition.name}",
    }  # fmt: skip


def _effects_panel(axes: Axes, rows: list[_Row], noise: list[dict[str, Any]]) -> None:
    for floor in noise:
        low, high = floor["effect_low"], floor["effect_high"]
        if low is not None and high is not None:
            axes.axvspan(low, high, color=_NOISE_COLOR, alpha=0.55, linewidth=0, zorder=-1)
        axes.axvline(floor["effect"], color="#6A4C93", linewidth=1.1, linestyle=":", zorder=1)
    for place, row in enumerate(rows):
        for kind, point in row.points.items():
            _point(axes, place + _OFFSETS[kind], kind, point)
        first = next(iter(row.points.values()))
        note_at_row(axes, place, f"n = {first['num_episodes']}")
    points = [point for row in rows for point in row.points.values()]
    most = max(point["effect"] for point in [*points, *noise])
    ends = [min(point["effect_high"] or 0.0, _MOST_EFFECT * most) for point in points]
    values = [point["effect"] for point in [*points, *noise] if point["effect"] > 0]
    wide = bool(values) and max(values) > _WIDE * min(values)
    if wide:  # a linear axis would draw all but the largest ones at its end
        ratio_axis(axes.xaxis, np.array([*values, *[end for end in ends if end > 0]]))
    else:
        axes.set_xlim(0, 1.05 * max([most, *ends]) or 1.0)
    log = " (log)" if wide else ""
    axes.set_xlabel(f"effect: change of the action in standard deviations of the base's actions{log}")
    axes.grid(axis="x")
    _legend(axes, {kind for row in rows for kind in row.points}, bool(noise))


def _point(axes: Axes, place: float, kind: str, row: dict[str, Any]) -> None:
    style = {name: value for name, value in _STYLES[kind].items() if name != "label"}
    if row["effect_low"] is not None and row["effect_high"] is not None:
        axes.plot([row["effect_low"], row["effect_high"]], [place, place], color=style["color"], linewidth=1.6)
    axes.plot(row["effect"], place, markersize=6, linestyle="none", zorder=3, **style)


def _legend(axes: Axes, kinds: set[str], with_noise: bool) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles: list[Any] = [Line2D([], [], linestyle="none", **style) for kind, style in _STYLES.items() if kind in kinds]
    if with_noise:
        handles.append(Patch(color=_NOISE_COLOR, alpha=0.55, label="another noise seed"))
    columns = len(handles) if len(handles) < 6 else 3  # in two rows: a wide legend would squeeze the panels
    legend_above(axes, columns, handles, columnspacing=1.2, handletextpad=0.3)


def _lift_panel(axes: Axes, rows: list[_Row]) -> None:
    known = [(place, row.lift) for place, row in enumerate(rows) if row.lift is not None and row.lift["lift"]]
    if not known:
        explain(axes, "no attention to show")
        return
    bounded_axis(axes.xaxis, [row for _, row in known], "lift", 1.0)
    for place, row in known:
        if row["lift_low"] is not None and row["lift_high"] is not None:
            axes.plot([row["lift_low"], row["lift_high"]], [place, place], color=NOTE_COLOR, linewidth=1.6)
        axes.plot(row["lift"], place, "o", color=NOTE_COLOR, markersize=5)
    uniform_line(axes, along="x")
    axes.set_xlabel("lift of its attention (log; 1: uniform)")
    axes.grid(axis="x")


def bounded_axis(axis: Any, rows: Sequence[Mapping[str, Any]], name: str, *more: float) -> None:
    """A logarithmic axis around the values of a column and its intervals, of which wide ones run over its ends."""
    values = np.array([row[name] for row in rows])
    ends = [row[f"{name}{end}"] for row in rows for end in ("_low", "_high") if row[f"{name}{end}"]]
    within = np.clip(ends, values.min() / _MOST_REACH, values.max() * _MOST_REACH)
    ratio_axis(axis, np.array([*values, *within, *more]))
    if name == "mass":
        axis.axes.set_xlim(right=min(axis.axes.get_xlim()[1], 1.0))


def _table(rows: list[_Row], noise: list[dict[str, Any]]) -> pl.DataFrame:
    """What is drawn, one row per point."""
    columns = ("effect", "effect_low", "effect_high")
    lifts = ("mass", "lift", "lift_low", "lift_high")
    plotted = [
        {"row": row.label, "point": kind, "condition": point["condition"], "num_episodes": point["num_episodes"]}
        | {name: point[name] for name in columns}
        | {name: None if row.lift is None else row.lift[name] for name in lifts}
        for row in rows
        for kind, point in row.points.items()
    ]
    plotted += [
        {"row": "noise", "point": "noise", "condition": row["condition"], "num_episodes": row["num_episodes"]}
        | {name: row[name] for name in columns}
        for row in noise
    ]
    text = dict.fromkeys(("row", "point", "condition"), pl.String)
    schema: dict[str, Any] = {
        **text,
        "num_episodes": pl.Int64,
        **dict.fromkeys((*columns, *lifts), pl.Float64),
    }
    return pl.DataFrame(plotted, schema=schema)
