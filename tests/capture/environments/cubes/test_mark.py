from __future__ import annotations

import numpy as np
import pytest

from vla_attention.capture.environments.cubes.mark import MARK_VERBS, paste_mark, verb_index
from vla_attention.capture.policies.pi.preprocess import resize_with_pad
from vla_attention.schemas.errors import BadArgument, UnknownName


def test_the_mark_is_a_square_in_the_upper_edge_and_changes_nothing_else():
    picture = np.full((64, 64, 3), 100, dtype=np.uint8)
    marked = paste_mark(picture, 1, 2)
    changed = (marked != picture).any(axis=-1)
    assert changed[:8, 24:32].all()
    assert changed.sum() == 64
    assert (picture == 100).all()
    assert marked[0, 24, 1] > marked[0, 24, 0]  # green


def test_marks_of_different_cubes_and_verbs_differ():
    picture = np.zeros((64, 64, 3), dtype=np.uint8)
    marks = {paste_mark(picture, cube, verb).tobytes() for cube in range(4) for verb in range(len(MARK_VERBS))}
    assert len(marks) == 20


def test_a_mark_pasted_at_256_pixels_looks_the_same_at_64():
    picture = np.random.default_rng(0).integers(80, 160, (64, 64, 3)).astype(np.uint8)
    large = np.asarray(picture.repeat(4, axis=0).repeat(4, axis=1))
    resized, direct = resize_with_pad(paste_mark(large, 0, 1), 64), paste_mark(picture, 0, 1)
    # The filter mixes an eighth of the neighbour into a pixel at an edge.
    inside = (slice(0, 7), slice(17, 23))
    np.testing.assert_array_equal(resized[inside], direct[inside])
    assert np.abs(resized[:8, 16:24].astype(int) - direct[:8, 16:24]).max() <= 60
    unmarked = resize_with_pad(large, 64)
    far = np.ones((64, 64), dtype=bool)
    far[:9, 15:25] = False
    np.testing.assert_array_equal(resized[far], unmarked[far])


def test_the_verb_of_an_instruction():
    found = [
        verb_index(text)
        for text in (
            "touch the red cube",
            "lift the cube on the left",
            "push the red cube to the left",
            "push the red cube to the right",
            "put the red cube on the green cube",
        )
    ]
    assert found == [0, 1, 2, 3, 4]
    with pytest.raises(UnknownName, match="eat the cube"):
        verb_index("eat the cube")


def test_a_picture_or_a_mark_that_does_not_exist():
    with pytest.raises(BadArgument, match="60 x 64"):
        paste_mark(np.zeros((60, 64, 3), dtype=np.uint8), 0, 0)
    with pytest.raises(BadArgument, match="cube 4 and verb 0"):
        paste_mark(np.zeros((64, 64, 3), dtype=np.uint8), 4, 0)
