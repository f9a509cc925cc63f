"""Objects against loops over raw Zarr arrays, a planted follower, chance levels, and the command."""

from __future__ import annotations

import math
import tempfile
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import polars as pl
import pytest
import scipy.stats
import zarr
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from polars.testing import assert_frame_equal

from tests.kit.bowl_scene import CAMERAS, bowl_coverage, bowl_tokens, write_bowl_store
from tests.kit.examples import examples
from tests.kit.questions import question_about
from vla_attention.analyze.__main__ import main
from vla_attention.analyze.commands.words import words
from vla_attention.analyze.objects.object_attention import ObjectTables, object_tables
from vla_attention.analyze.objects.object_settings import ObjectSettings
from vla_attention.analyze.objects.object_study import followed_objects, iou_summary, leading_finder, objects_summary
from vla_attention.analyze.statistics.episode_intervals import Sampling
from vla_attention.analyze.statistics.units import Estimand
from vla_attention.schemas.groupings.vocabulary import EpisodeTokens
from vla_attention.testing.tokens import OBJECTS, random_rows

QUICK = settings(
    max_examples=examples(4), phases=[Phase.explicit, Phase.generate], deadline=None,
    suppress_health_check=[HealthCheck.too_slow],
)  # fmt: skip
CLASS_OF = {"akita_black_bowl_1": "of interest", "plate_1": "of interest", "wooden_cabinet_1": "other objects"}


def measured(path: Path, wanted: ObjectSettings | None = None, keep_steps: bool = False, **selected) -> SimpleNamespace:
    return whole(object_tables(question_about(path, **selected), wanted, keep_steps))


def whole(tables: ObjectTables) -> SimpleNamespace:
    """The tables as frames."""
    return SimpleNamespace(**{name: part and part.whole for name, part in vars(tables).items()})


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
    return episode["joint/rows"][:].astype(np.float64).mean(axis=4), coverage, spans


def test_shares_and_enrichment_equal_sums_over_raw_rows(follower_store):
    objects = measured(follower_store, ObjectSettings(spatial=False)).objects
    rows, coverage, spans = raw_episode(follower_store, "task001_episode000")
    own = objects.filter((pl.col("task_id") == 1) & (pl.col("episode_index") == 0) & (pl.col("layer") == "2"))
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
    objects = measured(follower_store, ObjectSettings(spatial=False)).objects
    keys = ["task_id", "episode_index", "layer", "kind", "item"]
    of_camera = objects.filter(pl.col("camera") != "all").group_by(keys)
    for name in ("enrichment", "control_enrichment"):
        bounds = of_camera.agg(pl.col(name).min().alias("low"), pl.col(name).max().alias("high"))
        both = objects.filter(pl.col("camera") == "all").join(bounds, on=keys).drop_nulls([name, "low"])
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
def test_spatial_metrics_equal_loops_over_raw_maps(data):
    """On random rows and coverage, per replan, layer, denoise step and head."""
    size, seed = data.draw(st.integers(7, 9)), data.draw(st.integers(0, 2**16))
    tokens = bowl_tokens(replans=2, size=size)
    percentile = data.draw(st.sampled_from([75.0, 90.0]))
    least, tolerance = data.draw(st.sampled_from([0.3, 0.7])), data.draw(st.sampled_from([0.0, 1.0, 1.5]))

    def plant(task, episode, tokens, rows):
        rows = random_rows(tokens, rows.shape[1:-1], seed, spread=1.0)
        return rows / rows.sum(axis=-1, keepdims=True)

    with tempfile.TemporaryDirectory() as folder:
        path = write_bowl_store(
            Path(folder) / "a.zarr", tokens=tokens, tasks=(0,), episodes=1, layers=(0, 1), plant_rows=plant
        )
        chosen = ObjectSettings(percentiles=(percentile,), mask_coverage=least, tolerance=tolerance)
        tables = measured(path, chosen, keep_steps=True, per_head=True)
        rows, coverage, spans = raw_episode(path, "task000_episode000")
    steps, iou_steps = tables.steps, tables.iou_steps
    assert steps is not None
    assert iou_steps is not None
    assert tables.iou is not None
    assert tables.pointing is not None
    where = ["replan", "layer", "denoise_step", "head", "camera", "kind", "item"]
    by_threshold = iou_steps.rows_by_key([*where, "threshold"], named=True)
    centres = np.array([(r + 0.5, c + 0.5) for r in range(size) for c in range(size)])
    for row in steps.sample(80, seed=seed).iter_rows(named=True):
        layer, denoise = row["layer"], {0: 0, 9: 1}[row["denoise_step"]]
        values = rows[row["replan"], layer, denoise, row["head"], spans[row["camera"]]]
        area = coverage[row["camera"]][row["replan"]][:, members_of(row["kind"], row["item"])].sum(axis=1)
        mask = set(np.flatnonzero(area >= least).tolist())
        of_map = [row[name] for name in where]
        otsu, overlap = (by_threshold[*of_map, name][0] for name in ("otsu", f"p{percentile:g}"))
        centre = np.average(centres, axis=0, weights=values)
        np.testing.assert_allclose([row["centre_row"], row["centre_column"]], centre, rtol=1e-5)
        assert row["mass"] == pytest.approx((values * area).sum(), rel=1e-5)
        if not mask:
            assert row["pointing"] is None
            assert otsu["iou"] is None
            continue
        region = set(np.flatnonzero(values >= scipy.stats.scoreatpercentile(values, percentile)).tolist())
        assert overlap["iou"] == pytest.approx(len(region & mask) / len(region | mask))
        moved = moved_ious(values, mask, percentile, row["replan"], size)
        assert overlap["iou_chance"] == pytest.approx(np.mean(moved))
        # Stored rows are rounded, so two patches can be equally high.
        highest = centres[values == values.max()]
        near = [any(math.dist(place, centres[patch]) <= tolerance for patch in mask) for place in highest]
        assert row["pointing"] == pytest.approx(np.mean(near))
        of_object = np.average(centres, axis=0, weights=area)
        assert row["distance"] == pytest.approx(np.hypot(*(centre - of_object)) / size, rel=1e-5)
    # The episode's tables hold the means of these steps over replans with a mask and denoise steps.
    keys = ["layer", "head", "camera", "kind", "item"]
    for table, of_steps, by, names, height in (
        (tables.pointing, steps, keys, ["pointing", "distance"], 2 * 2 * 2 * 9),
        (tables.iou, iou_steps, [*keys, "threshold"], ["iou", "iou_chance"], 2 * 2 * 2 * 9 * 2),
    ):
        means = of_steps.with_columns(pl.col("layer").cast(pl.String)).group_by(by).agg(pl.col(names).mean())
        joined = table.filter(pl.col("layer") != "layers_avg").join(means, on=by, suffix="_mean")
        assert joined.height == height
        for name in names:
            wanted = joined[f"{name}_mean"].cast(pl.Float64).to_numpy()
            np.testing.assert_allclose(joined[name].cast(pl.Float64).to_numpy(), wanted, rtol=1e-9)


