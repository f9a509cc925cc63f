"""How pictures look: on a screen, or in a paper; colours, axes and names that fit; how they are saved."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from io import BytesIO
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from vla_attention.schemas.safe_text import visible

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure as Canvas

StyleName: TypeAlias = Literal["screen", "paper"]
#: Columns of a page in a two-column paper, in inches: one, and both.
_ONE_COLUMN, _BOTH_COLUMNS = 3.35, 6.9
#: Digits at the ticks of a logarithmic axis that spans less than so many decades.
_TICKS = (
    (0.5, (1.0, 1.2, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0)),
    (1.0, (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 7.0)),
    (3.4, (1.0, 2.0, 5.0)),
    (np.inf, (1.0,)),
)
#: Of rows of pictures on a screen, in inches.
_WIDE = 8.4
#: Dots per inch in a notebook, whose pages are about 900 dots wide.
_NOTEBOOK_DPI = 100
_SETTINGS: dict[str, Any] = {
    "font.family": "DejaVu Sans",  # comes with matplotlib: the same picture on every machine
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "grid.color": "#E3E3E3",
    "grid.linewidth": 0.7,
    "legend.frameon": False,
    "hatch.linewidth": 0.6,
    "pdf.fonttype": 42,  # text stays text in vector files
    "svg.fonttype": "none",
    "text.parse_math": False,  # instructions and group names may hold $ and _
}
#: Okabe & Ito's colours, which colour-blind people can tell apart, one for each group that always exists.
_FIXED_COLORS = {
    "visual": "#0072B2",
    "linguistic": "#D55E00",
    "action": "#009E73",
    "state": "#CC79A7",
    "padding": "#C8C8C8",
    "null": "#BDB7A8",
    "masked": "#8F8F8F",
    "other": "#4D4D4D",
    "rest": "#4D4D4D",
}
#: Colours of other groups, in this order: the rest of Okabe & Ito's, then Tol's muted scheme.
_FURTHER_COLORS = ("#E69F00", "#56B4E9", "#F0E442", "#332288", "#117733", "#882255", "#44AA99", "#999933", "#AA4499")
#: Patterns that tell groups apart when there are more groups than colours.
_HATCHES = ("", "///", "...", "xxx")
#: Colours of runs, files and the like, in this order (Okabe & Ito's; neighbours differ in lightness too).
SERIES_COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
#: Of the value that uniform attention gives, of small print, and of single episodes beside their mean.
BASELINE_COLOR, NOTE_COLOR, DOT_COLOR = "#000000", "#555555", "#56B4E9"


def group_styles(names: Sequence[str]) -> dict[str, dict[str, str]]:
    """Colour and hatch of each group: fixed for the usual names, else the next free colour, then hatches."""
    taken = {_FIXED_COLORS[name] for name in names if name in _FIXED_COLORS}
    palette = [*_FURTHER_COLORS, *(color for color in dict.fromkeys(_FIXED_COLORS.values()) if color not in taken)]
    others = [name for name in names if name not in _FIXED_COLORS]
    looks = [(color, hatch) for hatch in _HATCHES for color in palette]
    of = {name: looks[i % len(looks)] for i, name in enumerate(others)}
    return {
        name: dict(zip(("color", "hatch"), of.get(name) or (_FIXED_COLORS[name], ""), strict=True)) for name in names
    }


@dataclass(frozen=True)
class Style:
    """Sizes of a style. A paper's pictures have no title inside, text of 7 to 9 points, and a caption file.

    inches: of a picture on a screen that need not be wide.
    """

    name: StyleName = "screen"
    inches: float = 8.4

    @property
    def paper(self) -> bool:
        """Whether it is for print."""
        return self.name == "paper"

    @property
    def dpi(self) -> int:
        """Dots per inch of a PNG."""
        return 300 if self.paper else 150

    def width(self, wide: bool) -> float:
        """Inches of a picture of one column, or with `wide` of both."""
        if self.paper:
            return _BOTH_COLUMNS if wide else _ONE_COLUMN
        return max(self.inches, _WIDE) if wide else self.inches

    @contextmanager
    def settings(self) -> Iterator[None]:
        """matplotlib's settings within the block; the caller's are there again afterwards."""
        import matplotlib as mpl

        size = 7 if self.paper else 8
        # A plain dict: matplotlib's stubs want literal names, which differ from one of its versions to the next.
        more: Any = {
            **_SETTINGS,
            "font.size": size + 1,
            "axes.titlesize": size + 1,
            "axes.labelsize": size + 1 - self.paper * 0.5,
            "legend.fontsize": size,
            "xtick.labelsize": size,
            "ytick.labelsize": size,
            "lines.linewidth": 1.2 if self.paper else 1.6,
            "savefig.dpi": self.dpi,
        }
        with mpl.rc_context(more):
            yield

    def canvas(self, width: float, height: float) -> Canvas:
        """A matplotlib figure of width x height inches on the Agg canvas: no window system, no state of pyplot.

        It shows itself in a notebook, which knows pictures of pyplot only.
        """
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure as Canvas

        class Shown(Canvas):
            def _repr_png_(self) -> bytes:
                file = BytesIO()
                self.savefig(file, format="png", dpi=_NOTEBOOK_DPI)
                return file.getvalue()

        canvas = Shown(figsize=(width, height), dpi=self.dpi)
        FigureCanvasAgg(canvas)
        return canvas

    def content(self, canvas: Canvas, kind: str) -> bytes:
        """A picture as the bytes of a file, within `settings`."""
        from PIL import Image

        file = BytesIO()
        if kind in ("png", "webp"):
            pixels: Any = canvas.canvas
            pixels.draw()
            image = Image.fromarray(np.asarray(pixels.buffer_rgba())).convert("RGB")
            options: Any = {"quality": 85, "method": 1} if kind == "webp" else {"dpi": (self.dpi, self.dpi)}
            image.save(file, kind, **options)
        else:
            # Without a creation date the same data give the same file.
            canvas.savefig(file, format=kind, metadata={"CreationDate": None} if kind == "pdf" else None)
        return file.getvalue()


def wrapped(text: str, width: int, lines: int) -> str:
    """Text in at most so many lines of at most so many characters, with … where it was cut."""
    return "\n".join(textwrap.wrap(visible(" ".join(text.split())), width, max_lines=lines, placeholder=" …"))


def explain(axes: Axes, text: str) -> None:
    """Write into the middle of empty axes why they are empty."""
    axes.set_axis_off()
    axes.text(0.5, 0.5, textwrap.fill(text, 60), transform=axes.transAxes, ha="center", va="center", color=NOTE_COLOR)


def is_narrow(axes: Axes) -> bool:
    """Whether the picture has the width of one column."""
    return _inches(axes) < 1.2 * _ONE_COLUMN


def letters(axes: Axes, part: float) -> int:
    """How many letters of a tick's label fit into a part of the picture's width."""
    return int(part * _inches(axes) / (0.058 if is_narrow(axes) else 0.067))


def _inches(axes: Axes) -> float:
    canvas: Any = axes.figure
    return float(canvas.get_figwidth())


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
    is_x = axis.axis_name == "x"
    # Numbers below a narrow picture would touch.
    narrow = is_x and is_narrow(axis.axes)
    decades = np.log10(high / low) * (1.6 if narrow else 1.0)
    digits = next(digits for most, digits in _TICKS if decades < most)
    (axis.axes.set_xscale if is_x else axis.axes.set_yscale)("log")
    (axis.axes.set_xlim if is_x else axis.axes.set_ylim)(low, high)
    axis.set_major_locator(LogLocator(subs=digits, numticks=4 if narrow else 20))
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
