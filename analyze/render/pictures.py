"""Figures of kind `pictures`: pictures in rows and columns, with attention on them where the frame has a map.

What gets no more than evenly spread attention is pale; what gets more keeps its colours, so that
a red cube stays red. Lines around patches say how much more. To change the look, change the constants below.

Columns of the frame, a row for each picture:

    row, column   where it stands: its row of pictures, and its place in it. A row that is text is named on the left.
    above, below  text, with line breaks where it has them; may be missing.
    map           the value of every patch, (row, column) as lists, the right way up; null or missing without one.
    second        the same of another quantity, with lines of its own colour; may be missing. Without `map` it is lit.
    marks         patches that are marked, (patch, 2): x and y in parts of the picture; may be missing.
    members       for each of the option `outlines`, whether it takes the patch, (group, row, column); may be missing.
    words, lifts  the words of the instruction, and the value of each; may be missing.

Options: picture, a function of a row of the frame that gives its picture (row, column, 3) uint8, or None where there is
none; high, the value from which on pictures are as bright as they get (`even` gives 1); levels, the values at which
lines are drawn, at most two; second, the same of `second`, with how its lines and its marks are called: a mapping of
high, levels, unit and marked; outlines, names of groups; smooth, whether values change smoothly between patches;
words_high, as high, of the words; sentences, for whose words there is room.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.core.camera_maps import NO_PICTURE, enlarge
from vla_attention.analyze.core.result import Figure
from vla_attention.analyze.render.style import Style, wrapped

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Canvas

#: More pictures than this go into a further line of the same row.
_COLUMNS = 8
#: Inches of a picture's side, at least and at most; between pictures; of a line of text; of title, words and legend.
_LEAST, _LARGEST, _GAP, _LINE, _BAND = 1.25, 2.4, 0.07, 0.13, 0.28
#: Inches between words of the instruction, and of one of their letters.
_WORD_GAP, _LETTER = 0.13, 0.083
#: Letters of the text at a picture, in an inch.
_LETTERS = 20
#: Surroundings: part of the picture that is kept, of that the part in colour, and the grey that the rest is.
_KEPT, _COLOUR_KEPT, _GREY = 0.5, 0.55, 165.0
#: Without a picture, attention is blue on grey.
_BLUE = (0.0, 58.0, 112.0)
#: Points of the two lines, each dark with a light border; of lines around groups, their colours.
_LINES = (1.0, 2.2)
#: Of a second quantity: its lines, and the points of its marks. Black lines and blue ones are told apart by everybody.
_SECOND, _MARK = "#0072B2", 2.8
_OUTLINES = ("#00B5CC", "#E040A0", "#7A5CFF", "#5CB800")
_WORD = "#E69F00"
#: In a legend: what is pale; and inches of a letter.
_PALE, _LEGEND_LETTER = "#A0A0A0", 0.053
#: A colour, the points of a line or 0, and what it says.
Look = tuple[str, float, str]
#: Ends of a line (x0, y0, x1, y1).
Segment = tuple[float, float, float, float]


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
    """All pictures of the frame; see the module. One pair of axes holds all of them, in inches from the top left."""
    o: Mapping[str, Any] = figure.options
    frame = figure.frame
    rows, columns = (frame[name].unique(maintain_order=True).to_list() for name in ("row", "column"))
    across, named = min(len(columns), _COLUMNS), frame.schema["row"] == pl.String
    names = {row: wrapped(row, 22, 2) for row in rows if named}
    margin = 0.08 + 0.2 * named + 0.12 * any("\n" in name for name in names.values())
    # As wide as a plot, unless the texts at the pictures would touch.
    wide = (style.width(wide=False) - margin) / across < _LEAST
    side = min((style.width(wide) - margin) / across - _GAP, _LARGEST)
    heights_of = dict.fromkeys(("above", "below"), 0.0)
    for name in heights_of.keys() & set(frame.columns):
        texts = frame[name].fill_null("").str.split("\n").to_list()
        broken = ["\n".join(wrapped(line, int(_LETTERS * side), 3) for line in text) for text in texts]
        heights_of[name] = _LINE * max(text.count("\n") + bool(text) for text in broken)
        frame = frame.with_columns(pl.Series(name, broken))
    shown = [(one, _lit(one, o)) for one in frame.iter_rows(named=True)]
    heights = {row: max(side * len(at) / len(at[0]) for one, at in shown if one["row"] == row) for row in rows}
    above, below = heights_of.values()
    high = sum(heights.values()) + len(rows) * (above + below + 0.14)
    top = 0.06 if style.paper else _BAND
    width, has_map = max(margin + across * (side + _GAP), 3.3), any(one.get("map") is not None for one, _ in shown)
    second: Mapping[str, Any] = o.get("second") or {}
    said = _lines(_words(frame), width)
    others = [_lines([(word, 0.0) for word in words], width) for words in o.get("sentences", ())]
    start = top + _BAND * max(map(len, [said, *others]))
    lines, looks = [], []
    for name, color, unit, of in (("map", "black", "even", o), ("second", _SECOND, second.get("unit"), second)):
        for level, points in zip(of.get("levels", ()), _LINES, strict=False):
            lines.append((name, level))
            looks.append((color, points, f"{level:g} times {unit} or more"))
    own = len(o.get("levels", ()))
    outlines = [wrapped(name, 30, 1) for name in o.get("outlines", ())]
    looks += [(_OUTLINES[i % len(_OUTLINES)], 1.4, name) for i, name in enumerate(outlines)]
    legends = [("even", [*looks[:own], *looks[len(lines) :]])] * has_map
    if second:
        marks = [(_SECOND, 0.0, second["marked"])] if second.get("marked") else []
        legends.append((second["unit"], [*looks[own : len(lines)], *marks]))
    keys = [[(_PALE, 0.0, f"pale: no more than {unit}"), *of_unit] for unit, of_unit in legends]
    bands = [_BAND + _LINE * (-(-len(key) // _legend_columns(key, width)) - 1) for key in keys]
    height = start + high * -(-len(columns) // _COLUMNS) + sum(bands)
    canvas = style.canvas(width, height)
    axes = canvas.add_axes((0, 0, 1, 1), xlim=(0, width), ylim=(height, 0), autoscale_on=False)
    axes.set_axis_off()
    if not style.paper:
        axes.text(0.08, 0.07, wrapped(figure.title, int(13 * width), 1), va="top", size=10)
    for number, of_line in enumerate(said):
        _draw_words(axes, of_line, float(o.get("words_high", 4.0)), top + _BAND * (number + 0.5))
    around: list[list[Segment]] = [[] for _ in looks]
    marked: list[tuple[float, float]] = []
    for one, picture in shown:
        line, place = divmod(columns.index(one["column"]), _COLUMNS)
        before = rows[: rows.index(one["row"])]
        x = margin + place * (side + _GAP)
        y = start + line * high + sum(heights[row] + above + below + 0.14 for row in before) + above
        down = side * len(picture) / len(picture[0])
        axes.imshow(picture, extent=(x, x + side, y + down, y), aspect="auto", interpolation="nearest")
        if one.get("above"):
            axes.text(x + side / 2, y - 0.04, one["above"], ha="center", va="bottom", size=7.5)
        if one.get("below"):
            axes.text(x + side / 2, y + down + 0.03, one["below"], ha="center", va="top", size=7)
        if named and place == 0:
            axes.text(x - 0.04, y + down / 2, names[one["row"]], ha="right", va="center", size=7.5, rotation=90)
        regions = [None if one.get(name) is None else _array(one[name]) >= level for name, level in lines]
        regions += [np.array(member, dtype=bool) for member in one.get("members") or ()]
        for number, region in enumerate(regions):
            if region is not None:
                around[number] += borders(region, 0.12 * (number >= len(lines)), (x, y), (side, down))
        marked += [(x + side * across, y + down * below) for across, below in one.get("marks") or ()]
    for segments, (color, points, _) in zip(around, looks, strict=True):
        _draw_lines(axes, segments, color, points)
    if marked:
        cells = max(len(one["second"][0]) for one, _ in shown if one.get("second") is not None)
        size = min(_MARK, 0.36 * 72 * side / cells)  # a picture of many patches is still seen
        axes.plot(*zip(*marked, strict=True), "s", ms=size, color=_SECOND, mec="white", mew=0.18 * size, zorder=3)
    for number, key in enumerate(keys):
        _draw_legend(axes, key, (0.08, height - sum(bands[number:]) + bands[number] / 2), width)
    return canvas


def _array(values: Any) -> NDArray[np.float64]:
    return np.array(values, dtype=np.float64)


def _lit(one: Mapping[str, Any], o: Mapping[str, Any]) -> NDArray[np.uint8]:
    """A picture as it is shown; grey where no value of its map is known: if pale, all of them would seem to be low."""
    picture: NDArray[np.uint8] = o["picture"](one)
    for name, of in (("map", o), ("second", o.get("second") or {})):
        if one.get(name) is not None:
            values = _array(one[name])
            known = np.isfinite(values).any()
            return lit(picture if known else None, values, of["high"], bool(o.get("smooth")))
    return picture


def borders(
    member: NDArray[np.bool_], inside: float, start: tuple[float, float], sides: tuple[float, float]
) -> list[Segment]:
    """The borders of the member patches (row, column), `inside` of a patch within them.

    start, sides: the picture's corner, and its width and height.
    """
    patch = np.array([sides[0] / member.shape[1], sides[1] / member.shape[0]] * 2)
    wide = np.pad(member, 1)
    segments = []
    for row, column in zip(*np.nonzero(member), strict=True):
        above, below, left, right = (
            not wide[row + down, column + across] for down, across in ((0, 1), (2, 1), (1, 0), (1, 2))
        )
        top, bottom = row + inside * above, row + 1 - inside * below
        first, last = column + inside * left, column + 1 - inside * right
        ends = (
            (first, top, last, top),
            (first, bottom, last, bottom),
            (first, top, first, bottom),
            (last, top, last, bottom),
        )
        segments += [
            tuple(np.array(one) * patch + start * 2)
            for one, drawn in zip(ends, (above, below, left, right), strict=True)
            if drawn
        ]
    return segments


def _draw_lines(axes: Axes, segments: Sequence[Segment], color: str, points: float) -> None:
    """Lines on a light border."""
    from matplotlib.collections import LineCollection

    ends = [(one[:2], one[2:]) for one in segments]
    for ink, wide in (("white", points + 1.2), (color, points)):
        axes.add_collection(LineCollection(ends, colors=ink, linewidths=wide, capstyle="projecting"), autolim=False)


def _words(frame: pl.DataFrame) -> list[tuple[str, float]]:
    """The words of the instruction with the mean of their values over the shown pictures; none if these were told
    different ones.
    """
    told = {tuple(words or ()) for words in frame["words"].to_list()} if "words" in frame.columns else {()}
    if len(told) > 1 or () in told:
        return []
    lifts = np.array(frame["lifts"].to_list(), dtype=np.float64)
    return list(zip(frame["words"][0].to_list(), np.nanmean(lifts, axis=0).tolist(), strict=True))


def _lines(words: Sequence[tuple[str, float]], width: float) -> list[list[tuple[str, float]]]:
    """The words in as many lines as a picture of so many inches needs."""
    lines: list[list[tuple[str, float]]] = []
    room = 0.0
    for word in words:
        room -= _WORD_GAP + _LETTER * len(word[0])
        if room < 0.0 or not lines:
            lines.append([])
            room = width - 0.12 - _WORD_GAP - _LETTER * len(word[0])
        lines[-1].append(word)
    return lines


def _draw_words(axes: Axes, words: Sequence[tuple[str, float]], high: float, down: float) -> None:
    """The words side by side, each on a shade of its value."""
    from matplotlib.colors import to_rgba

    before: Any = "data"
    for word, value in words:
        box = {"boxstyle": "round,pad=0.25", "linewidth": 0,
               "facecolor": to_rgba(_WORD, float(strength(np.array(value), high)))}  # fmt: skip
        place, offset = ((0.12, down), (0, 0)) if before == "data" else ((1, 0.5), (9, 0))
        before = axes.annotate(word, place, offset, xycoords=before, textcoords="offset points", va="center", size=9,
                               bbox=box)  # fmt: skip


def _legend_columns(key: Sequence[Look], width: float) -> int:
    """In how many columns a legend fits into a picture of so many inches; 1 if it does not."""
    for columns in (4, 2):
        parts = np.array_split([0.45 + _LEGEND_LETTER * len(label) for *_, label in key], columns)
        if sum(part.max(initial=0.0) for part in parts) < width:
            return columns
    return 1


def _draw_legend(axes: Axes, key: Sequence[Look], place: tuple[float, float], width: float) -> None:
    from matplotlib.legend import Legend
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch
    from matplotlib.patheffects import withStroke

    handles: list[Artist] = []
    for color, points, label in key:
        if color == _PALE:
            handles.append(Patch(facecolor=color, label=label))
            continue
        effect = [withStroke(linewidth=points + 1.2, foreground="white")]
        mark = "" if points else "s"
        handles.append(Line2D([], [], color=color, linewidth=points, path_effects=effect, label=label, marker=mark,
                              ms=2 * _MARK, mec="white"))  # fmt: skip
    names = [label for *_, label in key]
    axes.add_artist(Legend(axes, handles, names, loc="center left", ncols=_legend_columns(key, width),
                           bbox_to_anchor=place, bbox_transform=axes.transData, borderaxespad=0.0, handlelength=1.6,
                           columnspacing=1.2, fontsize=7.5))  # fmt: skip
