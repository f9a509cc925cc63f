"""`forest`: every run in every suite with interval and uniform baseline, and its difference to the first run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import polars as pl

from vla_attention.analyze.compare.comparison import LOG2_RATIO, Comparison
from vla_attention.analyze.measures.frames import layer_name
from vla_attention.analyze.show.numbers import interval_name, plural
from vla_attention.analyze.show.plot_axes import BASELINE_LABEL, legend_above, note_at_row, ratio_axis
from vla_attention.analyze.show.plot_colours import BASELINE_COLOR, NOTE_COLOR, SERIES_COLORS
from vla_attention.analyze.show.plot_rows import draw_estimate, draw_uniform
from vla_attention.analyze.show.plot_style import drawn_in_our_style, new_figure, save_figure
from vla_attention.analyze.show.plot_text import explain, named, ratio_name, title, wrapped
from vla_attention.analyze.statistics.intervals import DEFAULT_LEVEL

if TYPE_CHECKING:
    from matplotlib.axes import Axes

STEM = "forest"
#: Markers tell runs apart without colour.
RUN_MARKERS = "osD^vP"


def run_style(number: int) -> dict[str, str]:
    """Colour and marker of a run by its place in the comparison."""
    return {"color": SERIES_COLORS[number % len(SERIES_COLORS)], "marker": RUN_MARKERS[number % len(RUN_MARKERS)]}


def factor_axis(axis: Any, factors: Any) -> None:
    """Make an axis logarithmic around factors near 1, with more labels than `ratio_axis` gives a small range."""
    from matplotlib.ticker import LogLocator

    ratio_axis(axis, factors)
    low, high = axis.get_view_interval()
    if high / low < 6:
        axis.set_major_locator(LogLocator(subs=(1.0, 1.2, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0), numticks=30))


@drawn_in_our_style
def plot_forest(
    comparison: Comparison, folder: Path, layer: str | None = None, level: float = DEFAULT_LEVEL
) -> list[Path]:
    """Draw from `comparison.compare`; returns the paths of png, pdf and csv. `layer`: "layers_avg" unless given."""
    layer = layer or comparison.overall_layer
    quantity = comparison.quantities[0]
    shown = "ratio" if quantity == LOG2_RATIO else quantity
    rows = _rows(comparison, layer, quantity, shown)
    figure = new_figure(10, 1.9 + 0.34 * (rows.height + rows["suite"].n_unique()))
    which = layer_name(layer, "mean over layers", "block")
    bars = f"{interval_name(level)}s"
    note = f"n counts episodes (pairs where runs are paired). Bars: {bars}."
    if not comparison.differences["paired"].all():
        note += " Not every run is paired with the first one: those differences hold differences between scenes."
    if rows["low"].null_count():
        note += " No bar where there can be none (one episode, no spread)."
    title(figure, f"Runs side by side: {named(comparison.grouping)}, {which}", note)
    if rows["value"].null_count() == rows.height:
        explain(figure.subplots(), "No run has an episode with a finite ratio.")
        return save_figure(figure, folder, STEM, rows)
    left, right = figure.subplots(1, 2, sharey=True, width_ratios=[3, 2])
    places = _places(rows)
    _estimates_panel(left, rows, places, comparison, shown)
    _differences_panel(right, rows, places, comparison, quantity)
    labels = [wrapped(row["run"], 30, 1) for row in rows.iter_rows(named=True)]
    left.set_yticks(places, labels)
    left.tick_params(axis="y", length=0)
    right.tick_params(axis="y", length=0)
    left.set_ylim(places[-1] + 0.7, -0.9)
    return save_figure(figure, folder, STEM, rows)


def _rows(comparison: Comparison, layer: str, quantity: str, shown: str) -> pl.DataFrame:
    """One row per (suite, run), sorted by suite, with the estimate and the difference to the first run in the suite."""
    columns = ["suite", "run", "num_tasks", "num_episodes", "quantity", "value", "low", "high"]
    columns += ["uniform_ratio"] if shown == "ratio" else []
    estimates = comparison.estimates.filter(pl.col("layer") == layer, pl.col("quantity") == shown).select(columns)
    of_quantity = comparison.differences.filter(pl.col("layer") == layer, pl.col("quantity") == quantity)
    several = (of_quantity["scope"] == "suite").any()
    differences = of_quantity.filter(pl.col("scope") == ("suite" if several else "all")).select(
        "run",
        "suite",
        "paired",
        "num_pairs",
        "difference",
        pl.col("low").alias("difference_low"),
        pl.col("high").alias("difference_high"),
    )
    # A difference between suites belongs to the other run's row, whichever suite that is.
    across = differences.filter(pl.col("suite").is_null()).drop("suite")
    within = estimates.join(differences, on=["run", "suite"], how="left", maintain_order="left")
    if across.height:
        once = estimates.unique("run", keep="first", maintain_order=True).select("run", "suite").join(across, on="run")
        known = [name for name in across.columns if name != "run"]
        within = (
            within.join(once, on=["run", "suite"], how="left", suffix="_across", maintain_order="left")
            .with_columns(pl.coalesce(name, f"{name}_across").alias(name) for name in known)
            .select(within.columns)
        )
    order = {name: i for i, name in enumerate(comparison.names)}
    number = pl.col("run").replace_strict(order, return_dtype=pl.Int64)
    return within.sort("suite", number, maintain_order=True)


def _places(rows: pl.DataFrame) -> list[float]:
    """Heights of the rows, with a gap before every suite."""
    places, place, suite = [], -1.0, None
    for row_suite in rows["suite"]:
        place += 1.0 if row_suite == suite else 2.0
        suite = row_suite
        places.append(place - 1.0)
    return places


def _estimates_panel(
    axes: Axes, rows: pl.DataFrame, places: Sequence[float], comparison: Comparison, shown: str
) -> None:
    is_ratio = shown == "ratio"
    columns = ["value", "low", "high"] + (["uniform_ratio"] if is_ratio else [])
    values = np.concatenate([rows[name].drop_nulls().to_numpy() for name in columns])
    if is_ratio:
        ratio_axis(axes.xaxis, values)
        assert comparison.grouping.ratio is not None
        axes.set_xlabel(f"{ratio_name(comparison.grouping.ratio)}, geometric mean (logarithmic)")
    else:
        axes.set_xlabel(f"fraction of '{shown.removesuffix('_fraction')}'")
    suite = None
    for place, row in zip(places, rows.iter_rows(named=True), strict=True):
        if row["suite"] != suite:
            suite = row["suite"]
            where = axes.get_yaxis_transform()
            axes.text(0.01, place - 0.62, suite, transform=where, size=8, weight="bold", va="center")
        _estimate(axes, place, row["value"], (row["low"], row["high"]), run_style(comparison.names.index(row["run"])))
        if is_ratio and row["uniform_ratio"] is not None:
            draw_uniform(axes, place, row["uniform_ratio"], 0.4)
        note_at_row(axes, place, f"n = {row['num_episodes']}")
    axes.grid(axis="x")
    if is_ratio:
        axes.plot([], [], "--", color=BASELINE_COLOR, linewidth=1.2, label=BASELINE_LABEL)
        legend_above(axes)


def _differences_panel(
    axes: Axes, rows: pl.DataFrame, places: Sequence[float], comparison: Comparison, quantity: str
) -> None:
    from matplotlib.ticker import MaxNLocator

    is_ratio = quantity == LOG2_RATIO

    def scale(value: float | None) -> float | None:
        return 2.0**value if is_ratio and value is not None else value

    names = ("difference", "difference_low", "difference_high")
    known = np.concatenate([rows[name].drop_nulls().to_numpy() for name in names])
    values = np.append(2.0**known if is_ratio else known, 1.0 if is_ratio else 0.0)
    if is_ratio:
        factor_axis(axes.xaxis, values)
        axes.set_xlabel(f"ratio, as a factor of {wrapped(comparison.names[0], 20, 1)} (logarithmic)")
    else:
        axes.xaxis.set_major_locator(MaxNLocator(4))  # small differences have long numbers
        axes.set_xlabel(f"difference to {wrapped(comparison.names[0], 20, 1)}")
    axes.axvline(1.0 if is_ratio else 0.0, color=NOTE_COLOR, linewidth=1.0)
    for place, row in zip(places, rows.iter_rows(named=True), strict=True):
        if row["difference"] is None:
            continue
        style = run_style(comparison.names.index(row["run"]))
        value, low, high = (scale(row[name]) for name in names)
        _estimate(axes, place, value, (low, high), style)
        text = f"n = {plural(row['num_pairs'], 'pair')}" if row["paired"] else "not paired"
        note_at_row(axes, place, text)
    axes.grid(axis="x")


def _estimate(
    axes: Axes, place: float, value: float | None, bounds: Sequence[float | None], style: Mapping[str, str]
) -> None:
    if value is None or not np.isfinite(value):
        note_at_row(axes, place, "no finite ratio", x=0.01)
    else:
        draw_estimate(axes, place, value, bounds, style["color"], style["marker"])
