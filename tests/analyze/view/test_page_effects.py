"""Effects on the page are those of `vla-attention effects`: by item, reader and replan, in the same units and words."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr

import vla_attention as va
from tests.analyze.view.page_answers import PageQuestion, needs_node, page_answers, run_in_node
from tests.kit.golden_stores import folder_of
from tests.kit.http_ranges import serve
from vla_attention.analyze.__main__ import main
from vla_attention.analyze.effects.answer import item_lines, noise_sentence
from vla_attention.analyze.effects.effect_study import study_effects, units_of_recorded
from vla_attention.analyze.effects.item_rows import item_rows
from vla_attention.analyze.measures.alignment import replan_starts, steps_of_time
from vla_attention.analyze.measures.question_settings import AnalysisSettings
from vla_attention.analyze.view.summary_process import summary_parts
from vla_attention.capture.store.replan_records import ReplanEffects
from vla_attention.schemas.groupings.vocabulary import EpisodeTokens
from vla_attention.schemas.interventions import Interventions, KeyKnockout, NoiseChange, Queries, queries_suffix
from vla_attention.schemas.stores.reader import open_store
from vla_attention.testing.stores import StoreSpec, small_effects, write_store

pytestmark = needs_node
#: Changes are float32, and Python adds them to the actions and takes them off again.
CLOSE = 1e-9
EPISODE = "task000_episode000"
Sizes = dict[str, tuple[float, float, float, float]]
READERS: dict[str, tuple[Queries, str]] = {
    "total": ("all", ""),
    "direct": ("action", ""),
    "pictures": ("prefix", "role:image"),
    "text": ("prefix", "role:state"),
}


def answers_of(stores: Sequence[Path], packed: Sequence[bool] = (), **given: Any) -> list[Any]:
    """What the page shows of each store's first episode; `units`, if given, replace those that Python computes."""
    folder = stores[0].parent
    names = []
    for store in stores:
        if "units" in given:
            of_store = {"effect_units": given["units"]}
        else:
            of_store = next((part for part in summary_parts(open_store(store)) if "effect_units" in part), {})
        names.append(f"{store.name}.summary.json")
        (folder / names[-1]).write_text(json.dumps({"complete": True, "episodes": [], **of_store}))
    with serve(folder) as served:
        questions = [
            PageQuestion(f"{served.url}/", f"{store.name}/", packed=one, summary=f"{served.url}/{name}")
            for store, name, one in zip(stores, names, packed or [False] * len(stores), strict=True)
        ]
        return page_answers(folder, questions)


