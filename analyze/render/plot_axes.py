"""What the axes of plots share: scales, labels, names that fit, and the reason why they are empty."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vla_attention.analyze.render.style import NOTE_COLOR
from vla_attention.schemas.safe_text import visible

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis


def wrapped(text: str, width: int, lines: int) -> str:
    """Text in at most so many lines of at most so many characters, with … where it was cut."""
    return "\n".join(textwrap.wrap(visible(" ".join(text.split())), width, max_lines=lines, placeholder=" …"))


def shortened(name: str, width: int) -> str:
    """A name that must not be broken at spaces, in at most so many characters, with … where it was cut."""
    return name if len(name) <= width else f"{name[: width - 1]}…"


def explain(axes: Axes, text: str) -> None:
    """Write into the middle of empty axes why they are empty."""
    axes.set_axis_off()
    axes.text(0.5, 0.5, textwrap.fill(text, 60), transform=axes.transAxes, ha="center", va="center", color=NOTE_COLOR)


def ratio_axis(axis: Any, values: Any) -> None:
    """Make an x or y axis logarithmic around finite positive values, with decimal numbers (0.5, 20) as labels.

    A ratio and its inverse are equally far from 1 on such an axis; on a linear axis the denominator's side is squeezed.
    """
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    shown = np.asarray(values, dtype=np.float64)
    shown = shown[np.isfinite(shown) & (shown > 0)]
    low, high = (shown.min(), shown.max()) if shown.size else (0.5, 2.0)
    # At least half a factor of two on either side, so that tiny differences do not look large.
    margin = max(0.06 * np.log(high / low), 0.5 * (np.log(2.0) - np.log(high / low)), 0.05)
    low, high = low * np.exp(-margin), high * np.exp(margin)
    decades = np.log10(high / low)
    digits = (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 7.0) if decades < 1.0 else (1.0, 2.0, 5.0) if decades < 3 else (1.0,)
    is_x = axis.axis_name == "x"
    (axis.axes.set_xscale if is_x else axis.axes.set_yscale)("log")
    (axis.axes.set_xlim if is_x else axis.axes.set_ylim)(low, high)
    axis.set_major_locator(LogLocator(subs=digits, numticks=20))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.10g}"))
    axis.set_minor_locator(NullLocator())


def whole_numbers(axis: Axis) -> None:
    """Ticks of a linear axis at whole numbers only, for counts and steps."""
    from matplotlib.ticker import MaxNLocator

    axis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))


def share_ticks(axis: Axis) -> None:
    """Ticks from 0% to 100% on an axis of shares."""
    axis.set_ticks(np.linspace(0, 1, 6), [f"{share}%" for share in range(0, 101, 20)])


def label_positions(axis: Axis, labels: Sequence[str], most: int) -> None:
    """Labels at the positions 0, 1, 2 ...; every second, third ... label where more than `most` would touch."""
    positions = range(0, len(labels), max(1, -(-len(labels) // most)))
    axis.set_ticks(list(positions), [labels[i] for i in positions])


def scattered(generator: np.random.Generator, position: float, count: int, spread: float = 0.22) -> NDArray[np.float64]:
    """`count` positions around the middle of a row, at most `spread` from it, so that points do not hide each other."""
    offsets = generator.uniform(-spread, spread, count) if count > 1 else np.zeros(count)
    return np.asarray(position + offsets)