def test_uniform_attention_scores_exactly_what_chance_does(tmp_path):
    path = write_bowl_store(tmp_path / "uniform.zarr", plant_rows=attend_uniformly, tasks=(0,), episodes=1)
    tables = measured(path)
    assert tables.iou is not None
    np.testing.assert_allclose(tables.objects["enrichment"].drop_nulls(), 1.0, rtol=1e-5)
    np.testing.assert_allclose(
        tables.objects["share"], tables.objects["area_share"] * _of_all(tables.objects), rtol=1e-5
    )
    assert tables.pointing is not None
    seen = tables.pointing.filter(pl.col("mask_replans") > 0)
    np.testing.assert_allclose(seen["pointing"], seen["pointing_chance"], rtol=1e-6)
    overlap = tables.iou.filter(pl.col("threshold") == "p90").drop_nulls("iou")
    assert overlap.height == seen.height
    np.testing.assert_allclose(overlap["iou"], overlap["iou_chance"], rtol=1e-6)
    np.testing.assert_allclose(seen["centre_row"], 8.0, rtol=1e-5)
    np.testing.assert_allclose(seen["distance"], seen["distance_uniform"], rtol=1e-4)


def _of_all(objects: pl.DataFrame) -> np.ndarray:
    """The part of all cameras' pictures that the row's cameras are."""
    return np.where(objects["camera"].to_numpy() == "all", 1.0, 0.5)


def test_a_planted_follower_is_found_and_named(follower_store):
    tables = object_tables(question_about(follower_store, per_head=True))
    assert tables.iou is not None
    names = [
        (one.name, one.found.is_named()) for one in followed_objects(tables.objects, Sampling(Estimand.THESE_TASKS))
    ]
    bowl = {"item": "akita_black_bowl_1"}
    assert names == [
        (bowl | {"layer": "2", "head": 1}, True)
    ]  # the cabinet does not move, and one object leads nothing
    finder = leading_finder(tables.iou, "p90", Sampling(Estimand.THESE_TASKS))
    assert (finder.name["layer"], finder.name["head"]) == ("2", 1)
    assert finder.found.value > 0.1
    summary = objects_summary(tables.objects, Sampling())
    bowl = summary.filter((pl.col("camera") == "all") & (pl.col("item") == "akita_black_bowl_1")).row(0, named=True)
    assert bowl["enrichment_low"] > 1.5
    cabinet = summary.filter((pl.col("camera") == "all") & (pl.col("item") == "wooden_cabinet_1")).row(0, named=True)
    assert cabinet["enrichment_high"] < 1.1
    found = iou_summary(tables.iou, Sampling()).filter(pl.col("threshold") == "p90")
    assert found.filter(pl.col("item") == "akita_black_bowl_1")["num_episodes"].to_list() == [4, 4]


