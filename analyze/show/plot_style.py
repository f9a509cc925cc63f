"""One style for all pictures: sizes, fonts, colours of groups, logarithmic axes with plain numbers, and saving."""

from __future__ import annotations

import functools
import textwrap
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar

import numpy as np
import polars as pl

from vla_attention.analyze.show.atomic_file import replacing
from vla_attention.schemas.groupings.grouping import Grouping, Ratio

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")

DPI = 150
#: Of running text at 9 points, on the safe side.
_CHARACTERS_PER_INCH = 11
#: Okabe & Ito's colours, which stay apart for colour-blind eyes, given once and for all to the groups that always exist.
FIXED_COLORS = {
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
#: Colours for groups of one's own: what is left of Okabe & Ito, then Tol's muted scheme.
FURTHER_COLORS = ("#E69F00", "#56B4E9", "#F0E442", "#332288", "#117733", "#882255", "#44AA99", "#999933", "#AA4499")
_HATCHES = ("", "///", "...", "xxx")
DATA_COLOR, BASELINE_COLOR, NOTE_COLOR = "#0072B2", "#000000", "#555555"
BASELINE_LABEL = "uniform attention"

_RC: dict[str, Any] = {
    "font.family": "DejaVu Sans",  # comes with matplotlib: the same picture on every machine
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.labelsize": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "axes.grid": False,
    "grid.color": "#E3E3E3",
    "grid.linewidth": 0.7,
    "legend.frameon": False,
    "legend.fontsize": 8,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "hatch.linewidth": 0.6,
    "lines.linewidth": 1.6,
    "pdf.fonttype": 42,  # text stays text in vector files
    "text.parse_math": False,  # instructions and group names may hold $ and _
}


@contextmanager
def _our_settings() -> Iterator[None]:
    import matplotlib as mpl

    # A plain dict: matplotlib's stubs want literal names, which differ from one of its versions to the next.
    settings: Any = _RC
    with mpl.rc_context(settings):
        yield


def drawn_in_our_style(draw: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """Run a drawing function under our settings, which are taken back afterwards: the caller's own stay as they were."""

    @functools.wraps(draw)
    def wrapped(*args: Parameters.args, **kwargs: Parameters.kwargs) -> Result:
        with _our_settings():
            return draw(*args, **kwargs)

    return wrapped


def new_figure(width: float, height: float) -> Figure:
    """A figure of width x height inches on the Agg canvas; no window system and no global state of pyplot."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def save_figure(
    figure: Figure, folder: Path, stem: str, data: pl.DataFrame, formats: Sequence[str] = ("png", "pdf")
) -> list[Path]:
    """Save `stem`.png, .pdf and .csv (the plotted data) into a folder, each atomically, and return their paths."""
    paths = []
    for kind in formats:
        path = folder / f"{stem}.{kind}"
        # Without a creation date the same data give the same file.
        metadata = {"CreationDate": None} if kind == "pdf" else None
        with replacing(path) as temporary:
            figure.savefig(temporary, format=kind, dpi=DPI, metadata=metadata)
        figure.set_layout_engine("none")  # the places are found: they are the same in every format
        paths.append(path)
    path = folder / f"{stem}.csv"
    with replacing(path) as temporary:
        data.write_csv(temporary)
    return [*paths, path]


def group_styles(names: Sequence[str]) -> dict[str, dict[str, str]]:
    """Colour and hatch of each group: fixed for the usual names, else the next free colour; hatched when colours run out."""
    taken = {FIXED_COLORS[name] for name in names if name in FIXED_COLORS}
    palette = list(FURTHER_COLORS) + [color for color in dict.fromkeys(FIXED_COLORS.values()) if color not in taken]
    styles = {}
    position = 0
    for name in names:
        if name in FIXED_COLORS:
            styles[name] = {"color": FIXED_COLORS[name], "hatch": ""}
            continue
        styles[name] = {
            "color": palette[position % len(palette)],
            "hatch": _HATCHES[position // len(palette) % len(_HATCHES)],
        }
        position += 1
    return styles


def ratio_axis(axis: Any, values: Any) -> None:
    """Make an x or y axis logarithmic around finite positive values, with plain numbers (0.5, 20) as labels.

    A ratio and its inverse are equally far from 1 on such an axis; on a linear one the denominator's side is squeezed.
    """
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter, NullLocator

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
    axis.set_minor_locator(LogLocator(subs=tuple(range(1, 10)), numticks=20) if decades < 3 else NullLocator())
    axis.set_minor_formatter(NullFormatter())


def wrapped(text: str, width: int, lines: int) -> str:
    """Text in at most so many lines of at most so many characters, with … where it was cut."""
    return "\n".join(textwrap.wrap(" ".join(text.split()), width, max_lines=lines, placeholder=" …"))


def shortened(name: str, width: int) -> str:
    """A name that must not be broken at spaces, in at most so many characters, with … where it was cut."""
    return name if len(name) <= width else f"{name[: width - 1]}…"


def whole_numbers(axis: Axis) -> None:
    """Ticks of a linear axis at whole numbers only: counts and steps have no halves."""
    from matplotlib.ticker import MaxNLocator

    axis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))


def explain(axes: Axes, text: str) -> None:
    """Say in the middle of empty axes why there is nothing to see."""
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_visible(False)
    axes.text(
        0.5, 0.5, textwrap.fill(text, 60), transform=axes.transAxes, ha="center", va="center", color=NOTE_COLOR, size=9
    )


def title(figure: Figure, text: str, note: str = "") -> None:
    """First lines of the whole figure: what it is, then notes (n, what was left out), wrapped to the figure's width."""
    width = int(figure.get_figwidth() * _CHARACTERS_PER_INCH)
    lines = textwrap.wrap(note, width) if note else []
    figure.suptitle("\n".join([wrapped(text, width, 2), *lines]), x=0.01, ha="left", size=9, linespacing=1.35)


def plural(count: int, noun: str) -> str:
    """`1 task`, `2 tasks`."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


def named(grouping: Grouping) -> str:
    """What a picture is about, for its title."""
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
