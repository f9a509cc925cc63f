"""Heat maps around the uniform baseline: colours for more and less; marks for infinite, undefined, uncertain cells."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from vla_attention.analyze.render.plot_axes import hide_frame, label_positions
from vla_attention.analyze.render.plot_colours import diverging_colors

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: The colours span at least this much on either side of 0, in powers of two: tiny differences must not look large.
_LEAST_SPAN = 0.5
#: Marks of the colour bar, on either side of 1.
_FACTORS = ((1.1, 1.2, 1.3, 1.4), (1.2, 1.5, 2.0), (1.5, 2.0, 3.0))
#: With more cells than this, numbers in them could not be read; with more in a row, they would touch.
_MOST_NUMBERS, _MOST_NUMBERED_COLUMNS = 64, 12
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

    Infinite values have the colour's end and are marked ∞ or 0, undefined ones (NaN) are grey; `uncertain` cells carry
    a small dot. In a small map every cell also shows its number.
    """
    finite = log2[np.isfinite(log2)]
    numbered = _has_numbers(*log2.shape)
    span = max(_LEAST_SPAN, float(np.abs(finite).max()) if finite.size else 0.0)
    image = axes.imshow(
        np.clip(log2, -span, span),
        origin="lower",
        aspect="auto",
        interpolation="none",
        cmap=diverging_colors(),
        vmin=-span,
        vmax=span,
    )
    for row, column in np.argwhere(~np.isnan(log2)):
        value = log2[row, column]
        if np.isinf(value):
            axes.text(column, row, "∞" if value > 0 else "0", ha="center", va="center", color="white", size=7)
        elif numbered:
            axes.text(column, row + 0.08, _factor(value), ha="center", va="center", color=_ink(value, span), size=7)
    rows, columns = np.nonzero(uncertain & np.isfinite(log2))
    inks = [_ink(value, span) for value in log2[rows, columns]]
    axes.scatter(columns, rows - (0.32 if numbered else 0.0), s=3, color=inks, linewidths=0)
    bar = figure.colorbar(image, ax=axes, shrink=0.9, aspect=24, pad=0.02)
    ticks = _factor_ticks(span)
    bar.set_ticks(ticks, labels=[_factor(tick) for tick in ticks])
    bar.set_label(label)
    bar.outline.set_visible(False)


def _has_numbers(num_rows: int, num_columns: int) -> bool:
    return num_rows * num_columns <= _MOST_NUMBERS and num_columns <= _MOST_NUMBERED_COLUMNS


def label_axis(axes: Axes, which: str, labels: Sequence[str]) -> None:
    """Label the rows ("y") or columns ("x") of a map."""
    label_positions(axes.xaxis if which == "x" else axes.yaxis, labels, _MOST_LABELS)
    axes.tick_params(length=0)
    hide_frame(axes)


def _ink(log2: float, span: float) -> str:
    """The text colour that is legible on a cell."""
    return "white" if abs(log2) > 0.6 * span else "black"


def _factor_ticks(span: float) -> list[float]:
    """Positions of plain factors on either side of 1, spread over the span."""
    plain = (tuple(float(np.log2(factor)) for factor in factors) for factors in _FACTORS)
    powers = ((step, 2.0 * step, 3.0 * step) for step in range(1, 1000))
    for marks in itertools.chain(plain, powers):
        chosen = [mark for mark in marks if mark <= span]
        if chosen and chosen[-1] >= 0.6 * span:
            return [*(-mark for mark in reversed(chosen)), 0.0, *chosen]
    return [0.0]


def _factor(log2: float) -> str:
    """2 to the power `log2` as text: 4 or 1/4."""
    text = f"{2.0 ** abs(log2):.3g}"
    return f"1/{text}" if log2 < 0 and text != "1" else text