def test_classes_follow_the_task_and_add_up(follower_store):
    tables = measured(follower_store, ObjectSettings(spatial=False))
    times = tables.times.filter(pl.col("camera") == "all")
    whole = (
        times.filter(pl.col("kind") == "class")
        .group_by("task_id", "episode_index", "replan")
        .agg(pl.col("share").sum())
    )
    np.testing.assert_allclose(whole["share"], 1.0, rtol=1e-5)
    classes = dict(times.filter(pl.col("kind") == "object").select("item", "object_class").unique().rows())
    assert classes == {**CLASS_OF, "robot": "robot", "background": "background"}


def test_an_object_out_of_sight_has_no_enrichment_and_no_mask(tmp_path):
    tokens = bowl_tokens(replans=2)
    coverage = bowl_coverage(2, 16)
    coverage[CAMERAS[1]][:, :, 4] += coverage[CAMERAS[1]][:, :, 1]
    coverage[CAMERAS[1]][:, :, 1] = 0.0
    hidden = EpisodeTokens(tokens.layout, tokens.key_role, tokens.prompts, tokens.prompt_index, OBJECTS, coverage)
    tables = measured(write_bowl_store(tmp_path / "hidden.zarr", tokens=hidden, tasks=(0,), episodes=1))
    plate = (pl.col("item") == "plate_1") & (pl.col("camera") == CAMERAS[1])
    assert tables.objects.filter(plate)["enrichment"].is_null().all()
    assert tables.iou is not None
    assert tables.iou.filter(plate)["iou"].is_null().all()
    assert tables.pointing is not None
    unseen = tables.pointing.filter(plate)
    assert (unseen["mask_replans"] == 0).all()
    assert unseen.select("pointing", "distance", "pointing_chance").null_count().row(0) == (unseen.height,) * 3
    assert (
        tables.objects.filter((pl.col("item") == "plate_1") & (pl.col("camera") == "all"))["enrichment"]
        .is_not_null()
        .all()
    )


def test_a_block_that_has_two_numbers_counts_once_in_the_average(follower_store):
    question = question_about(follower_store, tasks=(0,))
    chosen = question.selection
    twice = replace(
        chosen,
        layers=(*chosen.layers, chosen.layers[1]),
        layer_labels=(*chosen.layer_labels, 20),
        blocks=(*chosen.blocks, chosen.blocks[1]),
    )
    once, doubled = whole(object_tables(question)), whole(object_tables(replace(question, selection=twice)))
    for name in ("objects", "pointing", "iou"):
        averages = [getattr(tables, name).filter(pl.col("layer") == "layers_avg") for tables in (once, doubled)]
        assert_frame_equal(*averages)
    both = [words(part)["words_episodes"] for part in (question, replace(question, selection=twice))]
    assert_frame_equal(*(table.filter(pl.col("layer") == "layers_avg") for table in both))


@pytest.mark.drawn
def test_the_command_prints_writes_and_draws(follower_store, tmp_path, capsys):
    arguments = [
        "objects",
        str(follower_store),
        "--output",
        str(tmp_path),
        "--per-head",
        "--save-steps",
        "--task",
        "1",
        "--pdf",
    ]
    assert main(arguments) == 0
    assert len(capsys.readouterr().out.splitlines()) <= 40
    whole = (tmp_path / "summary.txt").read_text()
    assert "layers surely finds the objects of interest better" in whole  # two episodes show too little
    assert {path.name for path in tmp_path.iterdir()} == {
        "summary.txt",
        *(f"{name}.parquet" for name in ("objects", "object_times", "object_steps", "objects_summary", "iou_steps")),
        *(f"{name}{end}.parquet" for name in ("pointing", "iou") for end in ("", "_summary")),
        *(f"{name}.{kind}" for name in ("object_shares", "object_iou") for kind in ("png", "pdf", "csv")),
    }  # fmt: skip
    assert main(["objects", str(follower_store), "--output", str(tmp_path / "less"), "--no-iou"]) == 0
    assert not (tmp_path / "less" / "object_iou.png").exists()
    assert "IoU" not in capsys.readouterr().out


def test_a_mistake_ends_with_one_sentence(follower_store, tmp_path, capsys):
    for arguments, said in (
        (["--task", "9"], "has no episode of task 9; it has tasks 0, 1"),
        (["--percentiles", "100"], "Percentile 100 was given"),
        (["--mask-coverage", "0"], "Mask coverage 0 was given"),
        (["--tolerance", "-1"], "Tolerance -1 was given"),
    ):
        assert main(["objects", str(follower_store), "--output", str(tmp_path), *arguments]) == 2
        error = capsys.readouterr().err
        assert said in error
        assert "Traceback" not in error
