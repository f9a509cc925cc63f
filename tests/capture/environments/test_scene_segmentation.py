"""The parts of the segmentation that need no simulator: owners of bodies, and identity colours."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("mujoco")

from vla_attention.capture.environments.segmentation import decode_identities, owners_of_bodies

BACKGROUND = 9


def test_bodies_belong_to_the_nearest_named_ancestor() -> None:
    #        world table  arm  hand  bowl  handle
    parents = np.array([0, 0, 0, 2, 0, 4])
    owners = owners_of_bodies(parents, {2: 0, 4: 1}, BACKGROUND)
    assert owners.tolist() == [BACKGROUND, BACKGROUND, 0, 0, 1, 1]


def test_a_named_body_inside_another_object_keeps_its_own() -> None:
    owners = owners_of_bodies(np.array([0, 0, 1, 2]), {1: 0, 2: 5}, BACKGROUND)
    assert owners.tolist() == [BACKGROUND, 0, 5, 5]


def test_identity_colours_use_all_three_channels() -> None:
    table = np.zeros(70_000, dtype=np.int32)
    table[[1, 300, 66_000]] = [7, 8, 9]
    colours = np.array([[[0, 0, 0], [1, 0, 0], [300 % 256, 1, 0], [66_000 % 256, 66_000 // 256 % 256, 1]]], np.uint8)
    assert decode_identities(colours, table).tolist() == [[0, 7, 8, 9]]


def test_an_unknown_colour_is_an_error() -> None:
    with pytest.raises(RuntimeError, match=r"\b5; .* 2"):
        decode_identities(np.full((1, 1, 3), [5, 0, 0], dtype=np.uint8), np.zeros(3, dtype=np.int32))
