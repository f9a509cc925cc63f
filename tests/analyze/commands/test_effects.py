"""`effects` on planted changes: their sizes, the attention beside them, and what is said of them."""

from __future__ import annotations

import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest
import zarr
from polars.testing import assert_frame_equal

import vla_attention as va
from tests.kit.planted_effects import FIRST, ITEMS, READERS, WORDS, planted_effects
from tests.kit.questions import question_about
from tests.kit.site_stores import write_site_store
from tests.kit.stores import StoreSpec, expected_arrays, write_store
from tests.kit.tokens import INSTRUCTIONS
from vla_attention.analyze.__main__ import main
from vla_attention.analyze.commands.effects import effects, word_effects
from vla_attention.analyze.commands.effects.items import WITHOUT_NOISE
from vla_attention.schemas.layout import Role

REPLANS = 4
SPEC = StoreSpec(tasks=(0, 1, 2), episodes=4, replans=REPLANS, contributions=True, mantissa_bits=23)
FEW = replace(SPEC, episodes=2)
NAME_OF = {"visual": "all pictures", "linguistic": "all text"}


def scale(name: str, task: int, episode: int, replan: int) -> float:
    """Planted: words matter at the first replans; episodes and tasks differ a little."""
    own = 1.0 + 0.05 * ((task + 2 * episode) % 3)
    return own * (1.0 - 0.2 * replan if "word_" in name else 1.0)


@pytest.fixture(scope="module")
def store(tmp_path_factory) -> Path:
    spec = replace(SPEC, plant_effects=planted_effects(scale))
    return write_store(tmp_path_factory.mktemp("effects") / "a.zarr", spec=spec)


@pytest.fixture(scope="module")
def result(store):
    return effects(question_about(store, intervals="these-tasks"))


def test_every_replan_has_the_effect_of_the_raw_arrays(store, result):
    """In the policy's units. The last chunk of an episode of odd number is executed for one step less."""
    expected, flips = {}, {}
    for name, group in zarr.open_group(store, mode="r")["episodes"].groups():
        recorded, actions = group.attrs["effects"], group["actions"][:]
        executed = [5] * (REPLANS - 1) + [group.attrs["num_steps"] - 5 * (REPLANS - 1)]
        for entry, (replan, number) in enumerate(zip(recorded["replan"], recorded["condition"], strict=True)):
            change, key = group["effects/change"][entry], (name, replan, recorded["conditions"][number]["name"])
            expected[key] = np.sqrt((change[: executed[replan], :6] ** 2).mean())
            grip = actions[replan, : executed[replan], 6]
            flips[key] = (grip * (grip + 3.0 * change[: executed[replan], 6]) < 0).mean()
    rows = result["effects"]
    for column, values in (("effect", expected), ("gripper", flips)):
        names = rows.select(
            pl.format("task00{}_episode00{}", "task_id", "episode_index"), "replan", "condition", column
        )
        found = {tuple(key): value for *key, value in names.iter_rows()}
        assert found == pytest.approx({key: one for key, one in values.items() if key[2] != "unchanged"}, rel=1e-6)
    assert set(rows.filter(kind="without")["reader"]) == set(READERS)


def test_items_have_the_planted_sizes_by_reader(store, result):
    rows = {row["label"]: row for row in result["effects_items"].iter_rows(named=True)}
    of_task = [np.mean([1.0 + 0.05 * ((task + 2 * episode) % 3) for episode in range(4)]) for task in range(3)]
    for name, (_, sizes) in ITEMS.items():
        word = name.removeprefix("word_")
        row = rows[f"'{word}'" if word in WORDS else NAME_OF[name]]
        having = [task for task in range(3) if word not in WORDS or word in INSTRUCTIONS[task].split()]
        assert row["num_episodes"] == 4 * len(having)
        factor = np.mean([of_task[task] for task in having])
        factor *= np.mean([1.0 - 0.2 * replan for replan in range(REPLANS)]) if word in WORDS else 1.0
        for reader, size in sizes.items():
            assert row[reader] == pytest.approx(factor * size, rel=1e-6), (name, reader)
    ratio = next(finding for finding in result.findings if finding.asks == "Pictures or text?")
    assert ratio.numbers["estimate"] == pytest.approx(2.0)


