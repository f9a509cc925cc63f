"""Patches of stored pictures: which pixels a patch has, and which way up a person sees them. Pure functions on arrays.

The stored frame is what the model sees (turned, resized and cropped already, see `PolicyCameraView`), and a camera's
patches tile all of it evenly, row by row from its top left corner. Frame and map are therefore laid over each other
first, and only then turned to the way a person sees the scene.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.stores.store_format import PolicyCameraView

#: Grey that stands for a picture that was not stored.
NO_PICTURE = 205


def upright(image: NDArray[Any], view: PolicyCameraView) -> NDArray[Any]:
    """A stored picture or patch map (row, column, ...) as a person in the camera's place would see it.

    Rows are reversed unless the stored picture is upright; columns are reversed if it is mirrored, so that left is left
    as in the instruction. Turning twice gives the stored picture back.
    """
    return image[:: 1 if view.upright else -1, :: -1 if view.mirrored else 1]


def enlarge(patch_map: NDArray[np.floating], height: int, width: int, smooth: bool = False) -> NDArray[np.float64]:
    """A patch map (row, column) with a value for every pixel, (height, width): patches divide both sides evenly.

    A pixel has the value of the patch in which its centre lies; with `smooth`, values are bilinear between patch
    centres and constant beyond the outermost ones, which shows the map softer than it is known.
    """
    values = np.asarray(patch_map, dtype=np.float64)
    if values.ndim != 2 or not values.size:
        raise BadArgument(f"A patch map has two axes (row, column) and patches; got shape {values.shape}.")
    rows, columns = _centres(height, values.shape[0]), _centres(width, values.shape[1])
    if not smooth:
        return np.asarray(values[np.floor(rows).astype(int)][:, np.floor(columns).astype(int)])
    for axis, centres in ((0, rows), (1, columns)):
        place = np.clip(centres - 0.5, 0.0, values.shape[axis] - 1.0)
        below = np.floor(place).astype(int)
        above = np.minimum(below + 1, values.shape[axis] - 1)
        part = (place - below).reshape((-1, 1) if axis == 0 else (1, -1))
        values = (1.0 - part) * values.take(below, axis) + part * values.take(above, axis)
    return values


def _centres(pixels: int, cells: int) -> NDArray[np.float64]:
    """Where the pixels' centres lie, in units of a cell."""
    return (np.arange(pixels) + 0.5) * cells / pixels
