"""Patches and pixels: what the patches of a cropped picture show, and patch maps enlarged to pictures."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from vla_attention.analyze.core.camera_maps import enlarge
from vla_attention.capture.environments.coverage import camera_coverage
from vla_attention.capture.policies.cosmos.preprocess import crop_and_enlarge, visible_area
from vla_attention.schemas.layout import PatchGrid


@pytest.mark.parametrize("flip_columns", [True, False])
def test_patches_line_up_with_what_a_cropping_policy_stores(flip_columns: bool) -> None:
    """Coverage comes from the whole picture and `visible`, the stored frame is the crop: both have the same pixels."""
    size, patches = 224, 16
    segmentation = np.zeros((size, size), dtype=np.int64)
    segmentation[40:124, 150:190] = 1  # in the simulator's order
    turned = segmentation[::-1, :: -1 if flip_columns else 1]
    picture = np.where(turned[..., None] == 1, 255, 0).astype(np.uint8).repeat(3, axis=-1)
    frame = crop_and_enlarge(picture)
    grids = [PatchGrid(patches, patches, size, size)]
    share = camera_coverage(segmentation, 2, grids, flip_rows=True, flip_columns=flip_columns, visible=visible_area())[
        :, 1
    ]
    seen = (frame[..., 0] / 255.0).reshape(patches, size // patches, patches, size // patches).mean(axis=(1, 3))
    assert 0.05 < seen.mean() < 0.5
    # The crop starts at a whole pixel: a border may be off by one pixel of fourteen; a shifted patch would differ by 1.
    np.testing.assert_allclose(share.reshape(patches, patches), seen, atol=0.1)


@given(
    npst.arrays(np.float64, st.tuples(st.integers(1, 6), st.integers(1, 6)), elements=st.floats(0, 9)),
    st.integers(1, 40),
    st.integers(1, 40),
)
def test_every_pixel_has_the_value_of_the_patch_around_its_centre(grid: np.ndarray, height: int, width: int) -> None:
    large = enlarge(grid, height, width)
    assert large.shape == (height, width)
    for row in {0, height // 2, height - 1}:
        for column in {0, width // 3, width - 1}:
            r = int((2 * row + 1) * grid.shape[0] // (2 * height))
            c = int((2 * column + 1) * grid.shape[1] // (2 * width))
            assert large[row, column] == grid[r, c]
    smooth = enlarge(grid, height, width, smooth=True)
    assert smooth.min() >= grid.min() - 1e-9
    assert smooth.max() <= grid.max() + 1e-9


def test_smooth_enlargement_is_linear_between_centres_and_true_at_them() -> None:
    grid = np.array([[0.0, 6.0], [3.0, 9.0]])
    large = enlarge(grid, 6, 6, smooth=True)
    np.testing.assert_allclose(large[1, [1, 4]], [0.0, 6.0])
    np.testing.assert_allclose(large[1, 1:5], [0.0, 2.0, 4.0, 6.0])
    np.testing.assert_allclose(large[[0, 5], 0], [0.0, 3.0])
