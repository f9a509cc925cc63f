"""Area fractions of objects in patches."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from vla_attention.capture.environments.coverage import camera_coverage, overlap_lengths
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.layout import PatchGrid

STRAIGHT = {"flip_rows": False, "flip_columns": False}
TURNED = {"flip_rows": True, "flip_columns": True}
NUM_OBJECTS = 4
pictures = arrays.arrays(
    np.int32, st.tuples(st.integers(1, 13), st.integers(1, 13)), elements=st.integers(0, NUM_OBJECTS - 1)
)
grids = st.tuples(st.integers(1, 9), st.integers(1, 9))


def patch_coverage(segmentation, num_objects, rows, columns, **options):
    """The coverage of one grid over the whole picture."""
    return camera_coverage(segmentation, num_objects, [PatchGrid(rows, columns, 8, 8)], **options)


def fine_grained(segmentation: np.ndarray, grid_rows: int, grid_columns: int) -> np.ndarray:
    """Reference: enlarge every pixel until patches hold whole pixels only, then count."""
    height, width = segmentation.shape
    large = np.repeat(np.repeat(segmentation, grid_rows, axis=0), grid_columns, axis=1)
    patches = large.reshape(grid_rows, height, grid_columns, width).transpose(0, 2, 1, 3).reshape(-1, height * width)
    return np.stack([(patches == index).mean(axis=1) for index in range(NUM_OBJECTS)], axis=1)


@given(pictures, grids)
def test_equals_counting_in_an_enlarged_picture(segmentation: np.ndarray, grid: tuple[int, int]) -> None:
    coverage = patch_coverage(segmentation, NUM_OBJECTS, *grid, **STRAIGHT)
    assert coverage.dtype == np.float32
    assert coverage.shape == (grid[0] * grid[1], NUM_OBJECTS)
    np.testing.assert_allclose(coverage, fine_grained(segmentation, *grid), atol=1e-6)


@given(pictures, grids, st.booleans())
def test_rows_sum_to_one_and_areas_are_kept(segmentation: np.ndarray, grid: tuple[int, int], rotate: bool) -> None:
    coverage = patch_coverage(segmentation, NUM_OBJECTS, *grid, **(TURNED if rotate else STRAIGHT))
    np.testing.assert_allclose(coverage.sum(axis=1), 1, atol=1e-6)
    areas = np.bincount(segmentation.ravel(), minlength=NUM_OBJECTS) / segmentation.size
    np.testing.assert_allclose(coverage.mean(axis=0), areas, atol=1e-6)


@given(st.integers(1, 300), st.integers(1, 40))
def test_overlaps_fill_cells_and_use_pixels_evenly(pixels: int, cells: int) -> None:
    overlap = overlap_lengths(pixels, cells)
    np.testing.assert_allclose(overlap.sum(axis=1), 1)
    np.testing.assert_allclose(overlap.sum(axis=0), cells / pixels)


def test_patches_run_row_by_row() -> None:
    segmentation = np.array([[0, 1], [2, 3]])
    np.testing.assert_array_equal(patch_coverage(segmentation, 4, 2, 2, **STRAIGHT), np.eye(4))
    np.testing.assert_array_equal(patch_coverage(segmentation, 4, 2, 2, **TURNED), np.eye(4)[::-1])


def test_a_pixel_on_a_border_counts_by_its_parts() -> None:
    coverage = patch_coverage(np.array([[0, 1, 0]]), 2, 1, 2, **STRAIGHT)
    np.testing.assert_allclose(coverage, [[2 / 3, 1 / 3], [2 / 3, 1 / 3]], rtol=1e-6)


@given(pictures, grids, st.booleans(), st.booleans())
def test_rows_and_columns_are_reversed_each_by_its_own_flag(segmentation, grid, flip_rows, flip_columns):
    """Pictures without symmetry tell rows from columns; no mirrored picture has the coverage of the turned one."""
    flipped = np.flipud(segmentation) if flip_rows else segmentation
    flipped = np.fliplr(flipped) if flip_columns else flipped
    found = patch_coverage(segmentation, NUM_OBJECTS, *grid, flip_rows=flip_rows, flip_columns=flip_columns)
    np.testing.assert_allclose(found, fine_grained(flipped, *grid), atol=1e-6)


def test_rows_alone_can_be_reversed_and_only_the_middle_seen():
    segmentation = np.zeros((8, 8), dtype=int)
    segmentation[0, :] = 1  # an edge that half of the side does not reach
    segmentation[2, 2:6] = 2
    flipped = patch_coverage(segmentation, 3, 4, 4, flip_rows=True, flip_columns=False, visible=0.5)
    assert flipped[:12].tolist() == [[1, 0, 0]] * 12
    assert flipped[12:].tolist() == [[0, 0, 1]] * 4
    with pytest.raises(BadArgument, match="visible"):
        patch_coverage(segmentation, 3, 4, 4, **STRAIGHT, visible=0.0)
