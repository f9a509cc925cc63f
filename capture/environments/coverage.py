"""The share of every image patch that each object covers, computed from a segmentation with numpy only."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.layout import PatchGrid


def overlap_lengths(pixels: int, cells: int, visible: float = 1.0) -> NDArray[np.float64]:
    """Return (cell, pixel), the share of each cell's length that each pixel fills. The cells divide the visible middle
    evenly.

    A pixel on the border of two cells counts in both, by its part in each. Rows sum to 1.
    """
    # Lengths are in units of a cell: if everything is visible, borders that coincide are then the same number.
    cell = np.arange(cells, dtype=np.float64)[:, None]
    border = (np.arange(pixels + 1) / pixels - (1.0 - visible) / 2.0) * cells / visible
    border = np.where(np.abs(border - np.round(border)) < 1e-9, np.round(border), border)
    overlap = np.minimum(cell + 1, border[None, 1:]) - np.maximum(cell, border[None, :-1])
    clipped: NDArray[np.float64] = np.clip(overlap, 0.0, None)
    return clipped


def camera_coverage(
    segmentation: NDArray[np.integer],
    num_objects: int,
    grids: Sequence[PatchGrid],
    *,
    flip_rows: bool = False,
    flip_columns: bool = False,
    visible: float = 1.0,
) -> NDArray[np.float32]:
    """Return the share of every patch of a camera's grids that each object covers, (patch, object); rows sum to 1.

    segmentation: (height, width) object index per pixel, in 0..num_objects-1, in the environment's orientation.
    grids: of `schemas.layout.camera_grids`; their patches follow each other, row by row.
    flip_rows, flip_columns: whether the model's image has the rows, the columns reversed (both: turned by 180°).
    visible: side of the part that the model sees, as a share of the picture's side, around the middle.

    The patches divide the picture evenly even if its sides are no multiples of the grid. A resize to the model's input
    size scales picture and patches alike, so the fractions of the original picture hold for the model's image.
    """
    if segmentation.ndim != 2 or not segmentation.size:
        raise BadArgument(f"A segmentation has two axes (height, width) and pixels; got shape {segmentation.shape}.")
    low, high = int(segmentation.min()), int(segmentation.max())
    if low < 0 or high >= num_objects:
        raise BadArgument(
            f"The segmentation holds indices {low} to {high}; with {num_objects} objects, 0 to {num_objects - 1} "
            "are valid."
        )
    if not 0.0 < visible <= 1.0:
        raise BadArgument(f"The visible share of a picture's side is {visible}; it must be above 0 and at most 1.")
    seen = segmentation[:: -1 if flip_rows else 1, :: -1 if flip_columns else 1]
    height, width = seen.shape
    of_grids = []
    for grid in grids:
        # Patches of a part of the picture are made of the shares of single pixels.
        rows, columns = (grid.rows, grid.columns) if grid.covers_all else (height, width)
        row_share, column_share = overlap_lengths(height, rows, visible), overlap_lengths(width, columns, visible)
        coverage = np.zeros((rows, columns, num_objects))
        for index in np.unique(seen):
            coverage[:, :, index] = row_share @ (seen == index) @ column_share.T
        if not grid.covers_all:
            down, across = grid.shares(height, width)
            coverage = np.einsum("ih,hwo,jw->ijo", down, coverage.astype(np.float32), across, optimize=True)
        of_grids.append(coverage.reshape(grid.num_patches, num_objects).astype(np.float32))
    return np.concatenate(of_grids)
