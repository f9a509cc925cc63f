"""What the server answers is what the commands print: rows, ratios, masses, maps, heads, effects, what happened."""

from __future__ import annotations

import io
import json
import math
import re
import shutil
from collections.abc import Iterator
from dataclasses import replace
from typing import Any
from urllib.parse import quote

import numpy as np
import polars as pl
import pytest
from msgspec import structs
from PIL import Image

import vla_attention as va
from tests.end_to_end.test_cameras_of_several_spans import write_spans_store
from tests.kit.bowl_scene import bowl_tokens
from tests.kit.golden_stores import golden_store
from tests.kit.site_stores import write_site_store
from tests.kit.stores import StoreSpec, small_steps, write_store
from tests.kit.viewer import ask, served
from vla_attention.analyze.core.camera_maps import camera_names, episode_maps, stored_picture, upright
from vla_attention.analyze.measures.question import ask as question_of
from vla_attention.analyze.measures.question_settings import AnalysisSettings
from vla_attention.analyze.render.style import group_styles
from vla_attention.analyze.view import head_answers
from vla_attention.analyze.view.answers import Answers
from vla_attention.analyze.view.episode_answers import MEAN, ShownEpisode, _closings
from vla_attention.schemas.episode_steps import TaskGoal
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.seal import SEAL_FILE

NAMES = ("joint", "cosmos", "masks", "effects", "steps", "spans")
SITES = [("joint", "joint"), ("cosmos", "self"), ("cosmos", "cross"), ("masks", "joint"), ("spans", "joint")]


@pytest.fixture(scope="module")
def places(tmp_path_factory):
    folder = tmp_path_factory.mktemp("answered")
    for name in NAMES[:-1]:
        shutil.copytree(golden_store(name), folder / f"{name}.zarr")
    write_spans_store(folder / "spans.zarr", "tiles and thumbnail")
    return {name: folder / f"{name}.zarr" for name in NAMES}


@pytest.fixture(scope="module")
def server(places) -> Iterator[Any]:
    with served(*places.values()) as running:
        yield running


def read(server, name: str, path: str = "", episode: int = 0) -> Any:
    """What the server says of an episode of a store."""
    run = read_path(server, "runs.json")["runs"][NAMES.index(name)]
    return read_path(server, f"runs/{NAMES.index(name)}/{run['episodes'][episode]['name']}/{path}")


def read_path(server, path: str) -> Any:
    reply = ask(server, path)
    assert reply.status == 200, (path, reply.body[:200])
    if ".npy" in path:
        return np.load(io.BytesIO(reply.body), allow_pickle=False)
    return np.array(Image.open(io.BytesIO(reply.body))) if ".png" in path else json.loads(reply.body)


def of_analysis(table: pl.DataFrame, column: str, episode: dict[str, int], **where: Any) -> np.ndarray:
    """A column of a table of replans and layers, (replan, layer), the mean of all layers last; NaN for null."""
    rows = table.filter(**episode, **where).sort("replan", "layer_number", nulls_last=True)
    return rows[column].cast(pl.Float64).to_numpy().reshape(rows["replan"].n_unique(), -1)


def numbers(values: Any) -> np.ndarray:
    return np.array(values, dtype=float)  # None is NaN


@pytest.mark.parametrize(("name", "site"), SITES)
@pytest.mark.parametrize("asked", [{}, {"denoise": "last", "heads": 0}], ids=["all", "one"])
def test_ratios_and_masses(server, places, name, site, asked):
    run = va.open(places[name])
    last = run.attributes.recording.denoise_steps[-1]
    given = read(server, name, f"{site}/groups/{f'{last}/0' if asked else 'mean/mean'}.json")
    result = run.analyze(site=site, grouping="default", **asked)
    about = read(server, name, "about.json")
    episode = {"task_id": about["task"], "episode_index": about["episode"]}
    for column in ("ratio", "uniform_ratio", "ratio_lift"):
        if column in result["replans"].columns:
            expected = of_analysis(result["replans"], column, episode)
            expected = np.where(np.isfinite(expected), expected, np.nan)
            np.testing.assert_array_equal(numbers(given[column]), expected)
    for group, columns in given["groups"].items():
        assert columns.pop("color") == group_styles(list(given["groups"]))[group]["color"]
        for column, values in columns.items():
            expected = of_analysis(result["replans_groups"], column, episode, group=group)
            np.testing.assert_array_equal(numbers(values), expected)


