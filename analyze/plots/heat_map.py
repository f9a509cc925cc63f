"""Heat maps around the uniform baseline: one colour for more, one for less, and marks for what is infinite, undefined or uncertain."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from analyze.plots.style import NOTE_COLOR

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Colormap
    from matplotlib.figure import Figure

#: Towards the numerator as the visual group is drawn, towards the denominator as the linguistic one: apart for colour-blind eyes.
_LESS, _EVEN, _MORE = "#A63C00", "#F7F7F7", "#00507D"
_NOTHING = "#D9D9D9"
#: Half of what the colours span at least, in powers of two: tiny differences must not look large.
_LEAST_SPAN = 0.5
#: Marks of the colour bar, on either side of 1.
_FACTORS = (1.1, 1.2, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 16.0, 24.0)
#: More labels than this along an axis would touch.
_MOST_LABELS = 32


def draw_log2_map(
    figure: Figure,
    axes: Axes,
    log2: NDArray[np.float64],
    uncertain: NDArray[np.bool_],
    label: str,
) -> None:
    """Draw values (row, column) as colours around 0, row 0 at the bottom, with a colour bar in plain factors.

    Infinite values have the colour's end and their sign, undefined ones (NaN) are grey; `uncertain` cells carry a small dot.
    """
    finite = log2[np.isfinite(log2)]
    span = max(_LEAST_SPAN, float(np.abs(finite).max()) if finite.size else 0.0)
    image = axes.imshow(
        np.clip(log2, -span, span), origin="lower", aspect="auto", interpolation="none", cmap=diverging_colors(), vmin=-span, vmax=span
    )  # fmt: skip
    for row, column in np.argwhere(np.isinf(log2)):
        sign = "∞" if log2[row, column] > 0 else "0"
        axes.text(column, row, sign, ha="center", va="center", color="white", size=7)
    draw_dots(axes, uncertain & np.isfinite(log2))
    bar = figure.colorbar(image, ax=axes, shrink=0.9, aspect=24, pad=0.02)
    ticks = _factor_ticks(span)
    bar.set_ticks(ticks, labels=[_factor(tick) for tick in ticks])
    bar.set_label(label)
    bar.outline.set_visible(False)


def draw_dots(axes: Axes, where: NDArray[np.bool_]) -> None:
    """Small dots in the middle of cells (row, column)."""
    rows, columns = np.nonzero(where)
    axes.scatter(columns, rows, s=3, color=NOTE_COLOR, linewidths=0)


def diverging_colors() -> Colormap:
    """From less through even to more; grey where there is no value."""
    from matplotlib.colors import LinearSegmentedColormap

    stops = [_LESS, "#E69A6B", _EVEN, "#7FB2D3", _MORE]
    return LinearSegmentedColormap.from_list("less_more", stops).with_extremes(bad=_NOTHING)


def label_axis(axes: Axes, which: str, labels: Sequence[str]) -> None:
    """Labels at whole positions of the x or y axis; every second, third ... one where all would touch."""
    step = -(-len(labels) // _MOST_LABELS)
    positions = range(0, len(labels), step)
    shown = [labels[i] for i in positions]
    (axes.set_xticks if which == "x" else axes.set_yticks)(list(positions), shown)
    axes.tick_params(length=0)
    for spine in axes.spines.values():
        spine.set_visible(False)


def _factor_ticks(span: float) -> list[float]:
    """Positions of plain factors on either side of 1: at most four that lie within the span and are not crowded."""
    chosen: list[float] = []
    for factor in (*_FACTORS, *(2.0**power for power in range(5, 64))):
        log2 = float(np.log2(factor))
        if log2 <= span and log2 - (chosen[-1] if chosen else 0.0) >= span / 5:
            chosen.append(log2)
    return [*(-log2 for log2 in reversed(chosen)), 0.0, *chosen]


def _factor(log2: float) -> str:
    """2 to the power, as 4 or 1/4."""
    text = f"{2.0 ** abs(log2):.3g}"
    return f"1/{text}" if log2 < 0 else text
