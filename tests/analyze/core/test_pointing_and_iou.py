"""Spatial metrics against independent code: sets, loops, scipy."""

from __future__ import annotations

import math

import numpy as np
import pytest
import scipy.ndimage
import scipy.stats
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.kit.examples import examples
from vla_attention.analyze.core.pointing_and_iou import (
    centre_of_mass,
    grown,
    intersection_over_union,
    near_patches,
    object_masks,
    patch_centres,
    pointing_hits,
    regions_of_percentiles,
    shifted_iou,
    shifted_masks,
)

SIZES = st.tuples(st.integers(1, 6), st.integers(1, 6))
QUICK = settings(max_examples=examples(30), deadline=None)


@st.composite
def maps_and_masks(draw: st.DrawFn) -> tuple[int, int, np.ndarray, np.ndarray]:
    """Maps (replan, head, patch) with ties and zeros, masks (replan, patch, item) that may be empty."""
    rows, columns = draw(SIZES)
    generator = np.random.default_rng(draw(st.integers(0, 2**16)))
    levels = draw(st.sampled_from([2, 5, 1000]))
    shape = (draw(st.integers(1, 3)), draw(st.integers(1, 2)), rows * columns)
    maps = (generator.integers(0, levels, shape) / levels).astype(np.float32)
    masks = generator.random((shape[0], rows * columns, 3)) < draw(st.sampled_from([0.0, 0.2, 0.7]))
    return rows, columns, maps, masks


@QUICK
@given(maps_and_masks())
def test_centre_of_mass_is_that_of_scipy_moved_to_the_middle_of_patches(case):
    rows, columns, maps, _ = case
    found = centre_of_mass(maps, patch_centres(rows, columns))
    for replan in range(maps.shape[0]):
        for head in range(maps.shape[1]):
            values = maps[replan, head].astype(float)
            if values.sum() == 0:
                assert np.isnan(found[replan, head]).all()
                continue
            wanted = np.array(scipy.ndimage.center_of_mass(values.reshape(rows, columns))) + 0.5
            np.testing.assert_allclose(found[replan, head], wanted, rtol=1e-9)


@QUICK
@given(maps_and_masks(), st.sampled_from([0.0, 1.0, 1.5, 2.0]))
def test_pointing_game_counts_highest_patches_near_the_mask(case, tolerance):
    rows, columns, maps, masks = case
    hits = pointing_hits(maps, grown(masks, near_patches(rows, columns, tolerance)))
    for replan in range(maps.shape[0]):
        for head in range(maps.shape[1]):
            values = maps[replan, head].reshape(rows, columns)
            highest = list(zip(*np.nonzero(values == values.max()), strict=True))
            for item in range(masks.shape[2]):
                members = list(zip(*np.nonzero(masks[replan, :, item].reshape(rows, columns)), strict=True))
                if not members:
                    assert np.isnan(hits[replan, head, item])
                    continue
                near = [any(math.dist(place, member) <= tolerance for member in members) for place in highest]
                assert hits[replan, head, item] == pytest.approx(sum(near) / len(near))


@QUICK
@given(maps_and_masks(), st.sampled_from([5.0, 50.0, 80.0, 95.0]))
def test_iou_is_that_of_python_sets(case, percentile):
    _, _, maps, masks = case
    regions = regions_of_percentiles(maps, [percentile])[0]
    found = intersection_over_union(regions, masks)
    for replan in range(maps.shape[0]):
        for head in range(maps.shape[1]):
            values = [float(value) for value in maps[replan, head]]
            limit = scipy.stats.scoreatpercentile(values, percentile)
            region = {i for i, value in enumerate(values) if value >= limit or math.isclose(value, limit, rel_tol=1e-6)}
            assert set(np.flatnonzero(regions[replan, head])) <= region
            region = set(np.flatnonzero(regions[replan, head]).tolist())
            for item in range(masks.shape[2]):
                mask = set(np.flatnonzero(masks[replan, :, item]).tolist())
                if mask:
                    assert found[replan, head, item] == pytest.approx(len(region & mask) / len(region | mask))
                else:
                    assert np.isnan(found[replan, head, item])


@QUICK
@given(maps_and_masks(), st.sampled_from([50.0, 80.0]))
def test_chance_iou_is_the_mean_over_all_shifts_of_the_map(case, percentile):
    """On pictures of up to 4 x 4 patches; larger ones take all shifts over several replans."""
    rows, columns, maps, masks = case
    if rows > 4 or columns > 4:
        return
    found = shifted_iou(regions_of_percentiles(maps, [percentile])[0], shifted_masks(masks, rows, columns))
    for replan, head, item in np.ndindex(*maps.shape[:2], masks.shape[2]):
        mask = masks[replan, :, item]
        picture = maps[replan, head].reshape(rows, columns)
        moved = [np.roll(picture, by, (0, 1)).ravel() for by in np.ndindex(rows, columns)]
        regions = [regions_of_percentiles(one, [percentile])[0] for one in moved]
        wanted = [(region & mask).sum() / (region | mask).sum() for region in regions] if mask.any() else [np.nan]
        assert found[replan, head, item] == pytest.approx(np.mean(wanted), nan_ok=True)


@pytest.mark.parametrize(("rows", "columns", "replans"), [(8, 8, 4), (16, 16, 16), (8, 4, 2), (12, 8, 6)])
def test_replans_take_all_shifts_of_a_large_picture_alike(rows, columns, replans):
    generator = np.random.default_rng(rows + columns)
    region = np.broadcast_to(generator.random(rows * columns) < 0.2, (replans, rows * columns))
    mask = np.broadcast_to(generator.random((rows * columns, 1)) < 0.1, (replans, rows * columns, 1))
    found = shifted_iou(region, shifted_masks(mask, rows, columns)).mean()
    picture = region[0].reshape(rows, columns)
    moved = [np.roll(picture, by, (0, 1)).ravel() for by in np.ndindex(rows, columns)]
    assert found == pytest.approx(np.mean([(one & mask[0, :, 0]).sum() / (one | mask[0, :, 0]).sum() for one in moved]))


def test_masks_take_patches_from_the_stated_coverage_on():
    assert object_masks(np.array([0.49, 0.5, 1.0]), 0.5).tolist() == [False, True, True]