@pytest.fixture(scope="module")
def golden(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The golden store with effects of words and objects for all readers; one dimension of it is mostly noise."""
    folder = tmp_path_factory.mktemp("golden")
    shutil.copytree(folder_of(2) / "effects.zarr", folder / "effects.zarr")
    return folder / "effects.zarr"


@pytest.fixture(scope="module")
def found(golden: Path) -> list[Any]:
    """The page's effects of the golden store, of it packed, and of a store without effects."""
    packed = golden.with_name("packed.zarr")
    assert main(["copy", str(golden), str(packed), "--packed"]) == 0
    shutil.copytree(folder_of(2) / "joint.zarr", golden.with_name("joint.zarr"))
    stores = [golden, packed, golden.with_name("joint.zarr")]
    return [answer["effects"] for answer in answers_of(stores, [False, True, False])]


def test_means_of_the_episode_are_pythons(found, golden):
    study = study_effects(golden, (), AnalysisSettings())
    table = va.open(golden).effects(table="episodes").filter(phase="all", task_id=0, episode_index=0)
    effect = {row["condition"]: row for row in table.iter_rows(named=True)}
    of_episode = 0
    for item in item_rows(study):
        for reader, row in item.by_reader.items():
            if row["condition"] in effect:  # the others are of words that only the other episode has
                mean, low, high, count = found[0]["items"][item.name][reader]["mean"]
                assert mean == pytest.approx(effect[row["condition"]]["effect"], rel=CLOSE), row["condition"]
                assert low <= mean <= high
                assert count == effect[row["condition"]]["num_replans"]
                of_episode += 1
    assert of_episode == sum(len(readers) for readers in found[0]["items"].values()) > 20
    assert found[0]["noise"]["mean"][0] == pytest.approx(effect["noise"]["effect"], rel=CLOSE)
    random = [row for name, row in effect.items() if name.startswith("random_") and "_queries_" not in name]
    shown = sorted(readers["direct"]["mean"][0] for readers in found[0]["random"].values())
    np.testing.assert_allclose(shown, sorted(row["effect"] for row in random), rtol=CLOSE)


def test_each_replan_has_its_own_from_the_raw_arrays(found, golden):
    store = open_store(golden)
    units = units_of_recorded(store)
    assert not units.used.all()  # else the test would not see that a dimension is left out
    attributes = store.episodes[0].attributes
    effects, change = attributes.effects, store.episodes[0].read("effects/change")
    steps = np.minimum(np.diff([*attributes.env_step, attributes.num_steps + store.attributes.protocol.wait_steps]), 5)
    names = [condition.name for condition in effects.conditions]
    for name, item, reader in (
        ("without_state", "state", "direct"),
        ("without_word_lift_queries_all", "'lift'", "total"),
    ):
        shown = [*found[0]["items"][item][reader]["replans"]]
        for entry, replan in enumerate(effects.replan):
            if names[effects.condition[entry]] == name:
                squares = [
                    (float(value) * effects.units[i] / units.spread[i]) ** 2
                    for step in range(steps[replan])
                    for i, value in enumerate(change[entry, step])
                    if units.used[i]
                ]
                assert shown[replan] == pytest.approx(np.sqrt(np.mean(squares)), rel=CLOSE)
                shown[replan] = None
        assert all(value in (None, "NaN") for value in shown)


def test_a_packed_store_has_the_same_and_a_store_without_effects_none(found):
    assert found[1] == found[0]
    assert found[2] is None


def test_a_replan_without_an_entry_has_no_number(tmp_path):
    store = write_store(tmp_path / "a.zarr", spec=StoreSpec(tasks=(0,), episodes=1, plant_effects=small_effects))
    (answer,) = answers_of([store])
    random = answer["effects"]["random"]["instruction"]["direct"]
    assert [value == "NaN" for value in random["replans"]] == [False, True, False]
    assert random["mean"][0] == pytest.approx(np.mean([random["replans"][0], random["replans"][2]]), rel=CLOSE)
    assert random["mean"][3] == 2
    assert answer["effects"]["unchanged"]["mean"][:3] == [0, 0, 0]
    assert answer["effects"]["sentences"] == ["", ""]  # no word was measured


def planted(sizes: Sizes, task: int, episode: int, replan: int, tokens: EpisodeTokens) -> ReplanEffects:
    """`PlantEffects` of words: sizes by reader, in the order of `READERS`; `noise` has one."""
    conditions = [Interventions("noise", noise=NoiseChange(1))]
    changes = [sizes["noise"][0]]
    for word in (name for name in sizes if name != "noise"):
        for (queries, of), size in zip(READERS.values(), sizes[word], strict=True):
            knockout = KeyKnockout(f'word:"{word}"', queries=queries, query_selector=of)
            conditions.append(Interventions(f"without_word_{word}{queries_suffix(queries, of)}", keys=(knockout,)))
            changes.append(size)
    change = np.random.default_rng([task, episode, replan]).normal(size=(1, 5, 7)) * np.array(changes)[:, None, None]
    cut = np.ones((len(changes), tokens.layout.num_keys), np.float32)
    measured = tuple(range(len(changes)))
    return ReplanEffects(tuple(conditions), (1.0,) * 7, measured, change.astype(np.float32), {"joint": cut})


NOISE = (0.1, 0.0, 0.0, 0.0)
#: Sizes by reader of some words of 'put the bowl on the plate'.
WAYS: dict[str, Sizes] = {
    "themselves": {
        "noise": (0.65, 0, 0, 0),
        "bowl": (1, 0.9, 0.1, 0.1),
        "put": (0.7, 0.6, 0, 0),
        "plate": (0.6, 0.6, 0, 0),  # large, and below the floor
        "the": (0.05, 0.05, 0, 0),
    },
    "through the pictures": {
        "noise": NOISE,
        "bowl": (0.9, 0.03, 0.9, 0.1),
        "plate": (0.5, 0.1, 0.4, 0),
        "put": (0.3, 0, 0, 0),
    },
    "other ways": {
        "noise": NOISE,
        "bowl": (0.9, 0.03, 0.1, 0.7),
        "plate": (0.6, 0.5, 0.1, 0),
        "on": (0.8, 0.1, 0.8, 0),
    },
}


@pytest.mark.parametrize("way", WAYS)
def test_which_word_decides_and_by_which_way_is_pythons_sentence(tmp_path, way):
    spec = StoreSpec(tasks=(0,), episodes=1, plant_effects=partial(planted, WAYS[way]))
    store = write_store(tmp_path / "a.zarr", spec=spec)
    (answer,) = answers_of([store])
    study = study_effects(store, (), AnalysisSettings())
    expected = f"{item_lines(study, item_rows(study))[0]} {noise_sentence(study)}"
    sentence, here = answer["effects"]["sentences"]
    assert re.sub(r" \(mean of 3 replans, [0-9.]+ to [0-9.]+\)", "", sentence, count=1) == expected
    assert sentence != expected
    assert way.split()[0] in sentence
    assert here.startswith(f"'bowl' has the largest effect of {len(WAYS[way]) - 1} words at this replan: without it")
    assert [word["below"] for word in answer["effects"]["words"]].count(True) == 3 * (way == "themselves")


def test_words_below_the_floor_decide_nothing(tmp_path):
    sizes: Sizes = {"noise": (1.0, 0, 0, 0), "bowl": (0.5, 0.5, 0, 0), "put": (0.25, 0, 0, 0)}
    spec = StoreSpec(tasks=(0,), episodes=1, plant_effects=partial(planted, sizes))
    (answer,) = answers_of([write_store(tmp_path / "a.zarr", spec=spec)])
    sentence, _ = answer["effects"]["sentences"]
    noise, bowl = (answer["effects"]["noise"]["mean"][0], answer["effects"]["items"]["'bowl'"]["total"]["mean"][0])
    assert noise == pytest.approx(2 * bowl, rel=1e-6)
    assert sentence.startswith(
        f"No word has an effect above the noise floor: another noise seed changes the action by {noise:.3f} of its "
        f"spread, and the largest of 2 words, 'bowl', by {bowl:.3f} (mean of 3 replans, "
    )
    put, the, bowl_word, *_ = answer["effects"]["words"]
    assert [put["below"], bowl_word["below"], the["below"]] == [True, True, False]
    assert f"below the noise floor of {noise:.3f}" in bowl_word["said"]
    assert the["said"] == "no effect was measured"


Changed = Callable[[dict[str, Any]], Any]
#: Wrong attributes, and what the page says; NaN and infinities are what JSON of others may hold.
WRONG: dict[str, tuple[Changed, str]] = {
    "replan out of range": (lambda e: e["replan"].__setitem__(-1, 3), "effects.replan[13] is 3"),
    "condition out of range": (lambda e: e["condition"].__setitem__(0, 5), "effects.condition[0] is 5"),
    "negative": (lambda e: e["replan"].__setitem__(0, -1), "effects.replan[0] is -1"),
    "one list longer": (lambda e: e["replan"].append(2), "are not in order, or name"),
    "twice": (lambda e: e["condition"].__setitem__(1, 0), "are not in order, or name"),
    "too few entries": (lambda e: (e["replan"].pop(), e["condition"].pop()), "effects/change has the shape (14, 5, 7)"),
    "units too long": (lambda e: e["units"].append(1.0), "8 units"),
    "units no numbers": (lambda e: e["units"].__setitem__(0, None), "effects.units[0] is null"),
    "units endless": (lambda e: e["units"].__setitem__(0, "ENDLESS"), "effects.units[0] is null"),
    "NaN": (lambda e: e["units"].__setitem__(0, float("nan")), "is no JSON"),
    "no list": (lambda e: e.__setitem__("conditions", {}), "effects.conditions is {}"),
    "too many": (lambda e: e.__setitem__("conditions", e["conditions"] * 3000), "is a list of 15000"),
    "no effects": (lambda e: e.clear(), "effects.conditions is nothing"),
    "readers": (lambda e: e["conditions"][2]["keys"][0].__setitem__("queries", "nobody"), 'queries is "nobody"'),
}


def test_wrong_effects_are_a_sentence_and_no_numbers(tmp_path):
    spec = StoreSpec(tasks=(0,), episodes=1, plant_effects=small_effects)
    stores = []
    for i, (change, _) in enumerate(WRONG.values()):
        stores.append(write_store(tmp_path / f"{i}.zarr", spec=spec))
        file = stores[-1] / f"episodes/{EPISODE}/zarr.json"
        document = json.loads(file.read_text())
        change(document["attributes"]["effects"])
        file.write_text(json.dumps(document).replace('"ENDLESS"', "1e999"))
    # With the units of the whole store, as if another episode's attributes were wrong.
    for (name, (_, sentence)), answer in zip(
        WRONG.items(), answers_of(stores, units={"spread": [1.0] * 7}), strict=True
    ):
        said = answer.get("failure") or answer["effects"].get("note", "")
        assert sentence in said, (name, said)
        assert answer.get("told", True), name
        assert said.isprintable()


@pytest.mark.parametrize(
    ("units", "sentence"),
    [
        ({"failed": "Episode 3 is damaged."}, "Effects are not shown: Episode 3 is damaged."),
        ({"spread": [1.0] * 6}, "the store has units of 6 dimensions, its actions 7."),
        ({"spread": [0.0] * 7}, "The spread of the actions is not above 0."),
        ({}, "effect_units.spread is nothing; expected a list"),
        (None, "has no units of effects: make the site or start the server anew."),
    ],
)
def test_without_units_there_is_a_sentence_and_attention(tmp_path, units, sentence):
    spec = StoreSpec(tasks=(0,), episodes=1, plant_effects=small_effects)
    (answer,) = answers_of([write_store(tmp_path / "a.zarr", spec=spec)], units=units)
    assert sentence in answer["effects"]["note"]
    assert answer["effects"]["waiting"] is False
    assert answer["words"][0]["lift"] > 0


def test_a_change_that_is_no_number_was_not_measured(tmp_path):
    spec = StoreSpec(tasks=(0,), episodes=1, plant_effects=small_effects)
    store = write_store(tmp_path / "a.zarr", spec=spec)
    change = zarr.open_group(store, mode="r+")[f"episodes/{EPISODE}/effects/change"]
    assert isinstance(change, zarr.Array)
    for entry, value in ((2, np.nan), (7, np.inf), (11, -np.inf)):  # nobody reads the instruction, at each replan
        change[entry, 4, 6] = value
    (answer,) = answers_of([store], units={"spread": [1.0] * 6 + [None]})
    (readers,) = answer["effects"]["items"].values()
    assert set(readers) == {"direct"}
    assert np.isfinite(readers["direct"]["replans"]).all()


def test_as_many_steps_count_as_were_executed(tmp_path):
    """`BaseEpisode.of`: of our loops, of those of others, of data sets, and where nobody knows when it ended."""
    cases: list[dict[str, Any]] = []
    expected = []
    for name, replan_steps, wait, steps, total in (
        ("openpi", 5, 10, [10, 15, 20], 14),
        ("openpi", 5, 10, [10, 12, 20], 30),
        ("lerobot", 10, 0, [0, 10], 11),
        ("recorded", 8, 0, [3, 7, 20], 30),
        ("recorded", 8, 0, [3, 7, 20, 22], 0),
        ("recorded", 8, 0, [3, 7, 20], 5),
        ("recorded", 4, 0, [9], 0),
        ("recorded", 0, 0, [9, 11], 40),
        ("dataset", 4, 0, [0, 4, 8], 12),
    ):
        cases.append({"name": name, "replan_steps": replan_steps, "wait": wait, "steps": steps, "total": total})
        if name == "dataset" or not replan_steps:
            expected.append([6] * len(steps))
            continue
        starts, end = (
            steps_of_time(np.array(steps), total, replan_steps)
            if name == "recorded"
            else (replan_starts(np.array(steps), wait, total, name), total)
        )
        expected.append([min(6, replan_steps, int(n)) for n in np.diff([*starts, end])])
    assert json.loads(run_in_node("page_executed.mjs", tmp_path, cases)) == expected


def test_an_effect_in_one_dimension_is_said(tmp_path):
    """As `mostly_one_dimension` of analyze/effects/answer.py."""

    def in_the_last(task: int, episode: int, replan: int, tokens: EpisodeTokens) -> ReplanEffects:
        sizes: Sizes = {"noise": (0.1, 0, 0, 0), "bowl": (5.0, 5.0, 0, 0), "put": (1.0, 0, 0, 0)}
        given = planted(sizes, task, episode, replan, tokens)
        change = given.change.copy()
        for row, number in zip(change, given.measured, strict=True):
            if "word_bowl" in given.conditions[number].name:
                row[:, :-1] = 0.0
        return replace(given, change=change)

    store = write_store(tmp_path / "a.zarr", spec=StoreSpec(tasks=(0,), episodes=1, plant_effects=in_the_last))
    (answer,) = answers_of([store])
    sentence, _ = answer["effects"]["sentences"]
    study = study_effects(store, [], AnalysisSettings())
    said = "Of the effect of 'bowl' in this episode, 100% is dimension 6 of the action, whose spread in the store is "
    assert f"{said}{study.spread.spread[6]:.3f}." in sentence
