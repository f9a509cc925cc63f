"""`deviation`: the policy's actions against the data set's, by dimension, over an episode, and beside attention."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import polars as pl

from vla_attention.analyze.deviation.deviation_study import MEASURES, RATIO, DeviationStudy
from vla_attention.analyze.effects.paired_replans import ALL
from vla_attention.analyze.measures.frames import float_values, layer_name
from vla_attention.analyze.show.numbers import interval_name, of_tasks
from vla_attention.analyze.show.plot_axes import legend_above
from vla_attention.analyze.show.plot_colours import BASELINE_COLOR
from vla_attention.analyze.show.plot_style import drawn_in_our_style, new_figure, save_figure
from vla_attention.analyze.show.plot_text import explain, shortened, title
from vla_attention.analyze.statistics.intervals import DEFAULT_LEVEL

if TYPE_CHECKING:
    from matplotlib.axes import Axes

STEM = "deviation"
_COLORS = {"first": "#0072B2", "chunk": "#E69F00"}
_LABELS = {"first": "first action", "chunk": "chunk"}
#: Correlations in the picture; the csv has all.
_MOST = 8


@drawn_in_our_style
def plot_deviation(study: DeviationStudy, folder: Path) -> list[Path]:
    """Draw dimensions, phases and correlations side by side; returns the paths of png, pdf and csv."""
    quantities = study.correlations["quantity"].unique(maintain_order=True).to_list()[:_MOST]
    rows = max(study.dimensions.height, len(quantities), 4)
    figure = new_figure(11, 2.2 + 0.3 * rows)
    overall = study.overall
    n = of_tasks(int(overall["num_episodes"] or 0), int(overall["num_tasks"] or 0))
    note = (
        f"n = {n}; whiskers: {interval_name(DEFAULT_LEVEL)}s, about {study.question.units.words}. Dashed: "
        "a policy that always answers with the data set's mean action. Very long whiskers are cut."
    )
    title(figure, f"Actions against the data set's; attention: {layer_name(study.layer, 'mean over layers')}", note)
    by_dimension, by_phase, beside = figure.subplots(1, 3, width_ratios=[3, 3, 4])
    labels = [str(number) for number in study.dimensions["dimension"]]
    _rows(by_dimension, study.dimensions, labels, "dimension of the action")
    by_dimension.set_xlabel("deviation (standard deviations)")
    phases = study.phases.filter(pl.col("scope") == "all", pl.col("phase") != ALL)
    _rows(by_phase, phases, phases["phase"].to_list(), "")
    by_phase.set_xlabel("deviation (standard deviations)")
    legend_above(by_dimension, 2)
    _correlations(beside, study, quantities)
    return save_figure(
        figure,
        folder,
        STEM,
        {"": study.phases, "_dimensions": study.dimensions, "_attention": study.correlations},
    )


def _rows(axes: Axes, table: pl.DataFrame, labels: list[str], name: str) -> None:
    """Points with whiskers of both measures, one row of the table below the other."""
    for shift, measure in ((-0.14, MEASURES[0]), (0.14, MEASURES[1])):
        places = np.arange(table.height) + shift
        values, low, high = (float_values(table[f"{measure}{end}"]) for end in ("", "_low", "_high"))
        axes.hlines(places, low, high, color=_COLORS[measure], linewidth=1.0)
        axes.plot(values, places, "o", color=_COLORS[measure], markersize=4, label=_LABELS[measure])
    axes.axvline(1.0, color=BASELINE_COLOR, linestyle="--", linewidth=1.0)
    # A few long intervals must not squeeze all points into the left edge.
    largest = max((table[name].max() or 0.0 for name in MEASURES), default=0.0)
    axes.set_xlim(0.0, 1.6 * max(1.0, float(largest)))  # type: ignore[arg-type]
    axes.set_yticks(range(table.height), labels)
    axes.set_ylim(table.height - 0.5, -0.5)
    axes.set_ylabel(name)
    axes.grid(axis="x")


def _correlations(axes: Axes, study: DeviationStudy, quantities: list[str]) -> None:
    correlations = study.correlations.filter(pl.col("quantity").is_in(quantities), pl.col("correlation").is_not_null())
    if correlations.is_empty():
        explain(axes, "No episode has enough replans for a correlation.")
        return
    place = {name: i for i, name in enumerate(quantities)}
    for shift, measure in ((-0.14, MEASURES[0]), (0.14, MEASURES[1])):
        part = correlations.filter(measure=measure)
        places = np.array([place[name] for name in part["quantity"]]) + shift
        values, low, high = (float_values(part[f"correlation{end}"]) for end in ("", "_low", "_high"))
        axes.hlines(places, low, high, color=_COLORS[measure], linewidth=1.0)
        axes.plot(values, places, "o", color=_COLORS[measure], markersize=4)
    axes.axvline(0.0, color="black", linewidth=0.8)
    axes.set_xlim(-1.02, 1.02)
    axes.set_yticks(
        range(len(quantities)), [name if name == RATIO else f"lift of {shortened(name, 20)}" for name in quantities]
    )
    axes.set_ylim(len(quantities) - 0.5, -0.5)
    axes.set_xlabel("rank correlation with the deviation")
    axes.grid(axis="x")
