"""What in the picture moves the action, of planted maps, against sums that are written apart."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import polars as pl
import pytest

import vla_attention as va
from benchmarks.null_objects import FOLLOWS, rows_of, scenes_of, write
from tests.kit.planted_effects import planted_effects, planted_map
from tests.kit.stores import StoreSpec, write_store
from vla_attention.analyze.commands.effects.maps import ASKS, ASKS_NAMED
from vla_attention.schemas.stores.reader import open_store


@pytest.fixture(scope="module")
def store(tmp_path_factory) -> Path:
    spec = StoreSpec(tasks=(0, 1), episodes=3, replans=3, plant_effects=planted_map, effect_items=("text", "map"))
    return write_store(tmp_path_factory.mktemp("mapped") / "a.zarr", spec=spec)


def tables_of(store: Path, **options):
    result = va.open(store).effects(**options)
    return {table.name: table for table in result.tables}, result.findings


def test_parts_of_the_strongest_tenth_are_sums_over_its_patches(store):
    tables, findings = tables_of(store)
    rows = tables["maps_episodes"].shown
    for opened in open_store(store).episodes:
        attributes = opened.attributes
        one, change = attributes.effects.map, opened.read("effects/patch_change").astype(float)
        names = [thing.name for thing in attributes.objects]
        named = [thing.of_interest for thing in attributes.objects]
        cover = np.concatenate([opened.read(f"objects/{camera}") for camera in sorted_cameras(opened)], axis=1)
        parts = []
        for number, replan in enumerate(one.replan):
            entries = [(i, patch) for i, (at, patch, drawn) in enumerate(one.entries) if at == replan and not drawn]
            sizes = {patch: abs(change[i]).mean() for i, patch in entries}
            top = sorted(sizes, key=lambda patch: -sizes[patch])[: round(0.1 * len(one.keys))]
            whole = sum(sizes[patch] for patch in top)
            of_named = sum(sizes[patch] * cover[number, patch, named].sum() for patch in top) / whole
            of_robot = sum(sizes[patch] * cover[number, patch, names.index("robot")] for patch in top) / whole
            parts.append((of_named, of_robot, 1 - of_named - of_robot))
        row = rows.filter(task_id=attributes.task_id, episode_index=attributes.episode_index).row(0, named=True)
        assert [row[f"top_{name}"] for name in ("named", "robot", "other")] == pytest.approx(
            np.mean(parts, axis=0), rel=1e-5
        )
        assert row["rank"] == pytest.approx(1.0)
    (finding,) = [one for one in findings if one.asks == ASKS]
    of_tasks = rows.group_by("task_id").agg(pl.mean("top_named"))
    assert finding.numbers["named"] == pytest.approx(of_tasks["top_named"].mean(), rel=1e-6)
    patches = tables["maps"].shown
    assert patches.height == 18 * len(open_store(store).episodes[0].attributes.effects.map.keys)
    assert patches["exact"].drop_nulls().len() == sum(
        len(one.attributes.effects.map.entries) for one in open_store(store).episodes
    )


def sorted_cameras(episode) -> list[str]:
    return [name.removeprefix("objects/") for name in episode.attributes.arrays if name.startswith("objects/")]


def test_an_order_that_chance_could_give_is_said_not_to_hold(tmp_path):
    plant = partial(planted_map, agrees=0.0)
    spec = StoreSpec(tasks=(0, 1), episodes=3, replans=3, plant_effects=plant, effect_items=("text", "map"))
    _, findings = tables_of(write_store(tmp_path / "a.zarr", spec=spec))
    (finding,) = [one for one in findings if one.asks == ASKS]
    assert finding.numbers["rank_low"] < 0.5
    assert "not shown to hold" in finding.limit


def test_one_episode_does_not_say_that_the_order_holds(tmp_path):
    spec = StoreSpec(tasks=(0,), episodes=1, replans=3, plant_effects=planted_map, effect_items=("text", "map"))
    _, findings = tables_of(write_store(tmp_path / "a.zarr", spec=spec))
    (finding,) = [one for one in findings if one.asks == ASKS]
    assert "too few episodes" in finding.limit


@pytest.fixture(scope="module")
def blocks(tmp_path_factory) -> Path:
    plant, success = partial(planted_map, blocks=6), lambda task, episode: episode > 0
    spec = StoreSpec(tasks=(0, 1), episodes=3, replans=3, plant_effects=plant, effect_items=("text", "map"),
                     plant_success=success)  # fmt: skip
    return write_store(tmp_path_factory.mktemp("blocks") / "a.zarr", spec=spec)


def test_parts_of_blocks_are_sums_over_all_of_them(blocks):
    tables, findings = tables_of(blocks)
    rows = tables["maps_episodes"].shown
    for opened in open_store(blocks).episodes:
        attributes, sums = opened.attributes, []
        one, change = attributes.effects.map, opened.read("effects/patch_change").astype(float)
        named = [thing.of_interest for thing in attributes.objects]
        cover = np.concatenate([opened.read(f"objects/{camera}") for camera in sorted_cameras(opened)], axis=1)
        attention = opened.read("joint/rows").astype(float).mean(axis=(1, 2, 3, 4))
        for number, replan in enumerate(one.replan):
            sizes = {patch: abs(change[i]).mean() for i, (at, patch, _) in enumerate(one.entries) if at == replan}
            of_key = cover[number][:, named].sum(axis=1)
            covers = {block: of_key[np.array(one.blocks) == block].mean() for block in sizes}
            read = {block: sum(attention[replan, key] for key, own in zip(one.keys, one.blocks, strict=True)
                               if own == block) for block in sizes}  # fmt: skip
            sums.append([sum(of[block] * covers[block] for block in of) / sum(of.values()) for of in (sizes, read)])
        row = rows.filter(task_id=attributes.task_id, episode_index=attributes.episode_index).row(0, named=True)
        found = [row["all_named"], row["attention_all_named"]]
        assert found == pytest.approx(np.mean(sums, axis=0), rel=1e-4)
        assert row["rank"] is None
        patches = cover[:, :, named].sum(axis=2)
        assert row["area_named"] == pytest.approx(patches.mean(), rel=1e-4)
    (finding,) = [one for one in findings if one.asks == ASKS]
    assert finding.numbers["named"] == pytest.approx(
        rows.group_by("task_id").agg(pl.mean("all_named"))["all_named"].mean()
    )
    of_outcome = tables["maps_outcomes"].shown
    solved = rows.filter("success").group_by("task_id").agg(pl.mean("all_named"))["all_named"].mean()
    assert of_outcome.filter("success")["all_named"].item() == pytest.approx(solved)


def test_parts_are_kept_apart_by_task(blocks):
    tables, _ = tables_of(blocks, by="task")
    rows, each = tables["maps_by"].shown, tables["maps_episodes"].shown
    assert rows["task_id"].to_list() == [0, 1]
    for task in (0, 1):
        mean = each.filter(task_id=task)["all_other"].mean()
        assert rows.filter(task_id=task)["all_other"].item() == pytest.approx(mean)


def test_compare_has_the_parts_of_both_runs(tmp_path):
    paths = []
    for number in range(2):
        spec = StoreSpec(tasks=(0, 1), episodes=2, replans=1, layers=(0,), heads=(0,), effect_items=("text", "map"),
                         frames=False, plant_effects=partial(planted_map, blocks=6, seed=number))  # fmt: skip
        paths.append(write_store(tmp_path / f"{number}.zarr", spec=spec))
    table = {table.name: table for table in va.open(paths[0]).compare(paths[1]).tables}["maps"]
    row = table.shown.filter(scope="all", item="named").row(0, named=True)
    for side, path in zip(("first", "other"), paths, strict=True):
        each = tables_of(path)[0]["maps_episodes"].shown
        mean = each.group_by("task_id").agg(pl.mean("all_named"))["all_named"].mean()
        assert row[f"mean_{side}"] == pytest.approx(mean)
    # Parts depend on the size of blocks: of other ones they are not compared.
    plant = partial(planted_map, blocks=4)
    other = write_store(tmp_path / "other.zarr", spec=replace(spec, plant_effects=plant))
    assert "maps" not in {table.name for table in va.open(paths[0]).compare(other).tables}


@pytest.mark.parametrize("times", [8.0, 0.1])
def test_what_is_named_is_compared_as_attention_to_it_is(tmp_path, times):
    """Each patch moves the action as much as it is attended to: both answers have the same numbers."""
    root, scenes = scenes_of(va.example("cubes"))
    rows = [rows_of(scene, root, FOLLOWS["uniform"], 0, times) for scene in scenes]
    path = write(tmp_path / "a.zarr", root, scenes, rows, maps=True)
    result = va.open(path).objects(iou=False)
    by_asks = {finding.asks: finding.numbers for finding in result.findings}
    moves, read = by_asks[ASKS_NAMED], by_asks["What does it look at?"]
    assert [moves[name] for name in _NAMED] == pytest.approx([read[name] for name in _NAMED], rel=2e-3)
    assert moves["shown"] == 1
    assert (moves["ratio"] > 1) == (times > 1)


_NAMED = ("ratio", "ratio_low", "ratio_high")


def test_stores_without_a_map_say_nothing_of_it(tmp_path):
    spec = StoreSpec(tasks=(0,), episodes=2, replans=2, plant_effects=planted_effects())
    tables, findings = tables_of(write_store(tmp_path / "a.zarr", spec=spec))
    assert "maps" not in tables
    assert all("picture moves" not in one.asks for one in findings)
