"""What in the picture moves the action, of planted maps, against sums that are written apart."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest

import vla_attention as va
from tests.kit.planted_effects import planted_effects
from tests.kit.stores import StoreSpec, write_store
from vla_attention.capture.store.replan_records import ReplanEffects, ReplanMap
from vla_attention.schemas.groupings.vocabulary import EpisodeTokens
from vla_attention.schemas.stores.reader import open_store

DRAWN = 4


def planted_map(task: int, episode: int, replan: int, tokens: EpisodeTokens, agrees: float = 1.0) -> ReplanEffects:
    """Effects of words, and a map of the cameras with objects; the order agrees so far with the sizes."""
    layout, generator = tokens.layout, np.random.default_rng([task, episode, replan, 5])
    keys = tuple(int(key) for camera in tokens.coverage or () for key in layout.patch_keys(camera))
    sizes = generator.uniform(0.1, 2.0, len(keys))
    first = agrees * sizes + (1 - agrees) * generator.permutation(sizes)
    number = round(0.15 * len(keys))
    order = np.argsort(-first)
    chosen = [*order[:number], *generator.permutation(order[number:])[:DRAWN]]
    change = np.stack([sizes[place] * np.ones((5, 7)) for place in chosen]).astype(np.float32)
    of = planted_effects()(task, episode, replan, tokens)
    drawn = tuple(at >= number for at in range(len(chosen)))
    one = ReplanMap("joint", keys, 8, 5, first.astype(np.float32), tuple(map(int, chosen)), drawn, change)
    return replace(of, map=one)


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
            entries = [i for i, at in enumerate(one.patch_replan) if at == replan and not one.drawn[i]]
            sizes = {one.patch[i]: abs(change[i]).mean() for i in entries}
            top = sorted(sizes, key=lambda patch: -sizes[patch])[: round(0.1 * len(one.keys))]
            whole = sum(sizes[patch] for patch in top)
            of_named = sum(sizes[patch] * cover[number, patch, named].sum() for patch in top) / whole
            of_robot = sum(sizes[patch] * cover[number, patch, names.index("robot")] for patch in top) / whole
            parts.append((of_named, of_robot, 1 - of_named - of_robot))
        row = rows.filter(task_id=attributes.task_id, episode_index=attributes.episode_index).row(0, named=True)
        assert [row["named"], row["robot"], row["other"]] == pytest.approx(np.mean(parts, axis=0), rel=1e-5)
        assert row["rank"] == pytest.approx(1.0)
    (finding,) = [one for one in findings if one.asks == "What in the picture moves the action?"]
    of_tasks = rows.group_by("task_id").agg(pl.mean("named"))
    assert finding.numbers["named"] == pytest.approx(of_tasks["named"].mean(), rel=1e-6)
    patches = tables["maps"].shown
    assert patches.height == 18 * len(open_store(store).episodes[0].attributes.effects.map.keys)
    assert patches["exact"].drop_nulls().len() == sum(
        len(one.attributes.effects.map.patch) for one in open_store(store).episodes
    )


def sorted_cameras(episode) -> list[str]:
    return [name.removeprefix("objects/") for name in episode.attributes.arrays if name.startswith("objects/")]


def test_an_order_that_chance_could_give_is_said_not_to_hold(tmp_path):
    def plant(task: int, episode: int, replan: int, tokens: EpisodeTokens) -> ReplanEffects:
        return planted_map(task, episode, replan, tokens, agrees=0.0)

    spec = StoreSpec(tasks=(0, 1), episodes=3, replans=3, plant_effects=plant, effect_items=("text", "map"))
    _, findings = tables_of(write_store(tmp_path / "a.zarr", spec=spec))
    (finding,) = [one for one in findings if one.asks == "What in the picture moves the action?"]
    assert finding.numbers["rank_low"] < 0.5
    assert "not shown to hold" in finding.limit


def test_one_episode_does_not_say_that_the_order_holds(tmp_path):
    spec = StoreSpec(tasks=(0,), episodes=1, replans=3, plant_effects=planted_map, effect_items=("text", "map"))
    _, findings = tables_of(write_store(tmp_path / "a.zarr", spec=spec))
    (finding,) = [one for one in findings if one.asks == "What in the picture moves the action?"]
    assert "too few episodes" in finding.limit


def test_stores_without_a_map_say_nothing_of_it(tmp_path):
    spec = StoreSpec(tasks=(0,), episodes=2, replans=2, plant_effects=planted_effects())
    tables, findings = tables_of(write_store(tmp_path / "a.zarr", spec=spec))
    assert "maps" not in tables
    assert all("picture moves" not in one.asks for one in findings)