def test_attention_is_that_of_the_same_replans(store, result):
    """From the raw rows; heads, layers and denoise steps are averaged first."""
    arrays = expected_arrays(SPEC, 1, 0)
    rows, roles = arrays["joint/rows"].mean(axis=(1, 2, 3, 4)), arrays["joint/key_role"]
    valid = ~np.isin(roles, [Role.MASKED_IMAGE, Role.PADDING, Role.NULL])
    image = roles == Role.IMAGE
    mass = (rows * image).sum(axis=1)
    lift = mass / image.sum(axis=1) / ((rows * valid).sum(axis=1) / valid.sum(axis=1))
    found = result["effects"].filter(label="all pictures", reader="total", task_id=1, episode_index=0)
    np.testing.assert_allclose(found["mass"], mass, rtol=1e-4)
    np.testing.assert_allclose(found["lift"], lift, rtol=1e-4)
    assert (found["norm"] > 0).all()
    words = result["effects"].filter(item_kind="word", kind="without")
    assert words["lift"].null_count() == 0
    assert words["norm"].null_count() == words.height  # a word is a part of a segment


def test_the_word_that_matters_is_said_first_and_those_below_the_noise(store, result):
    first = result.findings[0]
    assert re.findall("'([^']*)'", first.sentence)[0] == FIRST
    shown = result["effects_items"].filter(item_kind="word", kind="without")
    less = shown.filter(than_noise="less")
    assert less["total"].max() is None or less["total"].max() < shown["noise"].max()
    of_words, tables = word_effects(question_about(store, intervals="these-tasks"))
    assert of_words == [first]
    assert tables[0].frame.filter(pl.col("kind") != "noise")["total"].to_list() == shown["total"].to_list()


def test_an_effect_below_another_noise_seed_is_said_to_be_smaller(tmp_path):
    plant = planted_effects(lambda name, *where: 60.0 * scale(name, *where) if name == "noise" else scale(name, *where))
    result = effects(question_about(write_store(tmp_path / "a.zarr", spec=replace(FEW, plant_effects=plant))))
    assert set(result["effects_items"].filter(pl.col("kind") != "noise")["than_noise"]) == {"less"}
    assert result.findings[0].numbers["shown"] == 0


def test_without_other_noise_no_effect_is_called_noise(tmp_path):
    """As of a policy that draws none."""
    plant = planted_effects(exchanged=True, noise=False)
    result = effects(question_about(write_store(tmp_path / "a.zarr", spec=replace(FEW, plant_effects=plant))))
    apart, missing = result.findings[:2]
    assert apart.numbers["noise"] is None
    for finding in (apart, missing):
        assert finding.numbers["estimate"] > 0
        assert WITHOUT_NOISE in finding.limit
        assert "noise" not in finding.sentence


def changed(make):
    """The planted effects, with what `make` does to those of a replan."""

    def plant(task, episode, replan, tokens):
        return make(planted_effects(scale)(task, episode, replan, tokens))

    return plant


def gripper_alone(given):
    change = given.change.copy()
    for row, number in zip(change, given.measured, strict=True):
        if (given.items[number].change, given.items[number].name) == ("without", FIRST):
            row[:, :-1] = 0.0
            row[:, -1] *= 9.0
    return replace(given, change=change)


def without_the_first_word(given):
    kept = [i for i, n in enumerate(given.measured) if given.items[n].name != FIRST]
    cut = {site: rows[kept] for site, rows in given.cut.items()}
    return replace(given, measured=tuple(given.measured[i] for i in kept), change=given.change[kept], cut=cut)


def unlike(given):
    """The unchanged call is 0.3 of a unit from the executed one, in one replan of all."""
    change = given.change.copy()
    change[given.measured.index(0)] = 0.1
    return replace(given, change=change)


