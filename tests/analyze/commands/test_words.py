"""Words against arithmetic on raw Zarr arrays, a planted reader, and the command."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import polars as pl
import pytest
import zarr

from tests.kit.archives import example_store
from tests.kit.bowl_scene import write_bowl_store
from tests.kit.questions import question_about
from tests.kit.raw_rows import probabilities
from tests.kit.stores import write_store
from tests.kit.tokens import random_rows
from vla_attention.analyze.__main__ import main
from vla_attention.analyze.commands.language import language
from vla_attention.analyze.commands.words import words
from vla_attention.analyze.statistics.many_looks import SHOWN_AT
from vla_attention.schemas.groupings.vocabulary import EpisodeTokens
from vla_attention.schemas.layout import Role
from vla_attention.schemas.precision import mass_error_bound

AVERAGE = pl.col("layer") == "layers_avg"


def read_bowl(task: int, episode: int, tokens: EpisodeTokens, rows: np.ndarray) -> np.ndarray:
    """Head 1 of the last layer reads 'bowl', twenty times as much as anything else."""
    rows = random_rows(tokens, rows.shape[1:-1], seed=10 * task + episode, spread=0.5)
    for replan, which in enumerate(tokens.prompt_index):
        keys = next(word.keys for word in tokens.words[which] if word.text == "bowl")
        rows[replan, -1, :, 1][..., list(keys)] *= 20
    return rows / rows.sum(axis=-1, keepdims=True)


@pytest.fixture(scope="module")
def reader_store(tmp_path_factory) -> Path:
    return write_bowl_store(tmp_path_factory.mktemp("words") / "reader.zarr", plant_rows=read_bowl)


def raw_measures(path: Path, name: str, layer: int) -> dict[tuple[str, int], tuple[float, float, float, float]]:
    """(word, place) to tokens, mass, lift and share by loops over replans, with the instruction's characters found
    anew.
    """
    episode = zarr.open_group(path / "episodes" / name, mode="r")
    rows = probabilities(episode["joint/rows"]).astype(np.float64).mean(axis=(2, 3, 4))  # (replan, layer, key)
    roles, index = episode["joint/key_role"][:], episode.attrs["prompt_index"]
    collected: dict[tuple[str, int], list[tuple[float, float, float, float]]] = {}
    for replan, row in enumerate(rows[:, layer]):
        prompt = episode.attrs["prompts"][int(index[replan])]
        valid = ~np.isin(roles[replan], [Role.MASKED_IMAGE, Role.PADDING, Role.NULL])
        language = np.isin(roles[replan], [Role.BOS, Role.TEMPLATE, Role.INSTRUCTION, Role.TEXT])
        place = prompt["instruction"][0]
        for i, word in enumerate(prompt["text"][slice(*prompt["instruction"])].split()):
            characters = set(range(place, place + len(word)))
            keys = [p["key"] for p in prompt["pieces"] if characters & set(range(p["start"], p["stop"]))]
            mass = row[keys].sum()
            lift = mass / len(keys) / (row[valid].sum() / valid.sum())
            collected.setdefault((word, i), []).append((len(keys), mass, lift, mass / row[language].sum()))
            place += len(word) + 1
    return {key: tuple(np.mean(values, axis=0)) for key, values in collected.items()}


def test_words_equal_sums_over_raw_rows(reader_store):
    table = words(question_about(reader_store))["words_episodes"]
    for task, episode in ((0, 0), (1, 1)):
        own = table.filter(layer="3", kind="place", task_id=task, episode_index=episode)
        wanted = raw_measures(reader_store, f"task{task:03d}_episode{episode:03d}", layer=2)
        assert set(zip(own["item"], own["place"], strict=True)) == set(wanted)
        for row in own.iter_rows(named=True):
            numbers = [row["keys"], row["mass"], row["lift"], row["share"]]
            np.testing.assert_allclose(numbers, wanted[row["item"], row["place"]], rtol=4 * mass_error_bound(10))


def test_places_and_classes_add_up(reader_store):
    table = words(question_about(reader_store))["words_episodes"].filter(AVERAGE)
    keys = ["task_id", "episode_index"]
    places = table.filter(kind="place")
    by_word = places.group_by(*keys, "item").agg(pl.col("mass", "keys").sum())
    joined = table.filter(kind="word").join(by_word, on=[*keys, "item"], suffix="_sum")
    np.testing.assert_allclose(joined["mass"], joined["mass_sum"], rtol=1e-6)
    assert joined["keys"].to_list() == joined["keys_sum"].to_list()
    for kind in ("content", "stop"):
        of_class = table.filter(kind="word", word_class=kind).group_by(keys).agg(pl.col("mass").sum())
        whole = table.filter(item=f"{kind} words").join(of_class, on=keys, suffix="_sum")
        np.testing.assert_allclose(whole["mass"], whole["mass_sum"], rtol=1e-6)
    # State digits and patches are no part of the mass of language.
    assert table.filter(pl.col("item").is_in(["state digits", "image patches"]))["share"].null_count() == 8


def test_a_planted_reader_is_found_where_it_is(reader_store):
    result = words(question_about(reader_store, intervals="these-tasks"))
    assert (result.findings[0].numbers["word"], result["words"]["item"][0]) == ("bowl", "bowl")
    assert result["words"].filter(kind="word")["lift_low"][0] > 1.5
    question = question_about(reader_store, intervals="these-tasks")
    heads = words(question, by=("layer", "head"))["words"].filter(kind="word")
    top = heads.sort("lift", descending=True).row(0, named=True)
    assert (top["item"], top["layer"], top["head"]) == ("bowl", "3", 1)
    assert top["lift"] > 15
    assert top["lift_q"] < 0.05


def test_one_instruction_is_in_reading_order(reader_store):
    table = next(table for table in words(question_about(reader_store, tasks=(1,))).tables if table.name == "words")
    assert table.shown["item"].to_list() == ["put", "the", "black", "bowl", "on", "the", "plate"]
    both = words(question_about(reader_store))["words"].filter(kind="word", item="the").row(0, named=True)
    assert both["keys"] == 2


def test_words_of_several_tasks_are_averaged_over_the_episodes_that_have_them(tmp_path):
    # "put the bowl on the plate", "open the top drawer", "turn on the stove".
    result = words(question_about(write_store(tmp_path / "tasks.zarr", tasks=(0, 1, 2), episodes=2)))
    summary = result["words"].filter(kind="word")
    counts = {row["item"]: (row["num_episodes"], row["num_tasks"]) for row in summary.iter_rows(named=True)}
    assert (counts["the"], counts["on"], counts["drawer"]) == ((6, 3), (4, 2), (2, 1))
    chosen = result["words_episodes"].filter(AVERAGE, kind="word", item="on")
    row = summary.filter(item="on").row(0, named=True)
    assert row["lift"] == pytest.approx(chosen["lift"].mean())
    assert row["lift_low"] <= row["lift"] <= row["lift_high"]
    by_task = words(question_about(tmp_path / "tasks.zarr"), by=("task",))["words"].filter(kind="word", item="the")
    assert by_task["task_id"].to_list() == [0, 1, 2]
    assert by_task["lift"].mean() == pytest.approx(summary.filter(item="the")["lift"][0])


def test_a_word_of_few_kinds_of_tasks_is_named_in_these_tasks(tmp_path):
    """'drawer' stands in one task of five, each of a kind of its own; it is read twenty times as much."""

    def read_drawer(task: int, episode: int, tokens: EpisodeTokens, rows: np.ndarray) -> np.ndarray:
        rows = random_rows(tokens, rows.shape[1:-1], seed=10 * task + episode, spread=0.1)
        for replan, which in enumerate(tokens.prompt_index):
            for word in tokens.words[which]:
                rows[replan][..., list(word.keys)] *= 20 if word.text == "drawer" else 1
        return rows / rows.sum(axis=-1, keepdims=True)

    families = {task: f"kind {task}" for task in range(5)}
    store = write_store(tmp_path / "a.zarr", tasks=tuple(range(5)), episodes=4, plant_rows=read_drawer,
                        task_families=families)  # fmt: skip
    question = question_about(store)
    found = words(question)
    numbers = found.findings[0].numbers
    assert (numbers["word"], numbers["these"] >= 1) == ("drawer", True)
    row = found["words"].row(by_predicate=(pl.col("item") == "drawer") & (pl.col("kind") == "word"), named=True)
    assert (row["intervals"], row["num_tasks"] < 4) == ("these-tasks", True)
    assert numbers["estimate"] == row["lift"] > 10
    assert found.findings[0] in language(question).findings


def test_one_table_has_one_sentence():
    question = question_about(example_store("cubes"))
    own = words(question).findings[0]
    assert own in language(question).findings
    named = words(question)["words"].filter(pl.col("kind") == "word", pl.col("lift_q") <= SHOWN_AT)
    assert own.numbers["these"] == named.height == 4


def test_what_was_not_shown_says_what_would_have_been(tmp_path):
    """Of even attention with noise: the detectable lift lies beyond the intervals of the words."""

    def even(task: int, episode: int, tokens: EpisodeTokens, rows: np.ndarray) -> np.ndarray:
        return random_rows(tokens, rows.shape[1:-1], seed=10 * task + episode, spread=0.5)

    found = words(question_about(write_store(tmp_path / "a.zarr", episodes=4, plant_rows=even)))
    numbers, table = found.findings[0].numbers, found["words"].filter(kind="word")
    assert "word" not in numbers
    reach = (table["lift_high"] / table["lift"]).drop_nulls().median()
    assert numbers["detectable"] > reach > 1
    assert "lift_detectable" not in table.columns


@pytest.mark.drawn
def test_the_command_prints_writes_and_draws(reader_store, tmp_path, capsys):
    assert main(["words", str(reader_store), "--output", str(tmp_path), "--pdf", "--intervals", "these-tasks"]) == 0
    printed = capsys.readouterr().out
    assert "'bowl'" in printed
    assert all(len(line) <= 100 for line in printed.splitlines() if "/" not in line)  # paths are not broken
    tables = ("words", "words_scale", "words_episodes")
    files = {"result.json", "word_bars.png", "word_bars.pdf", *(f"{name}.parquet" for name in tables)}
    assert {path.name for path in tmp_path.iterdir()} == files
    document = json.loads((tmp_path / "result.json").read_text())
    assert document["findings"][0]["numbers"]["word"] == "bowl"
    assert document["tables"]["words"]["columns"]["lift"]["meaning"]


def test_a_mistake_is_named(reader_store, tmp_path, capsys):
    for arguments, named in (
        (["--task", "7"], "task 7"),
        (["--site", "jont"], "'joint'"),
        (["--by", "layr"], "'layer'"),
        (["--by", "camera"], "--by camera"),
    ):
        assert main(["words", str(reader_store), "--output", str(tmp_path), *arguments]) == 2
        error = capsys.readouterr().err
        assert named in error
        assert "Traceback" not in error
    assert not list(tmp_path.iterdir())
