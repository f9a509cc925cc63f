"""Overlays: a bright patch lies on its object however the camera's picture was turned; values and scales by hand."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vla_attention.analyze.overlay.colours import (
    COLOR_KEPT,
    OPACITY,
    Scale,
    overlay_image,
    patch_values,
    scale_for,
)
from vla_attention.analyze.show.patch_pictures import NO_PICTURE, upright
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.stores.store_format import PolicyCameraView

ROWS, COLUMNS, SIDE = 8, 4, 5  # patches of 5 x 5 pixels
OBJECT = (230, 20, 10)
SCALE = Scale(10.0, "lift")


def scene(row: int, column: int) -> np.ndarray:
    """A picture as a person sees the scene: grey, with one patch-sized object."""
    picture = np.full((ROWS * SIDE, COLUMNS * SIDE, 3), 90, dtype=np.uint8)
    picture[row * SIDE : (row + 1) * SIDE, column * SIDE : (column + 1) * SIDE] = OBJECT
    return picture


def as_stored(picture: np.ndarray, view: PolicyCameraView) -> np.ndarray:
    """From what a person sees to the stored frame, as capture does it: the simulator delivers the bottom row first."""
    raw = np.flipud(picture)
    stored = np.flipud(raw) if view.upright else raw
    return np.fliplr(stored) if view.mirrored else stored


@pytest.mark.parametrize("upright_frame", [True, False])
@pytest.mark.parametrize("mirrored", [True, False])
@pytest.mark.parametrize(("row", "column"), [(0, 0), (1, 3), (6, 0), (7, 2)])
def test_a_bright_patch_lies_on_the_object_that_the_person_sees(
    upright_frame: bool, mirrored: bool, row: int, column: int
) -> None:
    view = PolicyCameraView("cam", "agentview", upright_frame, mirrored)
    frame = as_stored(scene(row, column), view)
    # All attention is on the patch of the stored frame that shows the object.
    red = (frame == OBJECT).all(axis=-1).reshape(ROWS, SIDE, COLUMNS, SIDE).all(axis=(1, 3))
    assert red.sum() == 1
    attention = np.where(red, SCALE.high, 0.0)
    shown = upright(overlay_image(frame, attention, SCALE), view)
    np.testing.assert_array_equal(upright(frame, view), scene(row, column))
    plain = overlay_image(scene(row, column), np.zeros((ROWS, COLUMNS)), SCALE)
    changed = (shown != plain).any(axis=-1)
    expected = (scene(row, column) == OBJECT).all(axis=-1)
    np.testing.assert_array_equal(changed, expected)


def test_values_are_shares_of_image_attention_and_lifts_over_uniform_attention() -> None:
    mass = np.array([[[0.1, 0.3]], [[0.2, 0.0]]])
    image, uniform = np.array([0.5, 0.0]), np.array([[[0.05, 0.1]], [[0.1, 0.0]]])
    np.testing.assert_allclose(patch_values(mass, image, uniform, "lift"), [[[2, 3]], [[2, np.nan]]])
    share = patch_values(mass, image, uniform, "share")
    np.testing.assert_allclose(share[0], [[20, 60]])
    assert np.isinf(share[1, 0, 0])
    assert np.isnan(share[1, 0, 1])


@given(st.lists(st.floats(0, 500), min_size=1, max_size=60))
def test_a_scale_ends_at_a_high_quantile_and_never_makes_uniform_attention_look_like_more(values: list[float]) -> None:
    array = np.array(values)
    for measure, uniform in (("lift", 1.0), ("share", 100.0 / 512)):
        scale = scale_for(array, measure, 512)
        assert scale.high >= 4 * uniform * (1 - 1e-12)
        assert scale.high >= np.quantile(array, 0.995) * (1 - 1e-9)
        assert scale.high <= 1.11 * max(np.quantile(array, 0.995), 4 * uniform)
        assert scale.colors(np.array(uniform))[3] <= OPACITY / 4 + 1e-9


def test_undefined_and_missing_values() -> None:
    frame = np.full((4, 4, 3), (200, 100, 0), dtype=np.uint8)
    untouched = overlay_image(frame, np.full((2, 2), np.nan), SCALE)
    grey = 0.299 * 200 + 0.587 * 100
    expected = np.round(COLOR_KEPT * np.array([200, 100, 0]) + (1 - COLOR_KEPT) * grey)
    np.testing.assert_array_equal(untouched, np.broadcast_to(expected.astype(np.uint8), frame.shape))
    alone = overlay_image(None, np.zeros((2, 2)), SCALE, size=(6, 8))
    assert alone.shape == (6, 8, 3)
    assert (alone == NO_PICTURE).all()
    with pytest.raises(BadArgument, match="size"):
        overlay_image(None, np.zeros((2, 2)), SCALE)
    with pytest.raises(BadArgument, match="two axes"):
        overlay_image(frame, np.zeros((2, 2, 2)), SCALE)
