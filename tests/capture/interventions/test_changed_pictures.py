"""Other pictures: each against a plain computation, and what stays untouched."""

from __future__ import annotations

import numpy as np
import pytest

from vla_attention.capture.interventions import changed_inputs
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.layout import PatchGrid

GRID = PatchGrid(4, 4, 32, 32)


@pytest.fixture
def picture():
    return np.random.default_rng(0).integers(0, 256, (32, 32, 3), dtype=np.uint8)


@pytest.fixture
def mask():
    patches = np.zeros(16, dtype=bool)
    patches[[5, 6]] = True
    return changed_inputs.patch_pixels(patches, (GRID,), (32, 32, 3))


def test_blank_noise_and_turned(picture):
    assert (changed_inputs.blank(picture) == 128).all()
    first, second = (changed_inputs.noise(picture, np.random.default_rng(seed)) for seed in (1, 2))
    np.testing.assert_array_equal(first, changed_inputs.noise(picture, np.random.default_rng(1)))
    assert (first != second).mean() > 0.9
    assert abs(first.mean() - 127.5) < 5
    turned = changed_inputs.rotated(picture)
    assert (turned[0, 0] == picture[-1, -1]).all()
    np.testing.assert_array_equal(changed_inputs.rotated(turned), picture)


def test_shifts_are_whole_patches_and_repeat_the_edge(picture):
    moved = changed_inputs.shifted(picture, GRID, 1, -2)
    np.testing.assert_array_equal(moved[8:, :16], picture[:24, 16:])
    np.testing.assert_array_equal(moved[:8, :16], np.repeat(picture[:1, 16:], 8, axis=0))
    np.testing.assert_array_equal(moved[8:, 16:], np.repeat(picture[:24, -1:], 16, axis=1))
    np.testing.assert_array_equal(changed_inputs.shifted(picture, GRID, 0, 0), picture)
    for rows, columns in ((4, 0), (0, -4)):
        with pytest.raises(BadArgument, match="4 x 4"):
            changed_inputs.shifted(picture, GRID, rows, columns)


def test_patches_become_their_pixels(mask):
    expected = np.zeros((32, 32), dtype=bool)
    expected[8:16, 8:24] = True
    np.testing.assert_array_equal(mask, expected)
    odd = changed_inputs.patch_pixels(np.eye(3, dtype=bool).ravel(), (PatchGrid(3, 3, 10, 10),), (10, 10))
    assert odd.sum() == 4 * 4 + 3 * 3 + 3 * 3


def test_a_mask_has_the_mean_colour_of_the_rest(picture, mask):
    masked = changed_inputs.masked(picture, mask)
    np.testing.assert_array_equal(masked[~mask], picture[~mask])
    assert (masked[mask] == np.rint(picture[~mask].mean(axis=0))).all()
    np.testing.assert_array_equal(changed_inputs.masked(picture, ~mask & mask), picture)
    assert (changed_inputs.masked(picture, mask | ~mask) == 128).all()


def test_filling_leaves_the_rest_and_stays_between_its_colours(picture, mask):
    before = picture.copy()
    filled = changed_inputs.filled(picture, mask)
    np.testing.assert_array_equal(picture, before)
    np.testing.assert_array_equal(filled[~mask], picture[~mask])
    assert filled[mask].min() >= picture[~mask].min()
    assert filled[mask].max() <= picture[~mask].max()
    assert not (filled[mask] == picture[mask]).all()
    np.testing.assert_array_equal(changed_inputs.filled(picture, mask & ~mask), picture)
    assert (changed_inputs.filled(picture, mask | ~mask) == 128).all()
