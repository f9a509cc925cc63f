"""Objects against loops over raw Zarr arrays, a planted follower, chance levels, and the command."""

from __future__ import annotations

import json
import math
import re
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest
import scipy.stats
import zarr
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from polars.testing import assert_frame_equal

import vla_attention as va
from tests.kit.bowl_scene import CAMERAS, bowl_coverage, bowl_tokens, write_bowl_store
from tests.kit.examples import examples
from tests.kit.questions import question_about
from tests.kit.raw_rows import probabilities
from tests.kit.stores import StoreSpec, write_store
from tests.kit.tokens import OBJECTS, random_rows
from vla_attention.analyze.__main__ import main
from vla_attention.analyze.commands.objects import objects
from vla_attention.analyze.commands.words import words
from vla_attention.analyze.core.object_maps import enrichment_on
from vla_attention.analyze.core.result import Result
from vla_attention.schemas.groupings.vocabulary import EpisodeTokens

QUICK = settings(
    max_examples=examples(2), phases=[Phase.explicit, Phase.generate], deadline=None,
    suppress_health_check=[HealthCheck.too_slow],
)  # fmt: skip
CLASS_OF = {"akita_black_bowl_1": "of interest", "plate_1": "of interest", "wooden_cabinet_1": "other objects"}
BOWL = pl.col("item") == "akita_black_bowl_1"


def measured(path: Path, by: tuple[str, ...] = (), iou: bool = True, **selected) -> Result:
    return objects(question_about(path, **selected), by, iou)


def follow_bowl(task: int, episode: int, tokens: EpisodeTokens, rows: np.ndarray) -> np.ndarray:
    """Head 1 of the middle layer gives the bowl's patches thirty times their weight, wherever the bowl is."""
    rows = random_rows(tokens, rows.shape[1:-1], seed=10 * task + episode, spread=0.5)
    assert tokens.coverage is not None
    for camera in CAMERAS:
        (span,) = tokens.layout.camera_spans(camera)
        rows[:, 1, :, 1][..., span.start : span.stop] *= 1 + 29 * tokens.coverage[camera][:, None, None, :, 0]
    return rows / rows.sum(axis=-1, keepdims=True)


def attend_uniformly(task: int, episode: int, tokens: EpisodeTokens, rows: np.ndarray) -> np.ndarray:
    rows = random_rows(tokens, rows.shape[1:-1], seed=0, spread=0.0)
    return rows / rows.sum(axis=-1, keepdims=True)


@pytest.fixture(scope="module")
def follower_store(tmp_path_factory) -> Path:
    return write_bowl_store(tmp_path_factory.mktemp("objects") / "follower.zarr", plant_rows=follow_bowl)


def members_of(kind: str, name: str) -> list[int]:
    names = [thing.name for thing in OBJECTS]
    if kind == "object":
        return [names.index(name)]
    return [i for i, thing in enumerate(names) if CLASS_OF.get(thing, thing) == name]


def raw_episode(path: Path, name: str) -> tuple[np.ndarray, dict[str, np.ndarray], dict[str, slice]]:
    """Rows (replan, layer, denoise, head, key), coverage by camera, and where each camera's keys are."""
    root = zarr.open_group(path, mode="r")
    episode = root[f"episodes/{name}"]
    spans = {
        span["camera"]: slice(span["start"], span["stop"]) for span in root.attrs["sites"][0]["spans"] if span["camera"]
    }
    coverage = {
        camera: episode[f"objects/{camera}"][:].astype(float) for camera in spans if f"objects/{camera}" in episode
    }
    return probabilities(episode["joint/rows"]).astype(np.float64).mean(axis=4), coverage, spans


