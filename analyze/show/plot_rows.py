"""Rows of estimates in a plot: a point with its interval, dots of single episodes, and what uniform attention gives."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from vla_attention.analyze.show.plot_axes import BASELINE_LABEL, legend_above, scattered
from vla_attention.analyze.show.plot_colours import BASELINE_COLOR, DATA_COLOR, DOT_COLOR

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: From this many rows on, a row is one line high.
MANY_ROWS = 24


def label_rows(axes: Axes, labels: Sequence[str]) -> None:
    """Names of the rows, the first one at the top, and lines across them."""
    axes.set_yticks(range(len(labels)), labels)
    axes.set_ylim(len(labels) - 0.4, -0.6)
    axes.tick_params(axis="y", length=0)
    axes.grid(axis="x")


def draw_estimate(
    axes: Axes,
    place: float,
    value: float,
    bounds: Sequence[float | None],
    color: str = DATA_COLOR,
    marker: str = "o",
    few: bool = True,
) -> None:
    """A point, and where there are `bounds` its interval; smaller unless there are `few` rows."""
    if None not in bounds:
        ends: Any = list(bounds)
        axes.plot(ends, [place, place], color=color, linewidth=2.0 if few else 1.4, zorder=3)
    size = 6.5 if few else 4.5
    axes.plot(value, place, marker, color=color, markersize=size, markeredgecolor="white", zorder=4)


def draw_dots(axes: Axes, place: float, values: Any, generator: np.random.Generator, few: bool) -> None:
    """Values of single episodes, around the middle of the row."""
    places = scattered(generator, place, len(values))
    axes.scatter(values, places, s=14 if few else 8, color=DOT_COLOR, alpha=0.8, linewidths=0, zorder=2)


def draw_uniform(axes: Axes, place: float, uniform: float, reach: float = 0.42) -> None:
    """What uniform attention gives, as a dashed line across one row."""
    ends = [place - reach, place + reach]
    axes.plot([uniform] * 2, ends, "--", color=BASELINE_COLOR, linewidth=1.2, zorder=1)


def legend_of_rows(
    axes: Axes, columns: int, mean: str, interval: str = "", dots: str = "", uniform: bool = False
) -> None:
    """What points, intervals, dots and dashed lines are; those without a name are not there."""
    axes.plot([], [], "o", color=DATA_COLOR, markersize=6, label=mean)
    if interval:
        axes.plot([], [], color=DATA_COLOR, linewidth=2, label=interval)
    if dots:
        axes.scatter([], [], s=14, color=DOT_COLOR, linewidths=0, label=dots)
    if uniform:
        axes.plot([], [], "--", color=BASELINE_COLOR, linewidth=1.2, label=BASELINE_LABEL)
    legend_above(axes, columns, handlelength=1.5)
