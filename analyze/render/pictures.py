"""Figures of kind `pictures`: pictures in rows and columns, with attention on them where the frame has a map.

What gets no more than evenly spread attention is pale; what gets more keeps its colours, so that
a red cube stays red. Lines around patches say how much more. To change the look, change the constants below.

Columns of the frame, a row for each picture:

    row, column   where it stands: its row of pictures, and its place in it. A row that is text is named on the left.
    above, below  text, with line breaks where it has them; may be missing.
    map           the value of every patch, (row, column) as lists, the right way up; null or missing without one.
    members       for each of the option `outlines`, whether it takes the patch, (group, row, column); may be missing.
    words, lifts  the words of the instruction, and the value of each; may be missing.

Options: picture, a function of a row of the frame that gives its picture (row, column, 3) uint8, or None where there is
none; high, the value from which on pictures are as bright as they get (`even` gives 1); levels, the values at which
lines are drawn, at most two; outlines, names of groups; smooth, whether values change smoothly between patches;
words_high, as high, of the words.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.core.camera_maps import NO_PICTURE, enlarge
from vla_attention.analyze.core.result import Figure
from vla_attention.analyze.render.plot_text import wrapped
from vla_attention.analyze.render.style import Style, new_canvas

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Canvas

#: More pictures than this go into a further line of the same row.
_COLUMNS = 8
#: Inches of a picture's side, at most.
_LARGEST = 2.4
#: Surroundings: part of the picture that is kept, of that the part in colour, and the grey that the rest is.
_KEPT, _COLOUR_KEPT, _GREY = 0.5, 0.55, 165.0
#: Without a picture, attention is blue on grey.
_BLUE = (0.0, 58.0, 112.0)
#: Points of the two lines, each dark with a light border; of lines around groups, their colours.
_LINES = (1.0, 2.2)
_OUTLINES = ("#00B5CC", "#E040A0", "#7A5CFF", "#5CB800")
_WORD = "#E69F00"


def strength(values: NDArray[np.floating], high: float) -> NDArray[np.float64]:
    """How much of its colour a patch keeps, 0 to 1: 0 up to the value 1, all from `high` on; NaN keeps none.

    The root between them: twice the even value is to be seen beside ten times.
    """
    with np.errstate(invalid="ignore"):
        above = np.clip((np.asarray(values, np.float64) - 1.0) / max(high - 1.0, 1e-9), 0.0, 1.0)
    return np.sqrt(np.nan_to_num(above))


def lit(
    picture: NDArray[np.uint8] | None, values: NDArray[np.floating], high: float, smooth: bool
) -> NDArray[np.uint8]:
    """A picture (row, column, 3) with attention on it: values (row, column) of its patches; see the module."""
    if picture is None:
        shape = tuple(side * max(1, 64 // side) for side in values.shape)
        picture = np.broadcast_to(np.array(_BLUE), (*shape, 3)).astype(np.uint8)
        around = np.full(picture.shape, float(NO_PICTURE))
    else:
        grey = (picture.astype(np.float64) @ np.array([0.299, 0.587, 0.114]))[:, :, None]
        around = _KEPT * (_COLOUR_KEPT * picture + (1 - _COLOUR_KEPT) * grey) + (1 - _KEPT) * _GREY
    kept = strength(enlarge(values, picture.shape[0], picture.shape[1], smooth), high)[:, :, None]
    return np.asarray(np.clip(np.round(kept * picture + (1 - kept) * around), 0, 255), dtype=np.uint8)


def pictures(figure: Figure, style: Style) -> Canvas:
    """All pictures of the frame; see the module."""
    o: Any = figure.options
    frame = figure.frame
    rows, columns = (frame[name].unique(maintain_order=True).to_list() for name in ("row", "column"))
    lines = -(-len(columns) // _COLUMNS)
    across = min(len(columns), _COLUMNS)
    margin = 0.3 if frame.schema["row"] == pl.String else 0.1
    side = min((style.width(wide=True) - margin) / across, _LARGEST)
    shown = {(one["row"], one["column"]): (one, o["picture"](one)) for one in frame.iter_rows(named=True)}
    heights = dict.fromkeys(rows, 0.0)
    for (row, _), (one, picture) in shown.items():
        height, width = picture.shape[:2] if picture is not None else np.shape(one["map"])
        heights[row] = max(heights[row], side * height / width)
    of_text = sum(_lines_of(frame, name) for name in ("above", "below")) * 0.15 + 0.1
    of_rows = [height + of_text for height in heights.values()]
    has_map, words = "map" in frame.columns and frame["map"].null_count() < frame.height, _words(frame)
    blocks = [*([0.28] if words else []), *([sum(of_rows)] * lines), *([0.28] if has_map else [])]
    canvas = new_canvas(max(margin + across * side, 3.3), sum(blocks) + (0.05 if style.paper else 0.35))
    if not style.paper:
        room = int(canvas.get_figwidth() * style.characters_per_inch)
        canvas.suptitle(wrapped(figure.title, room, 2), x=0.01, ha="left", size=10)
    parts = canvas.add_gridspec(len(blocks), 1, height_ratios=blocks)
    if words:
        _draw_words(canvas.add_subplot(parts[0]), words, float(o.get("words_high", 4.0)))
    grids = [parts[line + bool(words)].subgridspec(len(rows), across, height_ratios=of_rows) for line in range(lines)]
    for (row, column), (one, picture) in shown.items():
        line, place = divmod(columns.index(column), _COLUMNS)
        axes = canvas.add_subplot(grids[line][rows.index(row), place])
        _draw_one(axes, one, picture, o, row if place == 0 and isinstance(row, str) else "")
    if has_map:
        _draw_legend(canvas.add_subplot(parts[len(blocks) - 1]), o)
    return canvas


def _lines_of(frame: pl.DataFrame, name: str) -> int:
    return max((text.count("\n") + 1 for text in frame[name] if text), default=0) if name in frame.columns else 0


def _draw_one(axes: Axes, one: dict[str, Any], picture: NDArray[np.uint8] | None, o: Any, name: str) -> None:
    values = None if one.get("map") is None else np.array(one["map"], dtype=np.float64)
    if values is not None:
        picture = lit(picture, values, o["high"], bool(o.get("smooth")))
    assert picture is not None
    axes.imshow(picture, interpolation="nearest")
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_visible(False)
    size = 7.5
    if values is not None:
        for level, width in zip(o.get("levels", ()), _LINES, strict=False):
            _around(axes, values >= level, picture.shape, width, "black", "white")
    for i, member in enumerate(one.get("members") or ()):
        _around(
            axes, np.array(member, dtype=bool), picture.shape, 1.4, _OUTLINES[i % len(_OUTLINES)], "white", inside=0.12
        )
    if one.get("above"):
        axes.set_title(one["above"], size=size, pad=3)
    if one.get("below"):
        axes.set_xlabel(one["below"], size=size - 0.5, labelpad=2)
    if name:
        axes.set_ylabel(wrapped(name, 22, 2), size=size, labelpad=2)


def _around(
    axes: Axes,
    member: NDArray[np.bool_],
    shape: Sequence[int],
    width: float,
    color: str,
    border: str,
    inside: float = 0.0,
) -> None:
    """A line around the member patches (row, column), `inside` of a patch within them; dark on a light border."""
    from matplotlib.collections import LineCollection

    down, across = shape[0] / member.shape[0], shape[1] / member.shape[1]
    wide = np.pad(member, 1)
    segments = []
    for row, column in zip(*np.nonzero(member), strict=True):
        above, below, left, right = (
            not wide[row + down_by, column + across_by] for down_by, across_by in ((0, 1), (2, 1), (1, 0), (1, 2))
        )
        top, bottom = row + inside * above, row + 1 - inside * below
        start, end = column + inside * left, column + 1 - inside * right
        for drawn, (x0, y0, x1, y1) in (
            (above, (start, top, end, top)), (below, (start, bottom, end, bottom)),
            (left, (start, top, start, bottom)), (right, (end, top, end, bottom)),
        ):  # fmt: skip
            if drawn:
                segments.append([(x0 * across - 0.5, y0 * down - 0.5), (x1 * across - 0.5, y1 * down - 0.5)])
    for one, points in ((border, width + 1.2), (color, width)):
        axes.add_collection(
            LineCollection(segments, colors=one, linewidths=points, capstyle="projecting", clip_on=False), False
        )


def _words(frame: pl.DataFrame) -> list[tuple[str, float]]:
    """The words of the instruction with the mean of their values over the shown pictures."""
    if "words" not in frame.columns or frame["words"].null_count() == frame.height or not len(frame["words"][0]):
        return []
    lifts = np.array(frame["lifts"].to_list(), dtype=np.float64)
    return list(zip(frame["words"][0].to_list(), np.nanmean(lifts, axis=0).tolist(), strict=True))


def _draw_words(axes: Axes, words: Sequence[tuple[str, float]], high: float) -> None:
    """The words side by side, each on a shade of its value."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    axes.set_axis_off()
    canvas = axes.figure.canvas
    assert isinstance(canvas, FigureCanvasAgg)
    renderer, dpi = canvas.get_renderer(), axes.figure.dpi  # type: ignore[no-untyped-call]
    place = 4.0
    for word, value in words:
        box = {
            "boxstyle": "round,pad=0.25",
            "facecolor": (*_rgb(_WORD), float(strength(np.array(value), high))),
            "linewidth": 0,
        }
        text = axes.annotate(word, (0, 0.5), (place, 0), textcoords="offset points", va="center", size=9, bbox=box)
        place += text.get_window_extent(renderer).width * 72 / dpi + 9
        text.set_in_layout(False)


