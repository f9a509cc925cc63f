"""`group_patches`: what the groups take at one replan: patches of pictures, pieces of the prompt, shares of spans."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.measures.patch_maps import PictureMap, seen_cameras
from vla_attention.analyze.measures.selected import SelectedEpisode
from vla_attention.analyze.show.patch_pictures import NO_PICTURE, upright
from vla_attention.analyze.show.plot_axes import hide_frame
from vla_attention.analyze.show.plot_colours import NOTE_COLOR, group_styles
from vla_attention.analyze.show.plot_style import drawn_in_our_style, new_figure, save_figure
from vla_attention.analyze.show.plot_text import explain, shortened, title
from vla_attention.schemas.groupings.grouping import Grouping
from vla_attention.schemas.groupings.resolve import resolve
from vla_attention.schemas.layout import Piece, picture_size
from vla_attention.schemas.safe_text import visible
from vla_attention.schemas.stores.store_format import PolicyCameraView

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

STEM = "group_patches"
#: Opacity of a patch that a group takes completely: the picture below stays visible.
_OPACITY = 0.62
#: Most rows of pictures; groups that may overlap get a row each.
_MOST_ROWS = 12
_CHARACTERS = 84


@drawn_in_our_style
def plot_group_patches(item: SelectedEpisode, grouping: Grouping, replan: int, folder: Path) -> list[Path]:
    """Draw a grouping on one replan of one episode; returns the paths of png, pdf and csv.

    A patch has the colour of its group, as opaque as the group's weight there; a patch that several groups share
    (objects cover parts of it) has their mixture. Groups that may overlap get a picture each. The csv has every weight
    that is not 0.
    """
    resolved = resolve(grouping, item.tokens)
    weights = resolved.weights[replan if len(resolved.weights) > 1 else 0]
    styles = group_styles(grouping.names)
    cameras = seen_cameras(item)
    pieces = _pieces(item, replan)
    layers = _picture_rows(grouping, weights, item, cameras)
    hidden, layers = max(0, len(layers) - _MOST_ROWS), layers[:_MOST_ROWS]
    text_lines = _lines_of(pieces)
    spans = item.tokens.layout.spans
    columns = max(len(cameras), 1)
    heights = [3.1 if columns < 3 else 2.4] * len(layers) if cameras else []
    if pieces:
        heights.append(0.25 + 0.24 * len(text_lines))
    heights.append(max(0.55 + 0.24 * len(spans), 0.17 * len(grouping.names)))
    figure = new_figure(9, 1.1 + sum(heights) + 0.25 * len(layers))
    note = (
        f"{item.episode.name} of {item.store.suite}, replan {replan} of {item.tokens.num_replans}: "
        f"'{visible(item.episode.attributes.instruction)}'"
    )
    if hidden:
        note += f"; {hidden} more groups with patches have no picture here"
    title(figure, f"What the groups of '{grouping.name}' take", note)
    grid = figure.add_gridspec(len(heights), columns, height_ratios=heights)
    _draw_pictures(figure, grid, layers, cameras, item, replan, weights, grouping, styles)
    row = len(layers) if cameras else 0
    if pieces:
        _draw_prompt(figure.add_subplot(grid[row, :]), text_lines, weights, grouping, styles)
        row += 1
    bars = figure.add_subplot(grid[row, :])
    _draw_spans(bars, spans, weights, grouping, styles)
    return save_figure(figure, folder, STEM, _data(item, grouping, weights))


def _picture_rows(
    grouping: Grouping, weights: NDArray[np.float32], item: SelectedEpisode, cameras: Sequence[str]
) -> list[tuple[int, ...]]:
    """Which groups each row of pictures shows: all of them in one, or one each where they may overlap."""
    everything = tuple(range(len(grouping.names)))
    if not cameras:
        return []
    if not grouping.overlap:
        return [everything]
    keys = [item.tokens.layout.patch_keys(camera) for camera in cameras]
    seen = [i for i in everything if any(weights[own, i].any() for own in keys)]
    return [(i,) for i in seen] or [everything]


def _draw_pictures(
    figure: Figure,
    grid: Any,
    layers: Sequence[tuple[int, ...]],
    cameras: Sequence[str],
    item: SelectedEpisode,
    replan: int,
    weights: NDArray[np.float32],
    grouping: Grouping,
    styles: dict[str, dict[str, str]],
) -> None:
    from matplotlib.colors import to_rgb

    colors = np.array([to_rgb(styles[name]["color"]) for name in grouping.names])
    for row, members in enumerate(layers):
        for column, camera in enumerate(cameras):
            axes = figure.add_subplot(grid[row, column])
            picture = PictureMap.of(item.tokens.layout, camera)
            chosen = np.moveaxis(picture.highest(weights[picture.keys][:, members].T), 0, -1)
            _draw_camera(axes, item, camera, replan, picture, _mixture(chosen, colors[list(members)]))
            name = camera if len(members) > 1 else f"{camera}: {grouping.names[members[0]]}"
            axes.set_title(shortened(name, 44), size=8)


def _mixture(weights: NDArray[np.float32], colors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Colour and opacity (row, column, 4) of cells of which groups take shares (row, column, group)."""
    total = weights.sum(axis=-1, keepdims=True)
    mixed = weights @ colors / np.where(total > 0, total, 1.0)
    return np.concatenate([mixed, _OPACITY * np.minimum(total, 1.0)], axis=-1)


