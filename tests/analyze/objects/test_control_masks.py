"""The control for attention that is fixed to a place: null stores and followers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl
import pytest
import zarr

from tests.kit.bowl_scene import CAMERAS, bowl_coverage, bowl_tokens, write_bowl_store
from tests.kit.questions import question_about
from vla_attention.analyze.objects.control_masks import (
    mean_overlap,
)
from vla_attention.analyze.objects.object_attention import object_tables
from vla_attention.analyze.objects.object_settings import ObjectSettings
from vla_attention.analyze.objects.object_study import objects_summary
from vla_attention.analyze.statistics.episode_intervals import Sampling
from vla_attention.schemas.groupings.vocabulary import EpisodeTokens
from vla_attention.testing.stores import every_key_seen

SIZE, BOWL = 16, 0
ROW, COLUMN = np.divmod(np.arange(SIZE**2), SIZE)


def square(top: float, left: float) -> np.ndarray:
    """Covered areas (patch,) of a square of 2 x 2 patches whose corner lies anywhere, patches covered by parts."""
    sides = [np.clip(np.minimum(place + 1, low + 2) - np.maximum(place, low), 0, 1)
             for place, low in ((ROW, top), (COLUMN, left))]  # fmt: skip
    return sides[0] * sides[1]


def with_bowl_at(places: np.ndarray) -> dict[str, np.ndarray]:
    """The bowl scene's coverage with the bowl at one place (row, column) per replan."""
    coverage = bowl_coverage(len(places), SIZE)
    for areas in coverage.values():
        areas[..., BOWL] = [square(*place) for place in places]
        areas[..., 1:4] *= 1.0 - areas[..., [BOWL]]
        areas[..., 4] = 1.0 - areas[..., :4].sum(axis=-1)
    return coverage


def near_the_middle(task: int, episode: int, tokens: EpisodeTokens) -> dict[str, np.ndarray]:
    """Every episode has its own place near the middle, and the bowl moves a little from there."""
    generator = np.random.default_rng([task, episode])
    start = 7.0 + generator.normal(0, 1.5, 2)
    return with_bowl_at(start + np.linspace(0, 1, tokens.num_replans)[:, None] * generator.normal(0, 0.7, 2))


def look_at_the_middle(task: int, episode: int, tokens: EpisodeTokens, rows: np.ndarray) -> np.ndarray:
    """Rows with noise of their own, on every camera a blob in the middle; the same wherever the bowl is."""
    planted = np.exp(np.random.default_rng([7, task, episode]).normal(0, 0.3, rows.shape))
    blob = 0.2 + np.exp(-((ROW - 7.5) ** 2 + (COLUMN - 7.5) ** 2) / 18)
    for camera in CAMERAS:
        span = tokens.layout.camera_span(camera)
        planted[..., span.start : span.stop] *= blob
    return planted / planted.sum(axis=-1, keepdims=True)


def look_at_the_bowl(task: int, episode: int, tokens: EpisodeTokens, rows: np.ndarray) -> np.ndarray:
    planted = look_at_the_middle(task, episode, tokens, rows)
    for camera in CAMERAS:
        span = tokens.layout.camera_span(camera)
        planted[..., span.start : span.stop] *= 1 + 3 * tokens.coverage[camera][:, None, None, None, None, :, BOWL]
    return planted / planted.sum(axis=-1, keepdims=True)


def stored(path: Path, **changes) -> Path:
    spec = {"tokens": bowl_tokens(replans=6), "tasks": (0,), "episodes": 8, "layers": (0,), "denoise_steps": (0,)}
    spec |= {"plant_coverage": near_the_middle, "plant_uniform": every_key_seen}
    return write_bowl_store(path, **{**spec, **changes})


def bowl_of(path: Path) -> dict:
    tables = object_tables(question_about(path), ObjectSettings(spatial=False))
    of_bowl = (pl.col("camera") == "all") & (pl.col("item") == "akita_black_bowl_1")
    return objects_summary(tables.objects, Sampling()).filter(of_bowl).row(0, named=True)


def test_attention_to_the_middle_has_enrichment_but_none_over_the_control(tmp_path):
    found = bowl_of(stored(tmp_path / "middle.zarr", plant_rows=look_at_the_middle))
    assert found["enrichment_low"] > 1.5
    assert found["enrichment_over_control"] == pytest.approx(1.0, abs=0.05)
    assert found["enrichment_over_control_low"] < 1 < found["enrichment_over_control_high"]


def test_attention_that_follows_the_object_exceeds_the_control(tmp_path):
    found = bowl_of(stored(tmp_path / "follows.zarr", plant_rows=look_at_the_bowl))
    assert found["enrichment_over_control_low"] > 1.5
    assert found["enrichment_over_control"] == pytest.approx(found["enrichment"] / found["control_enrichment"])


def raw(path: Path, task: int, episode: int, camera: str) -> tuple[np.ndarray, np.ndarray]:
    """Maps (replan, layer, head, patch) and areas (replan, patch, object) of one camera."""
    root = zarr.open_group(path, mode="r")
    group = root[f"episodes/task{task:03d}_episode{episode:03d}"]
    span = next(span for span in root.attrs["sites"][0]["spans"] if span["camera"] == camera)
    rows = group["joint/rows"][:].astype(np.float64).mean(axis=(2, 5 - 1))  # denoise steps, queries
    return rows[..., span["start"] : span["stop"]], group[f"objects/{camera}"][:].astype(np.float64)


def test_overlap_is_that_of_sets_where_patches_are_covered_whole():
    generator = np.random.default_rng(1)
    first, second = (generator.random((n, 30, 2)) < 0.4 for n in (3, 4))
    found = mean_overlap(first.astype(np.float32), second.astype(np.float32))
    for item in range(2):
        pairs = [(set(np.flatnonzero(a)), set(np.flatnonzero(b))) for a in first[..., item] for b in second[..., item]]
        assert found[item] == pytest.approx(np.mean([len(a & b) / len(a | b) for a, b in pairs]))
