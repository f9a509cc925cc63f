"""Attention maps against object masks: centre of attention, pointing game, IoU, and chance levels. Pure arithmetic.

A map has one value per patch; patches go row by row from the top left, on a grid of `rows` x `columns`. Masks are sets
of patches. Axes are named in the docstrings; `...` stands for any axes in between, such as (denoise, head).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Masks = NDArray[np.bool_]


#: What is not lower by more than this factor is as high. Stored rows have few bits, so that patches of a map are often
#: equal; the last bits of their means are those of the processor, and decide nothing.
_AS_HIGH = 1 - 1e-5


def patch_centres(rows: int, columns: int) -> Floats:
    """Row and column of every patch's centre in patch units from the picture's top left corner, shape (patch, 2)."""
    row, column = np.divmod(np.arange(rows * columns), columns)
    return np.stack([row + 0.5, column + 0.5], axis=-1)


def centre_of_mass(maps: NDArray[np.floating], centres: Floats) -> Floats:
    """Mean position under a map: sum of value x position / sum of values; (..., patch) gives (..., 2) in patch units.

    NaN where a map is all 0. Of a uniform map it is the picture's middle.
    """
    values = np.asarray(maps, dtype=np.float64)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray((values @ centres) / values.sum(axis=-1, keepdims=True))


def distance_in_pictures(first: Floats, second: Floats, rows: int, columns: int) -> Floats:
    """Distance of positions (..., 2) in patch units, in picture sides: sqrt((dr / rows)^2 + (dc / columns)^2).

    The diagonal is 1.41 long; the centre of a uniform map is at most half of that away.
    """
    step = (first - second) / np.array([rows, columns], dtype=np.float64)
    return np.asarray(np.sqrt((step**2).sum(axis=-1)))


def object_masks(coverage: NDArray[np.floating], least: float) -> Masks:
    """Patches of which an object covers at least the share `least`, of the same shape as the coverage."""
    return np.asarray(coverage >= least * _AS_HIGH)


def near_patches(rows: int, columns: int, tolerance: float) -> Masks:
    """Which patches' centres are at most `tolerance` patch widths apart, shape (patch, patch)."""
    centres = patch_centres(rows, columns)
    squared = ((centres[:, None] - centres[None]) ** 2).sum(axis=-1)
    return np.asarray(squared <= tolerance**2 + 1e-9)


def grown(masks: Masks, near: Masks) -> Masks:
    """Masks (replan, patch, item) with every patch that is near one of theirs; `near` is from `near_patches`."""
    return np.asarray(np.matmul(near.astype(np.float32), masks.astype(np.float32)) > 0.5)


def pointing_hits(maps: NDArray[np.floating], masks: Masks | NDArray[np.float32]) -> Floats:
    """The pointing game: 1 where a map's highest patch lies in the mask, else 0.

    Zhang, Lin, Brandt, Shen & Sclaroff 2018, "Top-down neural attention by excitation backprop", IJCV 126, section 5.1,
    who accept a maximum within 15 pixels of the object: give masks that `grown` has widened by as much. Of several
    equally high patches each counts its part, so that a uniform map scores what chance does: the mask's share of the
    picture, which is also what a map scores on average over all shifts.

    Args:
        maps: (replan, ..., patch).
        masks: (replan, patch, item).

    Returns:
        (replan, ..., item); NaN where the item has no patch.
    """
    highest = (maps >= maps.max(axis=-1, keepdims=True) * _AS_HIGH).astype(np.float32)
    hits = _over_patches(highest / highest.sum(axis=-1, keepdims=True), masks)
    there = mask_sizes(masks) > 0
    return np.where(_over_replans(there, hits.ndim), hits, np.nan)


def regions_of_percentiles(maps: NDArray[np.floating], percentiles: Sequence[float]) -> list[Masks]:
    """For each percentile the patches at or above it in their own map (linear interpolation between values).

    Of 256 patches that is 26 at 90 and 52 at 80; of a constant map it is all.
    """
    limits = np.percentile(maps, list(percentiles), axis=-1, keepdims=True)
    return [np.asarray(maps >= limit * _AS_HIGH) for limit in limits]


