"""The share of every image patch that each object covers, computed from a segmentation with numpy only."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

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


def patch_coverage(
    segmentation: NDArray[np.integer],
    num_objects: int,
    grid_rows: int,
    grid_columns: int,
    *,
    flip_rows: bool,
    flip_columns: bool,
    visible: float = 1.0,
) -> NDArray[np.float32]:
    """Return the area fraction of every object in every patch of the model's image.

    segmentation: (height, width) object index per pixel, in 0..num_objects-1, in the environment's orientation.
    flip_rows, flip_columns: whether the model's image has the rows, the columns reversed (both: turned by 180°).
    visible: side of the part that the model sees, as a share of the picture's side, around the middle.
    returns: (grid_rows * grid_columns, num_objects) float32, patches row by row; every row sums to 1.

    The patches divide the picture evenly even if its sides are no multiples of the grid. A resize to the model's input
    size scales picture and patches alike, so the fractions of the original picture hold for the model's image.
    """
    if segmentation.ndim != 2 or not segmentation.size:
        raise BadArgument(f"A segmentation has two axes (height, width) and pixels; got shape {segmentation.shape}.")
    if grid_rows < 1 or grid_columns < 1:
        raise BadArgument(f"A patch grid needs at least one row and one column; got {grid_rows} x {grid_columns}.")
    low, high = int(segmentation.min()), int(segmentation.max())
    if low < 0 or high >= num_objects:
        raise BadArgument(
            f"The segmentation holds indices {low} to {high}; with {num_objects} objects, 0 to {num_objects - 1} "
            "are valid."
        )
    if not 0.0 < visible <= 1.0:
        raise BadArgument(f"The visible share of a picture's side is {visible}; it must be above 0 and at most 1.")
    seen = segmentation[:: -1 if flip_rows else 1, :: -1 if flip_columns else 1]
    row_share = overlap_lengths(seen.shape[0], grid_rows, visible)
    column_share = overlap_lengths(seen.shape[1], grid_columns, visible)
    coverage = np.zeros((grid_rows, grid_columns, num_objects))
    for index in np.unique(seen):
        coverage[:, :, index] = row_share @ (seen == index) @ column_share.T
    return coverage.reshape(grid_rows * grid_columns, num_objects).astype(np.float32)


def camera_coverage(
    segmentation: NDArray[np.integer],
    num_objects: int,
    grids: Sequence[PatchGrid],
    *,
    flip_rows: bool = False,
    flip_columns: bool = False,
    visible: float = 1.0,
) -> NDArray[np.float32]:
    """Return the share of every patch of a camera's grids that each object covers, (patch, object).

    grids: of `schemas.layout.camera_grids`; their patches follow each other. Other arguments: as in `patch_coverage`.
    """
    cover = partial(
        patch_coverage, segmentation, num_objects, flip_rows=flip_rows, flip_columns=flip_columns, visible=visible
    )
    of_grids = []
    for grid in grids:
        if grid.covers_all:
            of_grids.append(cover(grid.rows, grid.columns))
            continue
        height, width = segmentation.shape
        down, across = grid.shares(height, width)
        pixels = cover(height, width).reshape(height, width, num_objects)
        covered = np.einsum("ih,hwo,jw->ijo", down, pixels, across, optimize=True)
        of_grids.append(covered.reshape(grid.num_patches, num_objects).astype(np.float32))
    return np.concatenate(of_grids)