def test_a_word_whose_effect_is_the_grippers_is_told_apart(tmp_path):
    spec = replace(SPEC, plant_effects=changed(gripper_alone))
    result = effects(question_about(write_store(tmp_path / "a.zarr", spec=spec), intervals="these-tasks"))
    row = result["effects_items"].filter(item=FIRST, kind="without").row(0, named=True)
    assert row["effect"] == 0.0
    assert row["gripper"] > 0.4
    assert row["than_noise"] == "the gripper's is"
    assert result.findings[0].numbers["word"] != FIRST


def test_a_word_that_was_not_tested_is_no_word_without_an_effect(tmp_path):
    spec = replace(FEW, plant_effects=changed(without_the_first_word))
    result = effects(question_about(write_store(tmp_path / "a.zarr", spec=spec), intervals="these-tasks"))
    row = result["effects_items"].filter(item=FIRST).row(0, named=True)
    assert (row["than_noise"], row["effect"]) == ("not tested", None)
    assert "1 word" in result.findings[0].limit


def test_what_unchanged_calls_differ_by_is_noted(tmp_path):
    spec = replace(FEW, plant_effects=changed(unlike))
    result = effects(question_about(write_store(tmp_path / "a.zarr", spec=spec)))
    assert "made again" in result.notes[0]


def test_nothing_recorded_names_the_next_command(tmp_path, capsys):
    path = write_store(tmp_path / "plain.zarr")
    assert main(["effects", str(path), "--output", str(tmp_path / "out")]) == 2
    assert f"vla-attention capture rerun {path} --effects text,cameras" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_the_units_are_those_of_all_episodes(store, result):
    some = effects(question_about(store, tasks=(1,)))["effects"]
    assert_frame_equal(some, result["effects"].filter(task_id=1), rel_tol=1e-6)


def test_episodes_in_two_stores_in_any_order_are_the_same(store, tmp_path, result):
    for name, left in (("one", 0), ("two", 1)):
        shutil.copytree(store, tmp_path / f"{name}.zarr")
        for episode in (tmp_path / f"{name}.zarr/episodes").glob("task*"):
            if (int(episode.name[-1]) % 2) == left:
                shutil.rmtree(episode)
    names = ["total", "total_low", "total_high", "lift", "noise", "q"]
    for order in (("one", "two"), ("two", "one")):
        run = va.open([tmp_path / f"{name}.zarr" for name in order])
        table = run.effects(intervals="these-tasks")["effects_items"]
        np.testing.assert_allclose(
            table.sort("condition").select(names).to_numpy(),
            result["effects_items"].sort("condition").select(names).to_numpy(),
            rtol=1e-9,
        )


