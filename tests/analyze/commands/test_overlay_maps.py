"""`overlay` of runs with maps of patches: what is drawn beside attention, against the stored arrays."""

from __future__ import annotations

import dataclasses
from functools import partial
from pathlib import Path

import numpy as np
import polars as pl
import pytest
import zarr
from msgspec.structs import replace

import tests.kit.stores as kit
import vla_attention as va
from tests.kit.planted_effects import planted_map
from tests.kit.questions import question_about
from vla_attention.analyze.commands.overlay import overlay
from vla_attention.analyze.render.figures import draw
from vla_attention.analyze.render.style import Style
from vla_attention.analyze.render.video import _film
from vla_attention.capture.store.replan_records import ReplanEffects
from vla_attention.capture.store.store_writer import open_run
from vla_attention.schemas.groupings.vocabulary import EpisodeTokens
from vla_attention.schemas.layout import Role
from vla_attention.schemas.stores.reader import open_store

#: The call without a map.
WITHOUT = 1


def sometimes(task: int, episode: int, replan: int, tokens: EpisodeTokens) -> ReplanEffects:
    found = planted_map(task, episode, replan, tokens)
    return dataclasses.replace(found, map=None) if replan == WITHOUT else found


SPEC = kit.StoreSpec(tasks=(0,), episodes=1, replans=4, plant_effects=sometimes, effect_items=("text", "map"))


@pytest.fixture(scope="module", params=[(True, True), (False, False), (True, False)], ids=str)
def store(request, tmp_path_factory) -> Path:
    """One episode whose cameras are stored upright or not, and mirrored or not."""
    root, path = kit.root_attributes(SPEC), tmp_path_factory.mktemp("drawn") / "a.zarr"
    upright, mirrored = request.param
    views = tuple(replace(view, upright=upright, mirrored=mirrored) for view in root.policy.cameras)
    run = open_run(path, replace(root, policy=replace(root.policy, cameras=views)), "new")
    kit.write_episode(run, SPEC, 0, 0)
    return path


def as_seen(grid: np.ndarray, store: Path, camera: str) -> np.ndarray:
    (view,) = [one for one in open_store(store).attributes.policy.cameras if one.name == camera]
    grid = grid if view.upright else np.flipud(grid)
    return np.fliplr(grid) if view.mirrored else grid


def lifts_of(store: Path) -> dict[tuple[str, int], np.ndarray]:
    """By camera and replan the first order over its mean of the patches that are seen, as stored."""
    (episode,) = open_store(store).episodes
    one, group = episode.attributes.effects.map, zarr.open_group(store / "episodes" / episode.name, mode="r")
    layout, roles = open_store(store).attributes.sites[0], np.asarray(group["joint/key_role"])
    found = {}
    for values, replan in zip(np.asarray(group["effects/map"]).astype(float), one.replan, strict=True):
        of_keys = dict(zip(one.keys, values, strict=True))
        mean = np.mean([value for key, value in of_keys.items() if roles[replan, key] == Role.IMAGE])
        for span in layout.spans:
            if span.grid is not None and span.start in of_keys and roles[replan, span.start] == Role.IMAGE:
                own = [of_keys[key] / mean for key in range(span.start, span.stop)]
                found[span.camera, replan] = np.reshape(own, (span.grid.rows, span.grid.columns))
    return found


def test_pictures_have_the_map_s_values_and_marks_where_patches_were_taken_away(store):
    result = overlay(question_about(store))
    (figure,) = result.figures
    moved = figure.frame.filter(pl.col("second").is_not_null())
    lifts, (episode,) = lifts_of(store), open_store(store).episodes
    one = episode.attributes.effects.map
    assert moved["replan"].unique().sort().to_list() == [0, 1, 2, 3]
    for row in moved.iter_rows(named=True):
        drawn, camera, replan = np.array(row["second"]), row["camera"], row["replan"]
        if replan == WITHOUT:
            assert np.isnan(drawn).all()
            assert not row["marks"]
            continue
        lift = lifts[camera, replan]
        np.testing.assert_allclose(drawn, as_seen(lift, store, camera), rtol=1e-6)
        taken = np.zeros(lift.size, bool)
        first = one.keys.index(open_store(store).attributes.sites[0].patch_keys(camera)[0])
        places = [patch for of, patch, _ in one.entries if of == replan]
        taken[[patch - first for patch in places if first <= patch < first + lift.size]] = True
        marked = np.zeros(lift.shape, bool)
        for x, y in row["marks"]:
            marked[int(y * lift.shape[0]), int(x * lift.shape[1])] = True
        np.testing.assert_array_equal(marked, as_seen(taken.reshape(lift.shape), store, camera))
    attention = figure.frame.filter(pl.col("second").is_null())
    assert attention["map"].null_count() == 0
    assert moved["map"].null_count() == moved.height == attention.height


