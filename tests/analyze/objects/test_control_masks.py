"""The control for attention that is fixed to a place: loops over raw arrays, null stores, followers, still objects."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl
import pytest
import zarr

from tests.kit.bowl_scene import CAMERAS, bowl_coverage, bowl_tokens, write_bowl_store
from tests.kit.questions import question_about
from vla_attention.analyze.__main__ import main
from vla_attention.analyze.objects.control_masks import (
    MOST_MASKS,
    STILL_OVERLAP,
    control_source,
    controls,
    half_an_episode_away,
    mean_overlap,
    offsets,
    replans_of_masks,
)
from vla_attention.analyze.objects.object_attention import object_tables
from vla_attention.analyze.objects.object_settings import ObjectSettings
from vla_attention.analyze.objects.object_study import followed_objects, objects_summary
from vla_attention.analyze.statistics.episode_intervals import Sampling
from vla_attention.analyze.statistics.intervals import (
    POSITIVE,
    Interval,
    estimates,
    mean_over_episodes,
    ratio_of_means_over_episodes,
)
from vla_attention.analyze.statistics.units import Units
from vla_attention.schemas.groupings.vocabulary import EpisodeTokens
from vla_attention.testing.stores import every_key_seen
from vla_attention.testing.tokens import OBJECTS

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


def always_there(task: int, episode: int, tokens: EpisodeTokens) -> dict[str, np.ndarray]:
    return with_bowl_at(np.full((tokens.num_replans, 2), 7.0))


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


def test_of_an_object_that_does_not_move_the_control_cannot_tell(tmp_path, capsys):
    path = stored(tmp_path / "still.zarr", plant_rows=look_at_the_bowl, plant_coverage=always_there)
    found = bowl_of(path)
    assert found["control_overlap"] == pytest.approx(1.0)
    assert found["enrichment_over_control"] is None
    assert found["enrichment_over_control_high"] is None
    assert main(["objects", str(path), "--no-iou", "--no-plots", "--output", str(tmp_path / "out")]) == 0
    printed = capsys.readouterr().out
    (line, *_) = [line for line in printed.splitlines() if line.lstrip().startswith("[of interest]")]
    assert "cannot tell" in line
    tables = object_tables(question_about(path), ObjectSettings(spatial=False))
    assert followed_objects(tables.objects, Sampling()) == []


def raw(path: Path, task: int, episode: int, camera: str) -> tuple[np.ndarray, np.ndarray]:
    """Maps (replan, layer, head, patch) and areas (replan, patch, object) of one camera."""
    root = zarr.open_group(path, mode="r")
    group = root[f"episodes/task{task:03d}_episode{episode:03d}"]
    span = next(span for span in root.attrs["sites"][0]["spans"] if span["camera"] == camera)
    rows = group["joint/rows"][:].astype(np.float64).mean(axis=(2, 5 - 1))  # denoise steps, queries
    return rows[..., span["start"] : span["stop"]], group[f"objects/{camera}"][:].astype(np.float64)


@pytest.mark.parametrize("episodes", [1, 2, 3])
def test_the_control_is_that_of_loops_over_raw_arrays(tmp_path, episodes):
    path = stored(tmp_path / "a.zarr", episodes=episodes, tasks=(0, 1), layers=(0, 2), denoise_steps=(0, 9))
    table = object_tables(question_about(path, per_head=True), ObjectSettings(spatial=False)).objects.whole
    number = [thing.name for thing in OBJECTS].index("akita_black_bowl_1")
    for camera in CAMERAS:
        read = {e: raw(path, 1, e, camera) for e in range(episodes)}
        for row in table.filter(task_id=1, camera=camera, item="akita_black_bowl_1").iter_rows(named=True):
            own = row["episode_index"]
            maps = read[own][0]
            maps = maps.mean(axis=1) if row["layer"] == "layers_avg" else maps[:, {0: 0, 2: 1}[int(row["layer"])]]
            maps = maps[:, row["head"]]
            shares, areas, overlaps = [], [], []
            of_other = []
            for other in [e for e in range(episodes) if e != own]:
                shares, areas = [], []
                for mask in read[other][1][:, :, number]:
                    areas.append(mask.mean())
                    for one in maps:
                        shares.append((one * mask).sum() / one.sum())
                    compared = read[own][1][:, :, number]
                    overlaps += [np.minimum(mine, mask).sum() / np.maximum(mine, mask).sum() for mine in compared]
                of_other.append(np.mean(shares) / np.mean(areas))
            if episodes == 1:
                masks = read[own][1][:, :, number]
                for replan, one in enumerate(maps):
                    mask = masks[(replan + 3) % 6]
                    shares.append((one * mask).sum() / one.sum())
                    areas.append(mask.mean())
                    overlaps.append(np.minimum(masks[replan], mask).sum() / np.maximum(masks[replan], mask).sum())
                of_other = [np.mean(shares) / np.mean(areas)]
            assert row["control_enrichment"] == pytest.approx(np.mean(of_other), rel=1e-4)
            assert row["control_overlap"] == pytest.approx(np.mean(overlaps), rel=1e-4)
    by_layer = table.group_by("task_id", "layer", "head", "camera", "kind", "item").agg(
        pl.col("control_enrichment").mean(), pl.col("control_balanced").mean()
    )
    known = by_layer.drop_nulls()
    assert known.height > 0
    np.testing.assert_allclose(known["control_balanced"], known["control_enrichment"], rtol=1e-5)


def test_no_episode_has_more_than_fifty_control_masks_and_all_lend_alike():
    for others in (1, 2, 7, 49, 50, 51, 200):
        lenders = offsets(others + 1)
        assert len(set(lenders.tolist())) == min(others, MOST_MASKS)
        assert lenders.min() >= 1
        assert lenders.max() <= others
        for replans in (1, 5, 52, 300):
            lent = replans_of_masks(replans, others)
            assert 1 <= len(set(lent.tolist())) == len(lent)
            assert len(lent) * len(lenders) <= MOST_MASKS
    assert half_an_episode_away(5).tolist() == [2, 3, 4, 0, 1]


def test_an_object_that_one_episode_alone_shows_has_no_control(tmp_path):
    def hidden(task, episode, tokens):
        coverage = near_the_middle(task, episode, tokens)
        if episode:
            for areas in coverage.values():
                areas[..., 4] += areas[..., BOWL]
                areas[..., BOWL] = 0.0
        return coverage

    found = bowl_of(stored(tmp_path / "a.zarr", episodes=3, plant_coverage=hidden))
    assert found["enrichment"] is not None
    assert found["control_enrichment"] is None
    assert found["enrichment_over_control"] is None


def made_up_store(generator: np.random.Generator, episodes: int, follow: float) -> tuple[float, Interval, Interval]:
    """Overlap, interval of the enrichment and of the enrichment over the control, of one made-up task."""
    replans, sources, enrichment = 8, [], []
    for _ in range(episodes):
        area = square(*(7.0 + np.clip(generator.normal(0, 1.8, 2), -6, 6)))[None, :, None].repeat(replans, axis=0)
        middle = 7.5 + generator.normal(0, 0.7, 2)
        blob = 0.2 + np.exp(-((ROW - middle[0]) ** 2 + (COLUMN - middle[1]) ** 2) / 18)
        maps = blob * np.exp(generator.normal(0, 0.3, (replans, SIZE**2))) * (1 + follow * area[..., 0])
        maps /= maps.sum(axis=-1, keepdims=True)
        enrichment.append((maps * area[..., 0]).sum(axis=-1).mean() / area.mean())
        sources.append(control_source([(maps[:, None, None], area.astype(np.float32))], episodes - 1))
    found = controls(sources)
    balanced, tasks = [control.balanced[0, 0, 0] for control in found], np.zeros(episodes)
    statistics = [mean_over_episodes(enrichment, POSITIVE), ratio_of_means_over_episodes(enrichment, balanced)]
    plain, over = (one.interval() for one in estimates(statistics, Units.of(tasks)))
    assert plain is not None
    assert over is not None
    return float(np.mean([control.overlap[0] for control in found])), plain, over


def test_intervals_hold_one_for_attention_to_the_middle_and_exclude_it_for_followers():
    generator = np.random.default_rng(0)
    null, following = ([made_up_store(generator, 10, follow) for _ in range(80)] for follow in (0.0, 2.0))
    assert np.mean([plain.low > 1 for _, plain, _ in null]) > 0.85
    assert np.mean([over.low <= 1 <= over.high for _, _, over in null]) > 0.9
    assert np.mean([over.low > 1 for _, _, over in following]) > 0.95
    assert all(overlap < STILL_OVERLAP for overlap, _, _ in null)


def test_overlap_is_that_of_sets_where_patches_are_covered_whole():
    generator = np.random.default_rng(1)
    first, second = (generator.random((n, 30, 2)) < 0.4 for n in (3, 4))
    found = mean_overlap(first.astype(np.float32), second.astype(np.float32))
    for item in range(2):
        pairs = [(set(np.flatnonzero(a)), set(np.flatnonzero(b))) for a in first[..., item] for b in second[..., item]]
        assert found[item] == pytest.approx(np.mean([len(a & b) / len(a | b) for a, b in pairs]))
