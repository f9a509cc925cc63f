"""Named against not named: numbers against loops over raw arrays, and what nothing may be claimed of."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import polars as pl
import pytest
import zarr

import vla_attention as va
from benchmarks.null_objects import (
    FOLLOWS,
    claims,
    like_libero,
    over_places,
    rows_of,
    scenes_of,
    thrice,
    without_states,
    write,
)
from tests.kit.made_up_behaviour import COLOURS
from tests.kit.questions import question_about
from tests.kit.raw_rows import probabilities
from vla_attention.analyze.core.naming import (
    ALL_NAMED,
    Naming,
    ObjectAttention,
    by_kind,
    differences,
    naming,
    told_things,
)
from vla_attention.analyze.measures.question import Question
from vla_attention.schemas.episode_steps import EpisodeSteps


@pytest.fixture(scope="module")
def cubes():
    return scenes_of(va.example("cubes"))


def naming_of(question: Question) -> Naming:
    objects = ObjectAttention.measured_in(question)
    assert objects is not None
    return naming(objects.question, objects.measured, objects.maps)


def named_twice(cubes, path: Path, times: float, states: bool = True) -> Path:
    root, scenes = cubes
    scenes = scenes if states else without_states(scenes)
    return write(path, root, scenes, [rows_of(scene, root, FOLLOWS["uniform"], 0, times) for scene in scenes])


def first_maps(path: Path) -> dict[tuple[int, int], tuple]:
    """Of each episode: initial state, named object, object -> (share of the pictures, its map's enrichment, area)."""
    root, found = zarr.open_group(path, mode="r"), {}
    spans = [span for span in root.attrs["sites"][0]["spans"] if span["camera"]]
    for _, episode in root["episodes"].groups():
        about = dict(episode.attrs)
        row = probabilities(episode["joint/rows"])[0].astype(np.float64).mean(axis=(0, 1, 2, 3))
        maps = {span["camera"]: row[span["start"] : span["stop"]] for span in spans}
        areas = {camera: episode[f"objects/{camera}"][0].astype(np.float64) for camera in maps}
        whole = sum(one.sum() for one in maps.values())
        names = [thing["name"] for thing in about["objects"]]
        cubes = {name: i for i, name in enumerate(names) if name.endswith("cube")}
        share = {name: sum(maps[c] @ areas[c][:, i] for c in maps) / whole for name, i in cubes.items()}
        (named,) = (thing["name"] for thing in about["objects"] if thing["of_interest"])
        key = (about["task_id"], about["episode_index"])
        found[key] = (about["initial_state_digest"], named, share, maps, {n: {c: areas[c][:, i] for c in maps}
                      for n, i in cubes.items()})  # fmt: skip
    return found


def test_the_same_object_in_the_same_state_equals_a_loop_over_raw_rows():
    path = va.example("cubes")
    episodes, logs = first_maps(path), {}
    for key, (state, named, share, *_) in episodes.items():
        others = [one[2][named] for one in episodes.values() if one[0] == state and one[1] != named]
        assert len(others) == 2
        logs[key] = np.log(share[named]) - np.log(others).mean()
    found = naming_of(question_about(path))
    assert found.form == "same state"
    assert found.answer["ratio"] == pytest.approx(np.exp(np.mean(list(logs.values()))), rel=1e-3)
    own = {(task, episode): log for _, task, episode, log in found.episodes.iter_rows()}
    assert own == pytest.approx(logs, rel=1e-3)


def test_the_same_object_in_other_tasks_equals_a_loop_over_raw_rows(cubes, tmp_path):
    path = named_twice(cubes, tmp_path / "a.zarr", 2.0, states=False)
    episodes = first_maps(path)

    def on(maps, area) -> float:
        whole = sum(one.sum() for one in maps.values())
        return sum(maps[c] @ area[c] for c in maps) / sum(maps[c].sum() * area[c].mean() for c in maps) / whole * whole

    over: dict[tuple[int, int], dict[str, float]] = {}
    for (task, episode), (_, _, _, maps, areas) in episodes.items():
        other = episodes[task, 1 - episode][4]
        over[task, episode] = {name: np.log(on(maps, areas[name]) / on(maps, other[name])) for name in areas}
    logs = []
    for (task, _), values, (_, named, *_) in zip(over, over.values(), episodes.values(), strict=True):
        others = [np.mean([over[other, i][named] for i in (0, 1)]) for other in (0, 1, 2) if other != task]
        logs.append(values[named] - np.mean(others))
    found = naming_of(question_about(path))
    assert found.form == "other tasks"
    assert found.answer["ratio"] == pytest.approx(np.exp(np.mean(logs)), rel=1e-3)
    assert set(found.rows.filter(camera="all")["item"]) == {ALL_NAMED, *(f"{c}_cube" for c in ("red", "green", "blue"))}


def test_differences_equal_a_loop():
    generator = np.random.default_rng(0)
    values = np.where(generator.random((20, 4)) < 0.1, np.nan, generator.normal(size=(20, 4)))
    named, kept = generator.random((20, 4)) < 0.4, generator.random(20) < 0.9
    strata, tasks = generator.integers(0, 2, 20), generator.integers(0, 4, 20)
    found = differences(values, named, strata, tasks, kept)
    for e, o in np.ndindex(found.shape):
        free = [
            [values[i, o] for i in range(20) if kept[i] and not named[i, o] and np.isfinite(values[i, o])
             and strata[i] == strata[e] and tasks[i] == task]
            for task in range(4) if task != tasks[e]
        ]  # fmt: skip
        means = [np.mean(one) for one in free if one]
        wanted = values[e, o] - np.mean(means) if kept[e] and named[e, o] and means else np.nan
        assert found[e, o] == pytest.approx(wanted, nan_ok=True)


@pytest.mark.parametrize(("times", "more"), [(8.0, True), (0.1, False)])
def test_both_directions_are_found(cubes, tmp_path, times, more):
    numbers = va.open(named_twice(cubes, tmp_path / "a.zarr", times)).objects(iou=False).findings[0].numbers
    assert numbers["shown"] == 1
    assert (numbers["ratio"] > 1) == more


def test_a_kind_that_is_always_named_makes_no_claim(tmp_path):
    root, scenes = like_libero("spatial", 0)
    scenes = [scene for scene in scenes if scene.start.task_id < 3]
    path = write(tmp_path / "a.zarr", root, scenes, [rows_of(one, root, FOLLOWS["uniform"], 0, 9.0) for one in scenes])
    found = naming_of(question_about(path))
    assert (found.form, found.always) == (None, ("black_bowl", "plate"))
    assert not claims(path)


@pytest.mark.parametrize("states", [True, False])
def test_an_episode_three_times_has_its_place_and_no_interval(cubes, tmp_path, states):
    root, scenes = cubes
    path = thrice(root, scenes if states else without_states(scenes), 0, tmp_path / "a.zarr")
    assert (over_places(path) == 1.0).all()
    assert not claims(path)


def test_instances_stand_for_their_kind_where_one_of_them_is_always_named():
    rows = pl.DataFrame(
        [
            ("s", 0, 0, "all", "bowl_1", True, 1.0), ("s", 0, 0, "all", "bowl_2", False, 9.0),
            ("s", 1, 0, "all", "bowl_2", False, 2.0), ("s", 1, 0, "all", "bowl_3", False, 4.0),
            ("s", 0, 0, "all", "mug_1", True, 5.0), ("s", 1, 0, "all", "mug_1", False, 6.0),
        ],
        ["suite", "task_id", "episode_index", "camera", "item", "named", "x"], orient="row",
    )  # fmt: skip
    found = by_kind(rows).select("task_id", "item", "named", "x").rows()
    assert sorted(found) == [(0, "bowl", True, 1.0), (0, "mug_1", True, 5.0), (1, "bowl", False, 3.0),
                             (1, "mug_1", False, 6.0)]  # fmt: skip


@pytest.mark.parametrize(
    ("told", "named"),
    [("touch the red cube", {"red_cube"}), ("Touch the green cube", {"green_cube"}), ("wave hello twice", None)],
)
def test_what_a_sentence_names_is_of_the_task_that_it_tells(told, named):
    goals = tuple(
        type(goal)(goal.task_id, goal.task_name, goal.instruction, goal.conditions, None, (f"{colour}_cube",))
        for goal, colour in zip(COLOURS, ("red", "green", "blue"), strict=True)
    )
    things = tuple(SimpleNamespace(name=f"{c}_cube", of_interest=c == "red") for c in ("red", "green", "blue"))
    attributes = SimpleNamespace(
        task_id=0, instruction="touch the red cube", objects=things, steps=EpisodeSteps(("hand",), (None,), goals),
        prompts=[SimpleNamespace(instruction_text=told)],
    )  # fmt: skip
    store = SimpleNamespace(attributes=SimpleNamespace(interventions=SimpleNamespace(prompt=None)))
    item = SimpleNamespace(store=store, episode=SimpleNamespace(attributes=attributes))
    assert told_things(item) == named