def _draw_camera(
    axes: Axes, item: SelectedEpisode, camera: str, replan: int, picture: PictureMap, patches: NDArray[np.float64]
) -> None:
    name = f"frames/{camera}"
    stored = name in item.episode.attributes.arrays
    frame = (
        item.episode.read(name, replan)
        if stored
        else np.full((*picture_size([item.tokens.layout], camera), 3), NO_PICTURE, dtype=np.uint8)
    )
    view = next((view for view in item.store.attributes.policy.cameras if view.name == camera), None)
    if view is not None:  # as a person sees the scene, like all other pictures of it
        frame, patches = upright(frame, view), upright(patches, view)
    height, width = frame.shape[:2]
    axes.imshow(frame, interpolation="nearest")
    axes.imshow(patches, extent=(-0.5, width - 0.5, height - 0.5, -0.5), interpolation="nearest")
    axes.set_xticks(np.arange(1, picture.columns) * width / picture.columns - 0.5, minor=True)
    axes.set_yticks(np.arange(1, picture.rows) * height / picture.rows - 0.5, minor=True)
    axes.grid(which="minor", color="white", linewidth=0.25, alpha=0.6)
    _number_patches(axes, picture, (height, width), view)
    hide_frame(axes)
    if not stored:
        axes.set_xlabel("no pictures in the store", size=7, color=NOTE_COLOR)