def test_a_damaged_episode_is_named_and_can_be_left_out(store, tmp_path, capsys):
    broken = tmp_path / "broken.zarr"
    shutil.copytree(store, broken)
    array = broken / "episodes/task002_episode003/effects/change"
    (chunk,) = [file for file in array.rglob("*") if file.is_file() and file.name != "zarr.json"]
    content = bytearray(chunk.read_bytes())
    content[len(content) // 2] ^= 1
    chunk.write_bytes(content)
    given = ["effects", str(broken), "--no-plots", "--output", str(tmp_path / "out")]
    assert main(given) == 2
    assert "task002_episode003" in capsys.readouterr().err
    assert main([*given, "--skip-corrupt"]) == 0
    rows = pl.read_parquet(tmp_path / "out" / "effects.parquet")
    assert rows.filter(task_id=2)["episode_index"].unique().sort().to_list() == [0, 1, 2]


def test_effects_over_time_are_means_of_its_parts(result):
    rows = result["effects"].filter(item=FIRST, kind="without", reader="total", episode_index=0)
    course = result["effects_time"].filter(item=FIRST)
    assert course.height == 10
    assert (course["effect"].diff().drop_nulls() <= 1e-9).all()
    everything = result["effects"].filter(item=FIRST, kind="without", reader="total", replan=0)["effect"].mean()
    assert course["effect"][0] == pytest.approx(everything)
    assert rows["begin"].to_list() == [0.0, 0.25, 0.5, 0.75]


def test_a_row_for_each_task_or_replan(store, result):
    question = question_about(store, intervals="these-tasks")
    for axis, column in (("task", "task_id"), ("replan", "replan")):
        table = effects(question, by=[axis])["effects_summary"].filter(condition="noise")
        of_axis = result["effects"].filter(condition="noise").group_by(column).agg(pl.col("effect").mean()).sort(column)
        assert table.sort(column)["effect"].to_list() == pytest.approx(of_axis["effect"].to_list())


def test_the_deviation_from_a_data_set_is_that_of_the_raw_arrays(tmp_path):
    path = write_site_store(tmp_path / "a.zarr", protocol="dataset", dataset_actions=0.5, replans=6)
    result = effects(question_about(path))
    episodes = {
        name: (group["actions"][:], group["dataset_actions"][:], np.array(group.attrs["dataset_action_count"]))
        for name, group in zarr.open_group(path, mode="r")["episodes"].groups()
    }
    steps = [chunk[:n] for _, data, counts in episodes.values() for chunk, n in zip(data, counts, strict=True)]
    unit, first = np.concatenate(steps).std(axis=0), []
    for name, (actions, data, counts) in episodes.items():
        rows = result["deviation_replans"].filter(task_id=int(name[4:7]), episode_index=int(name[-3:]))
        for replan, row in enumerate(rows.iter_rows(named=True)):
            scaled = (actions[replan, : counts[replan]] - data[replan, : counts[replan]]) / unit
            assert row["steps"] == counts[replan]
            assert row["first"] == pytest.approx(np.sqrt((scaled[0] ** 2).mean()))
            assert row["chunk"] == pytest.approx(np.sqrt((scaled**2).mean()))
        first.append(rows["first"].mean())
    whole = result["deviation"].filter(scope="all").row(0, named=True)
    assert (whole["first"], whole["num_episodes"]) == (pytest.approx(np.mean(first)), 6)
    assert result.findings[0].asks == "How far from the data set's actions?"


def test_the_units_are_those_of_the_whole_store_with_and_without_damaged_episodes(tmp_path):
    path = write_site_store(tmp_path / "a.zarr", protocol="dataset", dataset_actions=0.5, replans=6)
    every = effects(question_about(path))["deviation_replans"]
    for settings in ({"tasks": (0,)}, {"tasks": (0,), "skip_corrupt": True}):
        one = effects(question_about(path, **settings))["deviation_replans"]
        assert_frame_equal(one, every.filter(task_id=0))


def test_a_word_whose_exchange_does_nothing_is_named_nowhere(tmp_path):
    """Of planted words that all move the action where they are missing, one does not where it is exchanged."""
    plant = planted_effects(
        lambda name, *where: scale(name, *where) * (1e-6 if name == f"exchange_word_{FIRST}" else 1.0), exchanged=True
    )
    path = write_store(tmp_path / "a.zarr", spec=replace(SPEC, plant_effects=plant))
    result = effects(question_about(path, intervals="these-tasks"))
    rows = result["effects_items"].filter(item_kind="word", kind="without")
    sides = dict(rows.select("item", "than_noise").iter_rows())
    assert sides.pop(FIRST) == "more, but not with another word"
    alone = WORDS[-1]  # the last word is exchanged for none
    assert {word for word, side in sides.items() if side == "more"} >= {alone}
    assert result.findings[0].asks == "Does it tell words apart?"
    for finding in result.findings[1:]:
        assert f"'{FIRST}'" not in finding.sentence
    deciding = next(one for one in result.findings if one.asks == "What if a word is left out?")
    assert {f"'{FIRST}'", f"'{alone}'"} <= set(re.findall("'[^']*'", deciding.limit))
