"""One style for all pictures: fonts, sizes, resolution; new figures and saved ones. Colours are in `plot_colours`."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")

DPI = 150
#: Fonts and line widths, as matplotlib's settings.
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
    """Run a drawing function with our settings, and restore the caller's settings afterwards."""

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


def find_places(figure: Figure) -> None:
    """Find them once, for every format. While a figure has a layout engine, matplotlib draws all of it twice."""
    engine = figure.get_layout_engine()
    if engine is not None:
        figure.set_dpi(DPI)
        engine.execute(figure)
        figure.set_layout_engine(None)
