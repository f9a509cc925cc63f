"""Attention on pictures: an object that gets it keeps its colour, whichever way the camera's picture was turned."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from vla_attention.analyze.core.camera_maps import upright
from vla_attention.analyze.core.result import Figure
from vla_attention.analyze.render.figures import draw
from vla_attention.analyze.render.pictures import lit, strength
from vla_attention.analyze.render.style import Style
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.stores.store_format import PolicyCameraView

ROWS, COLUMNS, SIDE = 8, 4, 5  # patches of 5 x 5 pixels
OBJECT = (230, 20, 10)


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
def test_the_object_that_gets_the_attention_keeps_its_colour(upright_frame, mirrored, row, column):
    view = PolicyCameraView("cam", "agentview", upright_frame, mirrored)
    frame = as_stored(scene(row, column), view)
    # All attention is on the patch of the stored frame that shows the object.
    red = (frame == OBJECT).all(axis=-1).reshape(ROWS, SIDE, COLUMNS, SIDE).all(axis=(1, 3))
    assert red.sum() == 1
    picture, values = upright(frame, view), upright(np.where(red, 10.0, 0.0), view)
    np.testing.assert_array_equal(picture, scene(row, column))
    shown = lit(picture, values, 10.0, smooth=False)
    there = (scene(row, column) == OBJECT).all(axis=-1)
    assert (shown[there] == OBJECT).all()
    assert (shown[~there] != 90).all()


def test_strength_grows_from_even_attention_to_the_end_of_the_scale():
    values = strength(np.array([np.nan, 0.0, 1.0, 2.0, 5.0, 10.0, 80.0]), 10.0)
    assert values[[0, 1, 2, 5, 6]].tolist() == [0.0, 0.0, 0.0, 1.0, 1.0]
    assert 0.2 < values[3] < values[4] < 0.8


def test_a_map_without_a_picture_and_one_of_a_wrong_shape():
    alone = lit(None, np.array([[0.0, 9.0]]), 4.0, smooth=False)
    assert (alone[:, :32] == alone[0, 0]).all()
    assert (alone[:, 32:] == alone[0, -1]).all()
    assert (alone[0, 0] != alone[0, -1]).any()
    with pytest.raises(BadArgument):
        lit(np.zeros((4, 4, 3), np.uint8), np.zeros((2, 2, 2)), 4.0, smooth=False)


@pytest.mark.parametrize("style", ["screen", "paper"])
def test_every_picture_of_a_frame_is_drawn_in_its_row_and_column(style):
    """Ten columns are two lines; pictures without attention need a place and a text only."""
    frame = pl.DataFrame(
        {"row": ["a"] * 10 + ["b"] * 10, "column": [*range(10)] * 2, "above": [str(i) for i in range(20)]}
    )

    def picture(row):
        return np.full((4, 6, 3), 10 * row["column"] + (row["row"] == "b"), np.uint8)

    canvas = draw(Figure("strip", "pictures", frame, "A strip", options={"picture": picture}), Style(style))
    (axes,) = canvas.axes
    assert {text.get_text() for text in axes.texts} >= set(frame["above"])
    drawn = axes.images
    assert [int(image.get_array()[0, 0, 0]) for image in drawn] == [10 * i + j for j in (0, 1) for i in range(10)]
    left, _, _, top = np.array([image.get_extent() for image in drawn]).T  # inches from the top left
    assert (np.diff(left[:8]) > 0).all()
    assert top[0] < top[10] < top[8] < top[18]  # a, b, and below them the second lines of both
