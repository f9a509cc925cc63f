"""Text in plots: titles with notes, names that fit, and the reason why axes are empty."""

from __future__ import annotations

import textwrap
from typing import TYPE_CHECKING

from vla_attention.analyze.render.plot_axes import hide_frame
from vla_attention.analyze.render.plot_colours import NOTE_COLOR
from vla_attention.schemas.groupings.grouping import Grouping, Ratio
from vla_attention.schemas.safe_text import visible

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Of running text at 9 points, on the safe side.
_CHARACTERS_PER_INCH = 11


def wrapped(text: str, width: int, lines: int) -> str:
    """Text in at most so many lines of at most so many characters, with … where it was cut."""
    return "\n".join(textwrap.wrap(visible(" ".join(text.split())), width, max_lines=lines, placeholder=" …"))


def shortened(name: str, width: int) -> str:
    """A name that must not be broken at spaces, in at most so many characters, with … where it was cut."""
    return name if len(name) <= width else f"{name[: width - 1]}…"


def explain(axes: Axes, text: str) -> None:
    """Write into the middle of empty axes why they are empty."""
    axes.set_xticks([])
    axes.set_yticks([])
    hide_frame(axes)
    axes.text(
        0.5, 0.5, textwrap.fill(text, 60), transform=axes.transAxes, ha="center", va="center", color=NOTE_COLOR, size=9
    )


def title(figure: Figure, text: str, note: str = "") -> None:
    """The title of a figure, and below it a note (n, what was left out), wrapped to the figure's width."""
    width = int(figure.get_figwidth() * _CHARACTERS_PER_INCH)
    lines = textwrap.wrap(visible(" ".join(note.split())), width)
    figure.suptitle("\n".join([wrapped(text, width, 2), *lines]), x=0.01, ha="left", size=9, linespacing=1.35)


def named(grouping: Grouping) -> str:
    """The name of a grouping in a title."""
    return f"grouping '{grouping.name}'"


def ratio_name(ratio: Ratio) -> str:
    """A ratio as an axis label: its groups, or how many they are when the names would not fit."""
    sides = []
    for names in (ratio.numerator, ratio.denominator):
        joined = " + ".join(names)
        sides.append(
            joined if len(joined) <= 24 else f"{len(names)} groups" if len(names) > 1 else wrapped(joined, 24, 1)
        )
    return " / ".join(sides)
