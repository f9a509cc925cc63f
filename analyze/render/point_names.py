"""Names of points in a picture: none covers a point, a bar, a line or another name."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vla_attention.analyze.render.style import NOTE_COLOR
from vla_attention.analyze.render.terminal import shortened

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: How far from its point a name may stand, in points of type; unless it is close, with a line. And on which sides.
_DISTANCES = (4, 10, 18, 26)
_SIDES = np.array([(1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1), (0, 1), (0, -1)])


def name_points(
    axes: Axes,
    names: Sequence[str],
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    low: NDArray[np.float64],
    high: NDArray[np.float64],
) -> None:
    """Write names beside points with bars from low to high, the highest first; those that find no room are counted.

    The axes are logarithmic and have their final place. Boxes are left, bottom, right, top in pixels.
    """
    canvas: Any = axes.figure
    point, frame = canvas.dpi / 72, axes.get_window_extent().extents
    at, bottom, top = (axes.transData.transform(np.column_stack([x, np.maximum(one, 1e-12)])) for one in (y, low, high))
    points = np.hstack([at - 3 * point, at + 3 * point])
    straight = [line.get_window_extent().extents for line in axes.lines if line.get_linestyle() in ("--", ":")]
    taken, named = [*points, *np.hstack([bottom - point, top + point]), *straight], list[NDArray[np.float64]]()
    for i in np.argsort(-y):
        text = axes.annotate(
            shortened(names[i], 24), (x[i], y[i]), (0, 0), textcoords="offset points", size=7, va="bottom"
        )
        size = np.array(text.get_window_extent().size)
        for distance, side in product(_DISTANCES, _SIDES):
            corner = at[i] + side * (distance * point + size / 2) - size / 2
            box = np.concatenate([corner, corner + size])
            inside = (box[:2] > frame[:2]).all() and (box[2:] < frame[2:]).all()
            # The line to the point is a row of boxes without an extent.
            steps = 9 if distance > _DISTANCES[0] else 0
            line = np.linspace(at[i], np.clip(at[i], box[:2], box[2:]), steps)[:, [0, 1, 0, 1]]
            if inside and not _touch([box], taken) and not _touch(line, [*named, *np.delete(points, i, axis=0)]):
                break
        else:
            text.remove()
            continue
        text.xyann = tuple((corner - at[i]) / point)
        named.append(box)
        taken += [box, *line]
        if steps:
            ends = axes.transData.inverted().transform(line[[0, -1], :2])
            axes.plot(*ends.T, color=NOTE_COLOR, linewidth=0.4, zorder=1)
    if len(named) < len(names):
        said = f"{len(names) - len(named)} not named"
        axes.text(0, 1.01, said, transform=axes.transAxes, color=NOTE_COLOR, size=7)


def _touch(boxes: ArrayLike, others: ArrayLike) -> bool:
    """Whether any of some boxes has a point in common with any of others."""
    one, other = np.reshape(boxes, (-1, 1, 4)), np.reshape(others, (1, -1, 4))
    apart = (one[..., :2] > other[..., 2:]) | (one[..., 2:] < other[..., :2])
    return not bool(apart.any(axis=-1).all())