@pytest.mark.parametrize(("name", "site"), SITES)
def test_sums_of_rows_are_the_masses(server, name, site):
    about = read(server, name, "about.json")
    groups = read(server, name, f"{site}/groups/mean/mean.json")
    camera_keys = [key for camera in about["sites"][site]["cameras"].values() for key in camera["keys"]]
    for at, layer in enumerate(groups["layers"]):
        rows, heads = (read(server, name, f"{site}/{kind}/{layer}.npy") for kind in ("rows", "heads"))
        np.testing.assert_allclose(rows, heads.mean(axis=2), rtol=1e-5, atol=1e-9)
        # Masses of whole spans are of the rows before storage rounded them.
        total = sum(numbers(group["mass"])[:, at] for group in groups["groups"].values())
        np.testing.assert_allclose(rows.sum(axis=-1).mean(axis=1), total, rtol=2**-11)
        uniform = read(server, name, f"{site}/uniform/{layer}.npy")
        np.testing.assert_allclose(uniform.sum(axis=-1), 1, rtol=1e-5)
    if name == "joint":
        visual = numbers(groups["groups"]["visual"]["mass"])[:, -1]
        mean = read(server, name, f"{site}/rows/{MEAN}.npy").mean(axis=1)
        np.testing.assert_allclose(mean[:, sorted(set(camera_keys))].sum(axis=-1), visual, rtol=2**-11)


@pytest.mark.parametrize("name", ["joint", "spans"])
def test_maps_of_the_page_are_those_of_overlay(server, places, name):
    question = question_of([open_store(places[name])], AnalysisSettings())
    item = question.selected[0]
    maps = episode_maps(question, item, camera_names(question))
    about, site = read(server, name, "about.json"), question.site
    rows = read(server, name, f"{site}/rows/{MEAN}.npy").mean(axis=1)
    for camera, one in maps.cameras.items():
        how = about["sites"][site]["cameras"][camera]
        shares = np.ones(len(how["keys"])) if how["shares"] is None else np.array(how["shares"])
        given = np.zeros((len(rows), how["rows"] * how["columns"]))
        np.add.at(given, (slice(None), how["cells"]), rows[:, how["keys"]] * shares)
        for replan, cells in enumerate(given):
            expected = upright(one.mass[replan], one.view)
            np.testing.assert_allclose(cells.reshape(expected.shape), expected, rtol=1e-5, atol=1e-9)
            picture = stored_picture(item, camera, replan)
            if picture is not None:
                shown = read(server, name, f"pictures/{camera}/{replan}.png")
                np.testing.assert_array_equal(shown, picture)


def test_page_and_overlay_have_one_clock(server, places):
    """Steps after the waiting steps, which `env_step` counts too."""
    about = read(server, "joint", "about.json")
    result = va.open(places["joint"]).overlay(tasks=0, episode=0, replans=[0, 2])
    steps = {replan: start for replan, start in enumerate(about["starts"]) if replan in (0, 2)}
    assert steps[0] == 0
    assert dict(result["overlay"].select("replan", "step").iter_rows()) == steps
    assert set(result["overlay"]["env_step"]) == {about["env_step"][replan] for replan in steps}
    above = result.figures[0].frame.select("replan", "above").iter_rows()
    assert all(text.startswith(f"step {steps[replan]}") for replan, text in above)


def test_the_film_has_every_call(server):
    about = read(server, "joint", "about.json")
    reply = ask(server, f"runs/0/{about['name']}/film.gif")
    assert (reply.status, reply.headers["content-type"]) == (200, "image/gif")
    assert Image.open(io.BytesIO(reply.body)).n_frames == about["num_replans"]


def test_heads_of_a_selector(server, places):
    given = read(server, "joint", f"joint/grid.json?selector={quote('role:instruction')}")
    result = va.open(places["joint"]).analyze(groups={"words": "role:instruction"}, by=("layer", "head"), tasks=0)
    tables = {one.name: one for one in result.tables}
    cells = tables["steps_groups"].shown.filter(group="words").group_by("replan", "layer", "head")
    mass = cells.agg(pl.col("mass").mean()).sort("replan", "layer", "head")["mass"].to_numpy()
    np.testing.assert_allclose(numbers(given["mass"]).ravel(), mass, rtol=1e-6)
    lift = tables["by_groups"].shown.filter(group="words").sort("layer_number", "head")["lift"].to_numpy()
    np.testing.assert_allclose(numbers(given["lift"]).mean(axis=0).ravel(), lift, rtol=1e-4)


