"""`attention_and_effect`: does attention to a group say what the action does without it? A point per group."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import polars as pl

from vla_attention.analyze.effects.conditions import Kind
from vla_attention.analyze.effects.effect_study import EffectStudy
from vla_attention.analyze.effects.group_rows import GroupRow, group_rows
from vla_attention.analyze.show.numbers import interval_name, of_tasks
from vla_attention.analyze.show.plot_axes import ratio_axis, uniform_line
from vla_attention.analyze.show.plot_colours import DATA_COLOR
from vla_attention.analyze.show.plot_style import drawn_in_our_style, new_figure, save_figure
from vla_attention.analyze.show.plot_text import explain, shortened, title
from vla_attention.analyze.statistics.intervals import DEFAULT_LEVEL

if TYPE_CHECKING:
    from matplotlib.axes import Axes

STEM = "attention_and_effect"
_NOISE_COLOR = "#C9B8D8"
_LABELS = {"mass": "mass of its attention (log)", "lift": "lift of its attention (log; 1: uniform)"}
#: More names would cover each other.
_MOST_NAMES = 24


@drawn_in_our_style
def plot_attention_and_effect(study: EffectStudy, folder: Path) -> list[Path]:
    """Draw groups by mass and by lift (x) and by the effect of knocking them out (y); returns png, pdf and csv."""
    rows = [row for row in group_rows(study) if row.without is not None and row.attention["mass"]]
    figure = new_figure(9.4, 4.6)
    overall = study.analysis.overall
    n = of_tasks(overall["num_episodes"], overall["num_tasks"])
    note = (
        f"Each point: a group of keys that was knocked out; n = {n}. Bars: {interval_name(DEFAULT_LEVEL)}s, about "
        f"{study.question.settings.intervals.words}. Attention is the base's, in the same replans. "
        "Larger groups have more mass by their size alone."
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
    panels[0].set_ylim(bottom=0)
    return save_figure(figure, folder, STEM, table)


def _panel(axes: Axes, rows: list[GroupRow], measure: str, noise: list[dict[str, Any]]) -> None:
    shown = [row.without for row in rows if row.without is not None and row.without[measure]]
    if not shown:
        explain(axes, f"no group has a {measure}")
        return
    ends = [row[f"{measure}{end}"] for row in shown for end in ("", "_low", "_high") if row[f"{measure}{end}"]]
    ratio_axis(axes.xaxis, [*ends, 1.0] if measure == "lift" else ends)
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
                axes.plot(x, y, color=DATA_COLOR, linewidth=0.9, alpha=0.6)
        axes.plot(row[measure], row["effect"], "o", color=DATA_COLOR, markersize=5)
    _name_points(axes, [row for row in rows if row.without is not None and row.without[measure]], measure)
    if measure == "lift":
        uniform_line(axes, along="x")
    if noise and measure == "mass":
        axes.legend(loc="best")
    axes.set_xlabel(_LABELS[measure])
    axes.grid()


def _name_points(axes: Axes, rows: list[GroupRow], measure: str) -> None:
    """Names to the right of points, or to the left of those in the right half."""
    low, high = axes.get_xlim()
    middle = (low * high) ** 0.5
    for row in rows[:_MOST_NAMES]:
        assert row.without is not None
        x, y = row.without[measure], row.without["effect"]
        right = x > middle
        axes.annotate(
            shortened(row.name, 20),
            (x, y),
            xytext=(-5 if right else 5, 4),
            textcoords="offset points",
            ha="right" if right else "left",
            size=7,
        )


def _table(rows: list[GroupRow]) -> pl.DataFrame:
    names = [f"{name}{end}" for name in ("mass", "lift", "norm", "effect") for end in ("", "_low", "_high")]
    found = [
        {"group": row.name, "num_episodes": row.without["num_episodes"], "keys": row.without["keys"]}
        | {name: row.without[name] for name in names}
        for row in rows
        if row.without is not None
    ]
    schema: dict[str, Any] = {"group": pl.String, "num_episodes": pl.Int64}
    return pl.DataFrame(found, schema=schema | dict.fromkeys(("keys", *names), pl.Float64))