def test_shares_and_enrichment_equal_sums_over_raw_rows(follower_store):
    table = measured(follower_store, iou=False)["objects_episodes"]
    rows, coverage, spans = raw_episode(follower_store, "task001_episode000")
    own = table.filter((pl.col("task_id") == 1) & (pl.col("episode_index") == 0) & (pl.col("layer") == "2"))
    assert own.height == 3 * (4 + 5)
    mean = rows[:, 1].mean(axis=(1, 2))  # (replan, key)
    for row in own.iter_rows(named=True):
        cameras = CAMERAS if row["camera"] == "all" else (row["camera"],)
        masses, areas, seen, images = [], [], [], []
        attended, even = 0.0, 0.0
        for camera in cameras:
            there = mean[:, spans[camera]]
            covered = coverage[camera][:, :, members_of(row["kind"], row["item"])].sum(axis=2)
            of_all = np.mean([there[i].sum() / sum(mean[i, spans[c]].sum() for c in CAMERAS) for i in range(len(mean))])
            attended += of_all * ((there * covered).sum(axis=1) / there.sum(axis=1)).mean()
            even += of_all * covered.mean()
        for replan in range(len(mean)):
            area = {c: coverage[c][replan][:, members_of(row["kind"], row["item"])].sum(axis=1) for c in cameras}
            masses.append(sum(float((mean[replan, spans[c]] * area[c]).sum()) for c in cameras))
            areas.append(sum(area[c].sum() for c in cameras) / sum(len(area[c]) for c in cameras))
            seen.append(sum(mean[replan, spans[c]].sum() for c in cameras))
            images.append(sum(mean[replan, spans[c]].sum() for c in CAMERAS))
        masses, seen = np.array(masses), np.array(seen)
        assert row["enrichment"] == pytest.approx(attended / even, rel=1e-5)
        assert row["mass"] == pytest.approx(masses.mean(), rel=1e-5)
        assert row["share"] == pytest.approx((masses / np.array(images)).mean(), rel=1e-5)
        assert row["area_share"] == pytest.approx(np.mean(areas), rel=1e-5)
        if len(cameras) == 1:
            assert row["enrichment"] == pytest.approx((masses / seen).mean() / np.mean(areas), rel=1e-5)


def test_enrichment_of_all_cameras_is_a_mean_of_the_cameras(follower_store):
    table = measured(follower_store, iou=False)["objects_episodes"]
    keys = ["task_id", "episode_index", "layer", "kind", "item"]
    of_camera = table.filter(pl.col("camera") != "all").group_by(keys)
    for name in ("enrichment", "at_place", "elsewhere"):
        bounds = of_camera.agg(pl.col(name).min().alias("low"), pl.col(name).max().alias("high"))
        both = table.filter(pl.col("camera") == "all").join(bounds, on=keys).drop_nulls([name, "low"])
        assert both.height > 0
        assert (both[name] >= both["low"] - 1e-6).all()
        assert (both[name] <= both["high"] + 1e-6).all()


