"""How much of every image patch each object covers. Pure numpy: segmentation in, area fractions out."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from schemas.errors import BadArgument


def overlap_lengths(pixels: int, cells: int) -> NDArray[np.float64]:
    """Return (cells, pixels): which share of a cell's length each pixel fills, cells dividing the pixels evenly.

    A pixel on a border between two cells counts in both, by the part that lies in each. Rows sum to 1.
    """
    # In units of 1 / (pixels * cells) of the side all borders are integers, so the overlaps are exact.
    cell_start = np.arange(cells, dtype=np.int64)[:, None] * pixels
    pixel_start = np.arange(pixels, dtype=np.int64)[None, :] * cells
    overlap = np.minimum(cell_start + pixels, pixel_start + cells) - np.maximum(cell_start, pixel_start)
    return np.clip(overlap, 0, None) / pixels


def patch_coverage(
    segmentation: NDArray[np.integer], num_objects: int, grid_rows: int, grid_columns: int, rotate_180: bool
) -> NDArray[np.float32]:
    """Return the area fraction of every object in every patch of the image as the model sees it.

    segmentation: (height, width) object index per pixel, in 0..num_objects-1, in the environment's orientation.
    rotate_180: whether the model sees the picture rotated by 180 degrees.
    returns: (grid_rows * grid_columns, num_objects) float32, patches row by row; every row sums to 1.

    The patches divide the picture evenly whether or not its sides are multiples of the grid: a resize to the model's
    input size scales both alike, so fractions of the original picture are the fractions of what the model sees.
    """
    if segmentation.ndim != 2 or not segmentation.size:
        raise BadArgument(f"A segmentation has two axes (height, width) and pixels; got shape {segmentation.shape}.")
    if grid_rows < 1 or grid_columns < 1:
        raise BadArgument(f"A patch grid needs at least one row and one column; got {grid_rows} x {grid_columns}.")
    low, high = int(segmentation.min()), int(segmentation.max())
    if low < 0 or high >= num_objects:
        raise BadArgument(f"The segmentation holds indices {low} to {high}; with {num_objects} objects 0 to "
                          f"{num_objects - 1} are valid.")  # fmt: skip
    seen = segmentation[::-1, ::-1] if rotate_180 else segmentation
    row_share = overlap_lengths(seen.shape[0], grid_rows)
    column_share = overlap_lengths(seen.shape[1], grid_columns)
    coverage = np.zeros((grid_rows, grid_columns, num_objects))
    for index in np.unique(seen):
        coverage[:, :, index] = row_share @ (seen == index) @ column_share.T
    return coverage.reshape(grid_rows * grid_columns, num_objects).astype(np.float32)