def test_targets_of_heads_are_selectors(server):
    about = read(server, "joint", "about.json")
    for number, target in enumerate(about["sites"]["joint"]["targets"]):
        own = read(server, "joint", f"joint/grid/{number}.json")
        assert own == read(server, "joint", f"joint/grid.json?selector={quote(target['selector'])}")
    assert number > 3


def of_run(server, layer: int, selector: str, first: int = 0) -> Any:
    query = f"site=joint&layer={layer}&selector={quote(selector)}&first={first}"
    return read_path(server, f"runs/{NAMES.index('steps')}/heads.json?{query}")


def test_a_head_over_the_run_is_what_the_grids_of_its_episodes_say(server, places, monkeypatch):
    monkeypatch.setattr(head_answers, "_AT_ONCE", 1)
    store = open_store(places["steps"])
    layer, names = store.attributes.recording.layer_labels[-1], [one.name for one in store.episodes]
    for selector in ("role:instruction", 'object:"plate_1"', "word:bowl"):
        found: dict[str, Any] = {}
        for first in range(len(names)):
            given = of_run(server, layer, selector, first)
            assert given["next"] == (first + 1 if first + 1 < len(names) else None)
            found |= {one["name"]: one for one in given["episodes"]}
        assert set(found) == set(names)
        for number, name in enumerate(names):
            grid = read(server, "steps", f"joint/grid.json?selector={quote(selector)}", number)
            expected = numbers(grid["lift"])[:, grid["layers"].index(layer)]
            np.testing.assert_allclose(numbers(found[name]["lift"]), expected, rtol=1e-6)
            np.testing.assert_allclose(numbers(found[name]["layer"]), expected.mean(axis=1), rtol=1e-4)
    things = [thing["name"] for thing in read(server, "steps", "about.json")["objects"] if thing["named"]]
    assert len(things) > 1
    same = of_run(server, layer, " | ".join(f'object:"{name}"' for name in things))
    assert of_run(server, layer, "named") == same
    assert of_run(server, layer, "word:nothing")["episodes"] == []


def test_what_heads_look_at_in_a_call_is_of_their_rows(server):
    about = read(server, "joint", "about.json")
    layer = read_path(server, "runs.json")["runs"][0]["sites"][0]["layers"][0]
    rows = read(server, "joint", f"joint/heads/{layer}.npy").mean(axis=1)[2]  # (head, key)
    even = read(server, "joint", f"joint/uniform/{layer}.npy").mean(axis=1)
    given, covered = read(server, "joint", f"joint/call/{layer}/2.json"), read(server, "joint", "joint/objects.json")
    for camera, how in about["sites"]["joint"]["cameras"].items():
        keys = np.array(how["keys"])[np.argsort(how["cells"])]
        np.testing.assert_allclose(
            numbers(given[camera]["lift"]), rows[:, keys] / even[min(2, len(even) - 1), keys], rtol=1e-4
        )
        things = [thing["name"] for thing in about["objects"] if thing["named"]]
        expected = {cell for name in things for cell in covered[camera].get(name, [[]] * 3)[2]}
        assert set(given[camera]["named"]) == expected


def test_where_heads_see_different_keys_each_is_beside_its_own_even_attention(server):
    about = read(server, "masks", "about.json")
    layer = read_path(server, "runs.json")["runs"][NAMES.index("masks")]["sites"][0]["layers"][0]
    given = read(server, "masks", f"joint/call/{layer}/0.json")
    for camera, how in about["sites"]["joint"]["cameras"].items():
        for key, cell in list(zip(how["keys"], how["cells"], strict=True))[:4]:
            grid = read(server, "masks", f"joint/grid.json?selector=keys:{key}-{key}")
            expected = numbers(grid["lift"])[0, grid["layers"].index(layer)]
            np.testing.assert_allclose(numbers(given[camera]["lift"])[:, cell], expected, rtol=1e-3)