def moved_ious(values: np.ndarray, mask: set[int], percentile: float, replan: int, size: int) -> list[float]:
    """IoU of a mask with the attended region of the map at the 16 places that this replan has, thresholded again."""
    stride = math.ceil(size / 4)
    first = (replan % stride, replan // stride % stride)
    found = []
    for i in range(4):
        for j in range(4):
            by = (-(first[0] + i * size // 4), -(first[1] + j * size // 4))
            moved = np.roll(values.reshape(size, size), by, axis=(0, 1)).ravel()
            region = set(np.flatnonzero(moved >= scipy.stats.scoreatpercentile(values, percentile)).tolist())
            found.append(len(region & mask) / len(region | mask))
    return found


@QUICK
@given(data=st.data())
def test_pointing_and_iou_equal_loops_over_raw_maps(data):
    """On random rows, per layer and head: means over replans with a mask and denoise steps."""
    size, seed = data.draw(st.integers(7, 9)), data.draw(st.integers(0, 2**16))

    def plant(task, episode, tokens, rows):
        rows = random_rows(tokens, rows.shape[1:-1], seed, spread=1.0)
        return rows / rows.sum(axis=-1, keepdims=True)

    with tempfile.TemporaryDirectory() as folder:
        path = write_bowl_store(
            Path(folder) / "a.zarr", tokens=bowl_tokens(replans=2, size=size), tasks=(0,), episodes=1, layers=(0, 1),
            plant_rows=plant,
        )  # fmt: skip
        tables = measured(path, ("head",))
        pointing, overlaps = tables["pointing_episodes"], tables["iou_episodes"]
        rows, coverage, spans = raw_episode(path, "task000_episode000")
    centres = np.array([(r + 0.5, c + 0.5) for r in range(size) for c in range(size)])
    by_map = overlaps.rows_by_key(["layer", "head", "camera", "kind", "item", "threshold"], named=True)
    for row in pointing.filter(pl.col("layer") != "layers_avg").sample(20, seed=seed).iter_rows(named=True):
        of_map = [row[name] for name in ("layer", "head", "camera", "kind", "item")]
        found: dict[str, list[float]] = {}
        for replan, denoise in np.ndindex(rows.shape[0], rows.shape[2]):
            values = rows[replan, int(row["layer"]), denoise, row["head"], spans[row["camera"]]]
            area = coverage[row["camera"]][replan][:, members_of(row["kind"], row["item"])].sum(axis=1)
            mask = set(np.flatnonzero(area >= 0.5).tolist())
            if not mask:
                continue
            centre = np.average(centres, axis=0, weights=values)
            # Stored rows are rounded, so two patches can be equally high.
            highest = centres[values == values.max()]
            near = [any(math.dist(place, centres[patch]) <= 1 for patch in mask) for place in highest]
            of_object = np.average(centres, axis=0, weights=area)
            found.setdefault("pointing", []).append(np.mean(near))
            found.setdefault("distance", []).append(np.hypot(*(centre - of_object)) / size)
            for percentile in (80.0, 95.0):
                region = set(np.flatnonzero(values >= scipy.stats.scoreatpercentile(values, percentile)).tolist())
                iou, moved = len(region & mask) / len(region | mask), moved_ious(values, mask, percentile, replan, size)
                found.setdefault(f"p{percentile:g}", []).append(iou)
                found.setdefault(f"p{percentile:g} by chance", []).append(np.mean(moved))
        for name in ("pointing", "distance"):
            assert row[name] == (pytest.approx(np.mean(found[name]), rel=1e-5) if found else None)
        for threshold in ("p80", "p95"):
            overlap = by_map[*of_map, threshold][0]
            for name, where in (("iou", threshold), ("iou_chance", f"{threshold} by chance")):
                assert overlap[name] == (pytest.approx(np.mean(found[where])) if found else None)


def test_uniform_attention_scores_exactly_what_chance_does(tmp_path):
    path = write_bowl_store(tmp_path / "uniform.zarr", plant_rows=attend_uniformly, tasks=(0,), episodes=1)
    tables = measured(path)
    episodes = tables["objects_episodes"]
    np.testing.assert_allclose(episodes["enrichment"].drop_nulls(), 1.0, rtol=1e-5)
    of_all = np.where(episodes["camera"].to_numpy() == "all", 1.0, 0.5)
    np.testing.assert_allclose(episodes["share"], episodes["area_share"] * of_all, rtol=1e-5)
    seen = tables["pointing_episodes"].filter(pl.col("mask_replans") > 0)
    np.testing.assert_allclose(seen["pointing"], seen["pointing_chance"], rtol=1e-6)
    overlap = tables["iou_episodes"].filter(pl.col("threshold") == "p90").drop_nulls("iou")
    assert overlap.height == seen.height
    np.testing.assert_allclose(overlap["iou"], overlap["iou_chance"], rtol=1e-6)
    np.testing.assert_allclose(seen["centre_row"], 8.0, rtol=1e-5)
    np.testing.assert_allclose(seen["distance"], seen["distance_uniform"], rtol=1e-4)


def test_what_is_planted_is_found_where_it_is(follower_store):
    tables = measured(follower_store, ("layer", "head"))
    shares = tables["objects"].filter(BOWL, camera="all").sort("enrichment", descending=True)
    assert shares.select("layer", "head").row(0) == ("2", 1)
    assert shares["enrichment_low"][0] > 1.5
    found = tables["iou"].filter(BOWL, threshold="p90").with_columns(above=pl.col("iou") - pl.col("iou_chance"))
    assert found.sort("above").select("layer", "head").row(-1) == ("2", 1)
    cabinet = tables["objects"].filter(camera="all", item="wooden_cabinet_1", layer="2", head=0)
    assert cabinet["enrichment_high"][0] < shares["enrichment_low"][0]


def test_an_object_that_does_not_move_has_nothing_over_its_place_and_a_followed_one_has(tmp_path):
    def places(task, episode, tokens):
        area = bowl_coverage(tokens.num_replans, 16)
        for own in area.values():  # the bowl is elsewhere in each episode
            grid = own.reshape(len(own), 16, 16, -1)
            grid[..., 4] += grid[..., 0]
            grid[..., 0] = np.roll(grid[..., 0], (2 * episode, 3 * task), axis=(1, 2))
            grid[..., 4] -= grid[..., 0]
        return area

    path = write_bowl_store(tmp_path / "a.zarr", plant_rows=follow_bowl, plant_coverage=places, episodes=3)
    table = measured(path, iou=False)["objects"].filter(camera="all")
    assert table.filter(item="wooden_cabinet_1")["over_place"][0] == pytest.approx(1.0, abs=1e-5)
    assert table.filter(BOWL)["over_place_low"][0] > 1.4


def test_a_map_that_is_fixed_to_a_place_has_nothing_over_it_and_one_that_follows_has():
    """An object that stands elsewhere in each of 40 episodes, on two cameras with different shares."""
    generator = np.random.default_rng(0)
    areas = np.zeros((40, 128, 1))
    areas[np.arange(40), generator.integers(20, 40, 40)] = areas[np.arange(40), 64 + generator.integers(0, 64, 40)] = 1
    middle = np.exp(-((np.arange(128) % 64 - 30) ** 2) / 200.0) * np.repeat([3.0, 1.0], 64)
    for follow, wanted in ((0.0, 1.0), (1.0, 1.9)):
        maps = middle * (1 + follow * areas[..., 0])
        own = np.array([enrichment_on(one, area, [64, 64])[0] for one, area in zip(maps, areas, strict=True)])
        elsewhere = np.array(
            [enrichment_on(maps[i], np.delete(areas, i, 0).mean(axis=0), [64, 64])[0] for i in range(40)]
        )
        assert own.mean() / elsewhere.mean() == pytest.approx(wanted, rel=0.1)


def test_classes_follow_the_task_and_add_up(follower_store):
    times = measured(follower_store, iou=False)["object_times"].filter(pl.col("camera") == "all")
    whole = (
        times.filter(pl.col("kind") == "class")
        .group_by("task_id", "episode_index", "replan")
        .agg(pl.col("share").sum())
    )
    np.testing.assert_allclose(whole["share"], 1.0, rtol=1e-5)
    classes = dict(times.filter(pl.col("kind") == "object").select("item", "object_class").unique().rows())
    assert classes == {**CLASS_OF, "robot": "robot", "background": "background"}


def test_parts_of_time_add_up_to_the_episode(follower_store):
    by_time = measured(follower_store, ("time", "episode"))["objects"].filter(camera="all", kind="class")
    whole = measured(follower_store, ("episode",), iou=False)["objects"].filter(camera="all", kind="class")
    keys = ["task_id", "episode_index", "item"]
    mean = by_time.group_by(keys).agg(pl.col("area_share").mean())
    joined = whole.join(mean, on=keys, suffix="_of_parts")
    assert (by_time["phase"].n_unique(), joined.height) == (20, whole.height)
    np.testing.assert_allclose(joined["area_share"], joined["area_share_of_parts"], rtol=0.05)


def test_an_object_out_of_sight_has_no_enrichment_and_no_mask(tmp_path):
    tokens = bowl_tokens(replans=2)
    coverage = bowl_coverage(2, 16)
    coverage[CAMERAS[1]][:, :, 4] += coverage[CAMERAS[1]][:, :, 1]
    coverage[CAMERAS[1]][:, :, 1] = 0.0
    hidden = EpisodeTokens(tokens.layout, tokens.key_role, tokens.prompts, tokens.prompt_index, OBJECTS, coverage)
    tables = measured(write_bowl_store(tmp_path / "hidden.zarr", tokens=hidden, tasks=(0,), episodes=1))
    plate = (pl.col("item") == "plate_1") & (pl.col("camera") == CAMERAS[1])
    episodes = tables["objects_episodes"]
    assert episodes.filter(plate)["enrichment"].is_null().all()
    assert tables["iou_episodes"].filter(plate)["iou"].is_null().all()
    unseen = tables["pointing_episodes"].filter(plate)
    assert (unseen["mask_replans"] == 0).all()
    assert unseen.select("pointing", "distance", "pointing_chance").null_count().row(0) == (unseen.height,) * 3
    assert episodes.filter(pl.col("item") == "plate_1", camera="all")["enrichment"].is_not_null().all()
    assert tables.findings[0].limit


def test_a_block_that_has_two_numbers_counts_once_in_the_average(follower_store):
    question = question_about(follower_store, tasks=(0,))
    chosen = question.selection
    twice = replace(
        chosen,
        layers=(*chosen.layers, chosen.layers[1]),
        layer_labels=(*chosen.layer_labels, 20),
        blocks=(*chosen.blocks, chosen.blocks[1]),
    )
    once, doubled = objects(question), objects(replace(question, selection=twice))
    for name in ("objects_episodes", "pointing_episodes", "iou_episodes"):
        averages = [tables[name].filter(pl.col("layer") == "layers_avg") for tables in (once, doubled)]
        assert_frame_equal(*averages)
    both = [words(part)["words_episodes"] for part in (question, replace(question, selection=twice))]
    assert_frame_equal(*(table.filter(pl.col("layer") == "layers_avg") for table in both))


@pytest.mark.drawn
def test_the_command_prints_writes_and_draws(follower_store, tmp_path, capsys):
    assert main(["objects", str(follower_store), "--output", str(tmp_path), "--pdf"]) == 0
    printed = capsys.readouterr().out
    assert all(len(line) <= 100 for line in printed.splitlines() if str(tmp_path) not in line)
    tables = ("objects", "pointing", "iou", *(f"{name}_episodes" for name in ("objects", "pointing", "iou")))
    assert {path.name for path in tmp_path.iterdir()} == {
        "result.json", "object_times.parquet", *(f"{name}.parquet" for name in tables),
        "objects_enrichment.png", "objects_enrichment.pdf",
    }  # fmt: skip
    numbers = json.loads((tmp_path / "result.json").read_text())["findings"][0]["numbers"]
    assert numbers["over_area_low"] < numbers["over_area"] < numbers["over_area_high"]


def test_a_mistake_is_named(follower_store, tmp_path, capsys):
    for arguments, named in (
        (["--task", "9"], "task 9; .* 0, 1"),
        (["--by", "heads"], "'head'"),
    ):
        assert main(["objects", str(follower_store), "--output", str(tmp_path), *arguments]) == 2
        error = capsys.readouterr().err
        assert re.search(named, error)
        assert "Traceback" not in error


def test_pictures_of_robot_and_background_alone_say_so(tmp_path):
    def background(task, episode, tokens):
        rest = [thing.kind for thing in tokens.objects].index("background")
        return {
            name: np.eye(area.shape[-1], dtype=np.float32)[np.full(area.shape[:-1], rest)]
            for name, area in tokens.coverage.items()
        }

    path = write_store(tmp_path / "a.zarr", spec=StoreSpec(tasks=(0, 1), episodes=1, plant_coverage=background))
    (finding,) = va.open(path).objects().findings
    assert finding.numbers == {"shown": 0}