def mask_sizes(masks: Masks | NDArray[np.float32]) -> Floats:
    """Number of patches of masks (replan, patch, item), shape (replan, item)."""
    # A product with ones: numpy's own sum over a middle axis takes ten times as long.
    ones = np.ones((1, masks.shape[1]), dtype=np.float32)
    return np.asarray(np.matmul(ones, masks.astype(np.float32, copy=False))[:, 0], dtype=np.float64)


def intersection_over_union(regions: Masks, masks: Masks | NDArray[np.float32]) -> Floats:
    """IoU of regions (replan, ..., patch) and masks (replan, patch, item): |both| / |either| (Jaccard 1912).

    Masks may be 0 and 1 in float32, which saves converting the same masks for every region.

    Returns:
        (replan, ..., item); NaN where the item has no patch, so that there is nothing to find.
    """
    common = _over_patches(regions.astype(np.float32), masks)
    sizes = _over_replans(mask_sizes(masks), common.ndim)
    union = regions.sum(axis=-1)[..., None] + sizes - common
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(sizes > 0, common / union, np.nan)


#: Shifts along each side of the picture that `shifted_masks` takes at a replan. More need memory: 4 x 4 of 52 replans,
#: 256 patches and 14 items are 12 MB.
_SHIFTS_A_SIDE = 4


def shifted_masks(masks: Masks | NDArray[np.float32], rows: int, columns: int) -> NDArray[np.float32]:
    """Masks (replan, patch, item) moved by many shifts that wrap around the picture: (replan, patch, shift, item).

    All shifts of a picture of up to 4 x 4 patches. Of a larger one every replan has 4 x 4 evenly spaced ones, which
    begin at another place at the next replan, so that 16 replans have all shifts of 16 x 16 patches.
    """
    replans, patches, items = masks.shape
    pictures = masks.astype(np.float32, copy=False).reshape(replans, rows, columns, items)
    row_shifts, column_shifts = (min(side, _SHIFTS_A_SIDE) for side in (rows, columns))
    shifted = np.empty((replans, rows, columns, row_shifts, column_shifts, items), np.float32)
    strides = -(-rows // row_shifts), -(-columns // column_shifts)
    for replan in range(replans):
        first = replan % strides[0], replan // strides[0] % strides[1]
        four = np.tile(pictures[replan], (2, 2, 1))  # a part of four copies is the picture, moved around
        for i in range(row_shifts):
            for j in range(column_shifts):
                by = (first[0] + i * rows // row_shifts) % rows, (first[1] + j * columns // column_shifts) % columns
                top, left = rows - by[0], columns - by[1]
                shifted[replan, :, :, i, j] = four[top : top + rows, left : left + columns]
    return shifted.reshape(replans, patches, row_shifts * column_shifts, items)


def shifted_iou(regions: Masks, shifted: NDArray[np.float32]) -> Floats:
    """Mean IoU of regions (replan, ..., patch) with masks that were moved about the picture: what chance gives.

    `shifted` is from `shifted_masks`; moving the mask is moving the map. Scattered patches overlap as much on average,
    but the IoU rises faster than the overlap: a region in one piece, which overlaps much or not at all, has a higher
    mean.

    Returns:
        (replan, ..., item); NaN where the item has no patch.
    """
    replans, patches, shifts, items = shifted.shape
    flat = shifted.reshape(replans, patches, shifts * items)
    common = _over_patches(regions.astype(np.float32), flat)
    common = common.reshape(*common.shape[:-1], shifts, items)
    sizes = _over_replans(mask_sizes(shifted[:, :, 0]), common.ndim)
    union = regions.sum(axis=-1)[..., None, None] + sizes - common
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(sizes[..., 0, :] > 0, (common / union).mean(axis=-2), np.nan)


def _over_patches(values: NDArray[np.float32], masks: Masks | NDArray[np.float32]) -> Floats:
    """Sum of values (replan, ..., patch) over the patches of masks (replan, patch, item): (replan, ..., item)."""
    flat = values.reshape(values.shape[0], -1, values.shape[-1])
    product = np.matmul(flat, masks.astype(np.float32, copy=False)).astype(np.float64)
    return np.asarray(product.reshape(*values.shape[:-1], masks.shape[-1]))


def _over_replans(values: NDArray[Any], ndim: int) -> NDArray[Any]:
    """(replan, item) as (replan, 1, ..., item) with so many axes."""
    return values.reshape(values.shape[0], *(1,) * (ndim - 2), values.shape[-1])