def test_episodes_that_cannot_be_read_are_named_beside_the_others(places, tmp_path):
    broken = shutil.copytree(places["steps"], tmp_path / "broken.zarr")
    (broken / "episodes/task000_episode000/joint/key_role/c.0.0").unlink()
    with served(broken) as server:
        given = read_path(server, "runs/0/heads.json?site=joint&layer=0&selector=role:instruction&first=0")
    names = [one.name for one in open_store(broken).episodes]
    assert given["failed"] == ["task000_episode000"]
    assert [one["name"] for one in given["episodes"]] == [name for name in names if name != "task000_episode000"]


@pytest.mark.parametrize(
    "query",
    ["", "?site=joint&layer=0&selector=named", "?site=no&layer=0&selector=named&first=0",
     "?site=joint&layer=99&selector=named&first=0", "?site=joint&layer=0&selector=word:&first=0"],
)  # fmt: skip
def test_a_question_about_heads_that_has_no_answer_is_a_sentence(server, query):
    assert json.loads(ask(server, f"runs/0/heads.json{query}").body)["error"]


def test_keys_of_a_selector_and_what_is_wrong_with_one(server):
    about = read(server, "joint", "about.json")
    word = about["sites"]["joint"]["prompts"][0]["words"][1]
    given = read(server, "joint", f"joint/keys.json?selector={quote('word:' + word['text'])}")
    assert {key for key, weight in given["keys"][0] if weight == 1.0} >= set(word["keys"])
    for path in ("keys", "grid"):
        reply = ask(server, f"runs/0/task000_episode000/joint/{path}.json?selector=word:nothing")
        assert reply.status == 200  # another one is an error in the browser's console
        assert "'nothing'" in json.loads(reply.body)["error"]


def test_effects_are_those_of_the_command(server, places):
    given = read(server, "effects", "effects.json")["items"]
    table = va.open(places["effects"]).effects()["effects_episodes"].filter(task_id=0, episode_index=0)
    expected = {row["condition"]: row for row in table.iter_rows(named=True)}
    assert {one["condition"] for one in given} == set(expected)
    parts = [part["name"] for part in read(server, "effects", "effects.json")["parts"]]
    for one in given:
        row = expected[one["condition"]]
        assert (one["label"], one["reader"], one["lift"]) == (row["label"], row["reader"], row["lift"])
        assert one["noise"] == row["noise"]
        for part, mean, values in zip(parts, one["mean"], one["effect"], strict=True):
            assert mean == pytest.approx(row[part], rel=1e-6)
            assert np.mean([value for value in values if value is not None]) == pytest.approx(mean, rel=1e-9)
    episode = open_store(places["effects"]).episodes[0]
    changed = read(server, "effects", f"actions/{given[0]['number']}.npy")
    assert changed.shape == episode.read("actions").shape
    with np.errstate(invalid="ignore"):
        assert np.nanmax(np.abs(changed - episode.read("actions"))) > 0


def test_a_copy_has_the_actions_of_all_that_is_taken_away_or_exchanged(server, places):
    given = read(server, "effects", "effects.json")["items"]
    (effects,) = [one for one in server.stores if one.store.path == places["effects"]]
    copied = {address for address, _ in Answers().copied(effects, "task000_episode000", heads=False)}
    numbers = {one["number"] for one in given if one["kind"] in ("without", "prompt", "image")}
    assert numbers
    assert {f"actions/{number}.npy" for number in numbers} <= copied


def with_another_goal(spec, task, episode, steps):
    """The steps of a scene in which another task is about the plate."""
    made = small_steps(spec, task, episode, steps)
    other = TaskGoal(7, "push", "push the plate to the front", ("in front",), None, ("plate_1",))
    return replace(made, attributes=structs.replace(made.attributes, goals=(*made.attributes.goals, other)))


def test_another_sentence_names_the_objects_of_its_goal(tmp_path):
    for told, expected in (
        ("put the bowl on the plate", {"akita_black_bowl_1", "plate_1"}),  # the task's own
        ("push the plate to the front", {"plate_1"}),
        ("push the black bowl", set()),  # no goal of the scene
    ):
        spec = StoreSpec(tasks=(0,), episodes=1, tokens=bowl_tokens(instruction=told), plant_steps=with_another_goal)
        with served(write_store(tmp_path / f"{len(told)}.zarr", spec=spec)) as server:
            about = read_path(server, "runs/0/task000_episode000/about.json")
        assert {thing["name"] for thing in about["objects"] if thing["named"]} == expected
        heads = {target["name"] for target in about["sites"]["joint"]["targets"] if "(named)" in target["name"]}
        assert heads == {f"{name.replace('_', ' ')} (named)" for name in expected}