def _rgb(color: str) -> tuple[float, float, float]:
    red, green, blue = (int(color[i : i + 2], 16) / 255 for i in (1, 3, 5))
    return red, green, blue


def _draw_legend(axes: Axes, o: Any) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch
    from matplotlib.patheffects import withStroke

    axes.set_axis_off()
    handles: list[Artist] = [Patch(facecolor="#A0A0A0", label="pale: no more than even attention")]
    for level, width in zip(o.get("levels", ()), _LINES, strict=False):
        effect = [withStroke(linewidth=width + 1.2, foreground="white")]
        handles.append(
            Line2D([], [], color="black", linewidth=width, path_effects=effect, label=f"{level:g} times even and more")
        )
    for i, name in enumerate(o.get("outlines", ())):
        handles.append(Patch(facecolor="none", edgecolor=_OUTLINES[i % len(_OUTLINES)], label=wrapped(name, 30, 1)))
    canvas = axes.get_figure(root=True)
    columns = 4 if canvas is None or canvas.get_figwidth() > 5 or len(handles) < 3 else 2
    axes.legend(handles=handles, loc="center left", ncols=columns, bbox_to_anchor=(0, 0.5), borderaxespad=0.0,
                handlelength=1.6, columnspacing=1.2, fontsize=7.5)  # fmt: skip