def _number_patches(axes: Axes, picture: PictureMap, size: tuple[int, int], view: PolicyCameraView | None) -> None:
    """Number rows and columns of patches as `patch:` selectors count them: in the picture that the model sees.

    Where the camera has several grids they count in fractions of the picture.
    """
    for axis, count, length, turned in (
        (axes.yaxis, picture.rows, size[0], view is not None and not view.upright),
        (axes.xaxis, picture.columns, size[1], view is not None and view.mirrored),
    ):
        counted = picture.cells_are_patches
        numbers: NDArray[np.number] = np.arange(0, count, max(1, count // 4)) if counted else np.arange(5) / 4
        places = (numbers + 0.5) * length / count - 0.5 if counted else numbers * length - 0.5
        axis.set_ticks(length - 1 - places if turned else places, [str(number) for number in numbers])
    axes.tick_params(which="both", length=0, labelsize=6, labelcolor=NOTE_COLOR, pad=1)


def _pieces(item: SelectedEpisode, replan: int) -> list[tuple[Piece, str]]:
    """The pieces of the replan's prompt with their text as the prompt has it."""
    tokens = item.tokens
    if not tokens.prompts or tokens.prompt_index is None:
        return []
    prompt = tokens.prompts[int(tokens.prompt_index[replan])]
    return [
        (piece, visible(prompt.text[piece.start : piece.stop].replace("\n", "\u21b5").strip()) or "\u2423")
        for piece in prompt.pieces
    ]


def _lines_of(pieces: Sequence[tuple[Piece, str]]) -> list[list[tuple[Piece, str, int]]]:
    """The pieces in lines of a limited number of characters, each with its place in the line."""
    lines: list[list[tuple[Piece, str, int]]] = [[]]
    place = 0
    for piece, text in pieces:
        length = len(text) + 2
        if place and place + length > _CHARACTERS:
            lines.append([])
            place = 0
        lines[-1].append((piece, text, place))
        place += length
    return lines


def _draw_prompt(
    axes: Axes,
    lines: Sequence[Sequence[tuple[Piece, str, int]]],
    weights: NDArray[np.float32],
    grouping: Grouping,
    styles: dict[str, dict[str, str]],
) -> None:
    from matplotlib.patches import Rectangle

    for row, line in enumerate(lines):
        for piece, text, place in line:
            takers = [name for name, weight in zip(grouping.names, weights[piece.key], strict=True) if weight > 0]
            width = len(text) + 1.4
            axes.add_patch(Rectangle((place, row + 0.08), width, 0.84, facecolor="white", edgecolor="#BBBBBB", lw=0.5))
            for i, name in enumerate(takers):  # a piece of several groups has a stripe of each
                box = (place + i * width / len(takers), row + 0.08)
                color = styles[name]["color"]
                axes.add_patch(Rectangle(box, width / len(takers), 0.84, facecolor=color, alpha=0.5, lw=0))
            axes.text(place + width / 2, row + 0.5, text, ha="center", va="center", size=7.5, family="DejaVu Sans Mono")
    axes.set_xlim(0, _CHARACTERS)
    axes.set_ylim(len(lines), 0)
    axes.set_title("pieces of the prompt", size=8, loc="left")
    axes.axis("off")


def _draw_spans(
    axes: Axes,
    spans: Sequence[Any],
    weights: NDArray[np.float32],
    grouping: Grouping,
    styles: dict[str, dict[str, str]],
) -> None:
    shares = np.array([weights[span.start : span.stop].mean(axis=0) for span in spans])
    if not shares.any():
        explain(axes, "No group takes any key at this replan.")
        return
    height = 0.8 / len(grouping.names) if grouping.overlap else 0.8
    left = np.zeros(len(spans))
    for i, name in enumerate(grouping.names):
        if not shares[:, i].any():
            continue
        position = np.arange(len(spans), dtype=float)
        if grouping.overlap:  # side by side, because the shares of one span may add up to more than all of it
            position += (i + 0.5) * height - 0.4
        axes.barh(
            position, 100 * shares[:, i], height, None if grouping.overlap else left, color=styles[name]["color"],
            hatch=styles[name]["hatch"], edgecolor="white", linewidth=0.4,
            label=f"{shortened(name, 28)} ({_count(float(weights[:, i].sum()))})",
        )  # fmt: skip
        left += 100 * shares[:, i]
    axes.set_yticks(range(len(spans)), [f"{shortened(span.name, 24)} ({span.num_keys})" for span in spans])
    axes.set_ylim(len(spans) - 0.5, -0.5)
    axes.set_xlim(0, 100)
    axes.set_xlabel("share of the span's keys that each group takes (%); in brackets: numbers of keys")
    axes.tick_params(axis="y", length=0)
    axes.legend(loc="upper left", bbox_to_anchor=(1.01, 1.05), borderaxespad=0.0, handlelength=1.2)


def _count(keys: float) -> str:
    return f"{keys:.0f}" if abs(keys - round(keys)) < 0.005 else f"{keys:.1f}"


def _data(item: SelectedEpisode, grouping: Grouping, weights: NDArray[np.float32]) -> pl.DataFrame:
    layout = item.tokens.layout
    of_key = layout.span_of_key()
    keys, groups = np.nonzero(weights)
    rows, columns = [], []
    for key in keys:
        span = layout.spans[of_key[key]]
        row, column = divmod(int(key) - span.start, span.grid.columns) if span.grid else (None, None)
        rows.append(row)
        columns.append(column)
    return pl.DataFrame(
        {
            "group": [grouping.names[i] for i in groups],
            "key": keys,
            "span": [layout.spans[of_key[key]].name for key in keys],
            "row": pl.Series(rows, dtype=pl.Int64),
            "column": pl.Series(columns, dtype=pl.Int64),
            "weight": weights[keys, groups],
        }
    )