def test_what_happened(server):
    failed, solved = (read(server, "steps", "about.json", episode) for episode in (0, 1))
    assert re.search("akita black bowl 1 .*5", failed["verdict"])
    assert (failed["outcome"], solved["outcome"]) == (False, True)
    touches = [event for event in failed["events"] if event["kind"] == "touch"]
    assert (touches[0]["step"], touches[0]["text"]) == (5, "touches akita black bowl 1")
    assert failed["starts"][touches[0]["replan"]] <= 4
    assert [event["text"] for event in (failed["events"][-1], solved["events"][-1])] == ["not solved", "solved"]
    courses = failed["courses"]
    assert len(courses["places"][courses["hand"]]) == len(courses["executed"]) + 1
    rerun = read(server, "effects", "about.json")
    assert rerun["outcome"] is None


@pytest.mark.parametrize(
    ("commands", "steps"),
    [([1] * 6, []), ([-1, 1, 1, 1, -1, 1, 1, 1], [2, 6]), ([-1, 1, -1, 1, -1, -1], []), ([-1, -1, 0.2, 0.2, 1], [3])],
)
def test_the_gripper_closes_where_it_was_open_and_stays_closed(commands, steps):
    assert _closings(np.array(commands, float)) == steps


def test_covered_cells_are_those_of_the_coverage(server, places):
    episode = open_store(places["joint"]).episodes[0]
    given = read(server, "joint", "joint/objects.json")
    for camera, objects in given.items():
        coverage = episode.read(f"objects/{camera}")
        names = [thing.name for thing in episode.attributes.objects]
        for name, of_replans in objects.items():
            expected = (coverage[:, :, names.index(name)] >= 0.1).sum(axis=1)
            assert [len(cells) for cells in of_replans] == expected.tolist()
    assert given


@pytest.mark.parametrize(
    "path",
    ["runs/", "runs/0", "runs/9/task000_episode000/about.json", "runs/0/task009_episode000/about.json",
     "runs/0/task000_episode000/nothing.json", "runs/0/task000_episode000/joint/grid/99.json", "runs/x/y/about.json",
     "runs/0/task000_episode000/pictures/base_0_rgb/one.png", "runs/0/%2e%2e/about.json", "runs.json/x"],
)  # fmt: skip
def test_other_addresses_have_nothing(server, path):
    assert ask(server, path).status == 404


def test_an_episode_that_cannot_be_read_is_listed_with_the_reason(places, tmp_path):
    broken = shutil.copytree(places["joint"], tmp_path / "broken.zarr")
    (broken / "episodes/task000_episode000" / SEAL_FILE).write_text("{}")
    with served(broken) as server:
        lines = read_path(server, "runs.json")["runs"][0]["episodes"]
        reply = ask(server, "runs/0/task000_episode000/about.json")
    assert ["failed" in line for line in lines] == [True, False]
    assert "task000_episode000" in lines[0]["failed"]
    assert (reply.status, json.loads(reply.body)["error"]) == (422, lines[0]["failed"])


def test_the_run_says_what_the_commands_find(places):
    with served(places["steps"], summaries=True) as server:
        server.stores[0].summary.wait()
        given = read_path(server, "runs/0/numbers.json")
    said = {finding["sentence"] for finding in given["findings"]}
    assert {one.sentence for one in va.open(places["steps"]).failures().findings} <= said
    assert all(math.isfinite(row["ratio"]) for row in given["episodes"])


def test_an_episode_of_unknown_length_ends_behind_its_last_call(tmp_path):
    store = open_store(write_site_store(tmp_path / "a.zarr", episodes=1))
    about = ShownEpisode(store, store.episodes[0]).about()
    (end,) = about["events"]
    assert (end["kind"], end["replan"]) == ("end", len(about["starts"]) - 1)
    assert end["step"] == about["end"] > about["starts"][-1]
