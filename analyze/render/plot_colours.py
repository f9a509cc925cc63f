"""The colours of plots: groups, single series, heat maps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.colors import Colormap

#: Okabe & Ito's colours, which colour-blind people can tell apart, one for each group that always exists.
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
#: Colours of other groups, in this order: the rest of Okabe & Ito's, then Tol's muted scheme.
FURTHER_COLORS = ("#E69F00", "#56B4E9", "#F0E442", "#332288", "#117733", "#882255", "#44AA99", "#999933", "#AA4499")
#: Patterns that tell groups apart when there are more groups than colours.
_HATCHES = ("", "///", "...", "xxx")
#: Lines of groups whose areas have these patterns.
LINE_OF_HATCH = {"": "-", "///": "--", "...": ":", "xxx": "-."}
#: Colours of runs, files and the like, in this order (Okabe & Ito's; neighbours differ in lightness too).
SERIES_COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
#: Colours of a single series, of the value that uniform attention gives, and of small print.
DATA_COLOR, BASELINE_COLOR, NOTE_COLOR = "#0072B2", "#000000", "#555555"
#: Single episodes beside their mean.
DOT_COLOR = "#56B4E9"
#: Heat maps: more and less than uniform attention (as the visual and the linguistic group), about as much, and no
#: value.
_LESS, _EVEN, _MORE = "#A63C00", "#F7F7F7", "#00507D"
_NOTHING = "#D9D9D9"


def group_styles(names: Sequence[str]) -> dict[str, dict[str, str]]:
    """Colour and hatch of each group: fixed for the usual names, else the next free colour, then hatches."""
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


def diverging_colors() -> Colormap:
    """The colours of heat maps, from less through even to more; grey where there is no value."""
    from matplotlib.colors import LinearSegmentedColormap

    stops = [_LESS, "#E69A6B", _EVEN, "#7FB2D3", _MORE]
    return LinearSegmentedColormap.from_list("less_more", stops).with_extremes(bad=_NOTHING)
