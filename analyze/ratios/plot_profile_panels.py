"""Profiles over layers or denoise steps: a panel of ratios and a panel of fractions, with intervals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import polars as pl

from vla_attention.analyze.measures.aggregate import FRACTION_COLUMNS
from vla_attention.analyze.measures.frames import Tables, float_values
from vla_attention.analyze.show.numbers import interval_name
from vla_attention.analyze.show.plot_axes import BASELINE_LABEL, label_positions, legend_beside, ratio_axis
from vla_attention.analyze.show.plot_colours import BASELINE_COLOR, DATA_COLOR, group_styles
from vla_attention.analyze.show.plot_text import explain, ratio_name, wrapped
from vla_attention.schemas.groupings.grouping import Grouping

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: The most groups in a panel, and labels below it.
_MOST_GROUPS = 6
_MOST_LABELS = 20


def draw_profile(
    figure: Figure, tables: Tables, grouping: Grouping, labels: Sequence[str], along: str, level: float
) -> None:
    """Draw cells of `aggregate.task_tables`, one per position: ratio (if there is one) above, fractions below.

    `along` names the positions; `level` is that of the intervals in `tables`.
    """
    panels = 1 if grouping.ratio is None else 2
    every = figure.subplots(panels, 1, squeeze=False, sharex=False)[:, 0]
    if grouping.ratio is not None:
        _ratio_panel(every[0], tables.cells, grouping, level)
        if every[0].axison and every[0].get_xticks().size:
            _positions(every[0], labels)
    _fraction_panel(every[-1], tables, grouping)
    _positions(every[-1], labels)
    every[-1].set_xlabel(along)


def shown_groups(tables: Tables, grouping: Grouping) -> list[str]:
    """The groups in a panel of fractions: those of the ratio, then those with most mass; none without mass."""
    table = tables.groups.group_by("group", maintain_order=True).agg(pl.col("fraction").mean())
    means = {name: mean for name, mean in table.iter_rows() if mean is not None}
    having = [name for name in grouping.names if means.get(name, 0.0) > 0]
    first = (*grouping.ratio.numerator, *grouping.ratio.denominator) if grouping.ratio else ()
    ranked = sorted(having, key=lambda name: (name not in first, -means[name]))[:_MOST_GROUPS]
    return [name for name in grouping.names if name in ranked]


def _ratio_panel(axes: Axes, rows: pl.DataFrame, grouping: Grouping, level: float) -> None:
    assert grouping.ratio is not None
    mean, low, high, uniform = (
        float_values(rows[column])
        for column in ("geometric_mean", "geometric_mean_low", "geometric_mean_high", "uniform_ratio")
    )
    drawn = np.isfinite(mean) & (mean > 0)
    if not drawn.any():
        left_out = int(rows["num_nonfinite"].sum())
        total = int(rows["num_replans"].sum())
        rest = "" if left_out == total else f", the other {total - left_out} are 0"
        explain(axes, f"No ratio to draw: {left_out} of {total} are infinite (no denominator mass) or undefined{rest}.")
        return
    ratio_axis(axes.yaxis, np.concatenate([mean, low, high, uniform]))
    at = np.arange(len(mean))
    # A logarithmic axis has no 0: an interval that reaches it is drawn to the edge.
    low = np.where(low > 0, low, np.where(np.isnan(low), np.nan, axes.get_ylim()[0]))
    # The line breaks where there is no ratio.
    shown = np.where(drawn, mean, np.nan)
    axes.plot(at, shown, "o-", color=DATA_COLOR, markersize=4.5, label="geometric mean", zorder=3)
    bars = interval_name(level) if np.isfinite(low).any() else "no interval"
    axes.vlines(at, low, high, color=DATA_COLOR, linewidth=2.2, alpha=0.55, zorder=2, label=bars)
    axes.plot(at, uniform, "--", color=BASELINE_COLOR, linewidth=1.2, label=BASELINE_LABEL)
    if len(at) == 1 and np.isfinite(uniform[0]):
        axes.plot([-0.4, 0.4], [uniform[0]] * 2, "--", color=BASELINE_COLOR, linewidth=1.2)
    axes.set_ylabel(f"ratio, {ratio_name(grouping.ratio)}\n(logarithmic)")
    axes.grid(axis="y")
    legend_beside(axes)


def _fraction_panel(axes: Axes, tables: Tables, grouping: Grouping) -> None:
    styles = group_styles(grouping.names)
    groups = shown_groups(tables, grouping)
    at = np.arange(tables.cells.height, dtype=float)
    highest = 0.0
    # Side by side, so that the intervals of groups do not cover each other; near their label where positions are few.
    apart = min(0.08, 0.012 * (len(at) + 0.2))
    for i, name in enumerate(groups):
        rows = tables.of_group(name)
        mean, low, high = (float_values(rows[column]) for column in FRACTION_COLUMNS)
        where = at + (i - (len(groups) - 1) / 2) * apart
        color = styles[name]["color"]
        line = "--" if styles[name]["hatch"] else "-"
        axes.plot(where, mean, f"o{line}", color=color, markersize=4, label=wrapped(name, 24, 1), zorder=3)
        axes.vlines(where, low, high, color=color, linewidth=2.2, alpha=0.55, zorder=2)
        highest = max(highest, float(np.nanmax(np.fmax(mean, high))))
    if not groups:
        explain(axes, "No group has any mass.")
        return
    # Room for the whole of the highest and of the lowest marker.
    axes.set_ylim(-0.03 * highest, 1.06 * highest)
    axes.set_ylabel("fraction of the groups'\nsummed mass")
    axes.grid(axis="y")
    having = tables.groups.filter(pl.col("fraction") > 0)["group"].n_unique()
    heading = f"{len(groups)} of {having} groups" if having > len(groups) else None
    legend_beside(axes, title=heading, title_fontsize=8, alignment="left")


def _positions(axes: Axes, labels: Sequence[str]) -> None:
    label_positions(axes.xaxis, labels, _MOST_LABELS)
    axes.set_xlim(-0.6, len(labels) - 0.4)