def test_the_table_has_the_map_and_the_exact_changes_of_effects(store):
    tables = {table.name: table.frame for table in overlay(question_about(store)).tables}
    exact = {table.name: table.shown for table in va.open(store).effects().tables}["maps"]
    layout, lifts = open_store(store).attributes.sites[0], lifts_of(store)
    known = dict(zip(exact.select("replan", "key").rows(), exact["exact"], strict=True))
    patches = tables["overlay_patches"]
    for row in patches.iter_rows(named=True):
        if row["replan"] == WITHOUT:
            assert row["moves"] is row["exact"] is None
            continue
        lift = lifts[row["camera"], row["replan"]]
        assert row["moves"] == pytest.approx(lift[row["row"], row["column"]])
        key = int(layout.patch_keys(row["camera"])[row["row"] * lift.shape[1] + row["column"]])
        assert row["exact"] == (None if known[row["replan"], key] is None else pytest.approx(known[row["replan"], key]))
    assert patches["exact"].drop_nulls().len() == len(open_store(store).episodes[0].attributes.effects.map.entries)


def test_the_count_of_patches_in_both_is_that_of_the_drawn_values(store):
    result = overlay(question_about(store))
    patches = {table.name: table.frame for table in result.tables}["overlay_patches"].drop_nulls("moves")
    counts = []
    for _, call in patches.group_by("replan"):
        tops = [set(call.sort(name, descending=True).head(8).select("camera", "row", "column").rows())
                for name in ("mass", "moves")]  # fmt: skip
        counts.append(len(tops[0] & tops[1]))
    (finding,) = [one for one in result.findings if "both" in one.numbers]
    assert patches.height == 16 * len(counts)  # of so few, half are compared
    assert finding.numbers["both"] == pytest.approx(np.mean(counts))
    assert finding.numbers["chance"] == pytest.approx(64 / 16)


def test_a_block_is_drawn_in_each_of_its_patches_and_none_is_marked(tmp_path):
    path = kit.write_store(
        tmp_path / "a.zarr", spec=dataclasses.replace(SPEC, plant_effects=partial(planted_map, blocks=6))
    )
    (figure,) = overlay(question_about(path)).figures
    (episode,) = open_store(path).episodes
    one, values = episode.attributes.effects.map, episode.read("effects/map").astype(float)
    layout = open_store(path).attributes.sites[0]
    for row in figure.frame.filter(pl.col("second").is_not_null()).iter_rows(named=True):
        of_patches = values[row["replan"]][list(one.blocks)]
        first = one.keys.index(layout.patch_keys(row["camera"])[0])
        drawn = as_seen(np.array(row["second"]), path, row["camera"])
        expected = of_patches[first : first + drawn.size] / of_patches.mean()
        np.testing.assert_allclose(drawn.ravel(), expected, rtol=1e-6)
        assert not row["marks"]


@pytest.mark.drawn
def test_films_have_one_size_and_pictures_a_mark_a_patch(store):
    (figure,) = overlay(question_about(store)).figures
    (axes,) = draw(figure, Style()).axes
    marks = [line for line in axes.lines if line.get_marker() == "s"]
    assert sum(len(line.get_xdata()) for line in marks) == sum(map(len, figure.frame["marks"].drop_nulls()))
    assert len({picture.shape for picture in _film(figure)}) == 1


def test_a_run_without_a_map_is_drawn_as_before(tmp_path):
    result = overlay(question_about(kit.write_store(tmp_path / "a.zarr", tasks=(0,), episodes=1)))
    assert "second" not in result.figures[0].frame.columns
    assert "moves" not in {table.name: table.frame for table in result.tables}["overlay_patches"].columns
    assert len(result.findings) == 1
