"""Words against arithmetic on raw Zarr arrays, a planted reader, and the command."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl
import pytest
import zarr

from tests.kit.bowl_scene import write_bowl_store
from tests.kit.questions import question_about
from vla_attention.analyze.__main__ import main
from vla_attention.analyze.statistics.episode_intervals import Sampling
from vla_attention.analyze.words.word_study import leading_words, words_summary, words_table
from vla_attention.schemas.groupings.vocabulary import EpisodeTokens
from vla_attention.schemas.layout import Role
from vla_attention.testing.stores import write_store
from vla_attention.testing.tokens import random_rows


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
    """(word, place) to pieces, mass, lift and share by loops over replans, with the instruction's characters found
    anew.
    """
    episode = zarr.open_group(path / "episodes" / name, mode="r")
    rows = episode["joint/rows"][:].astype(np.float64).mean(axis=(2, 3, 4))  # (replan, layer, key)
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
    table = words_table(question_about(reader_store))
    for task, episode in ((0, 0), (1, 1)):
        own = table.filter(
            (pl.col("task_id") == task) & (pl.col("episode_index") == episode) & (pl.col("kind") == "word")
        )
        wanted = raw_measures(reader_store, f"task{task:03d}_episode{episode:03d}", layer=2)
        found = own.filter(pl.col("layer") == "3")
        assert set(zip(found["item"], found["place"], strict=True)) == set(wanted)
        for row in found.iter_rows(named=True):
            numbers = [row["pieces"], row["mass"], row["lift"], row["share"]]
            np.testing.assert_allclose(numbers, wanted[row["item"], row["place"]], rtol=1e-5)
            assert row["density"] == pytest.approx(row["mass"] / row["pieces"], rel=1e-5)


def test_layers_avg_comes_from_averaged_masses(reader_store):
    table = words_table(question_about(reader_store)).filter(pl.col("kind") == "word")
    by_layer = (
        table.filter(pl.col("layer") != "layers_avg")
        .group_by("task_id", "episode_index", "place")
        .agg(pl.col("mass").mean())
    )
    joined = table.filter(pl.col("layer") == "layers_avg").join(
        by_layer, on=["task_id", "episode_index", "place"], suffix="_mean"
    )
    np.testing.assert_allclose(joined["mass"], joined["mass_mean"], rtol=1e-9)


def test_classes_add_up_to_their_words(reader_store):
    table = words_table(question_about(reader_store)).filter(pl.col("layer") == "layers_avg")
    keys = ["task_id", "episode_index"]
    for name, kind in (("content words", "content"), ("stop words", "stop")):
        words = (
            table.filter((pl.col("kind") == "word") & (pl.col("word_class") == kind))
            .group_by(keys)
            .agg(pl.col("mass").sum())
        )
        whole = table.filter(pl.col("item") == name).join(words, on=keys, suffix="_sum")
        np.testing.assert_allclose(whole["mass"], whole["mass_sum"], rtol=1e-6)
    scale = set(table.filter(pl.col("kind") == "scale")["item"])
    assert scale == {"content words", "stop words", "bos", "state", "image"}
    # State digits and patches are no part of the linguistic mass.
    assert table.filter(pl.col("item").is_in(["state", "image"]))["share"].null_count() == 8


def test_a_planted_reader_is_found_and_named(reader_store):
    table = words_table(question_about(reader_store, per_head=True))
    word, cell = leading_words(table, Sampling())
    assert word.name == {"item": "bowl"}
    assert cell.name == {"item": "bowl", "layer": "3", "head": 1}
    assert cell.found.value > 15
    assert word.found.is_named(2)
    assert cell.found.is_named(2)
    summary = words_summary(table, Sampling())
    first = summary.row(0, named=True)
    assert first["item"] == "bowl"
    assert first["lift_low"] > 1.5
    assert 0.7 < summary.filter(pl.col("item") == "plate")["lift"][0] < 1.3


def test_a_word_that_stands_twice_is_one_item_unless_places_are_wanted(reader_store):
    table = words_table(question_about(reader_store))
    both = (
        table.filter(pl.col("item") == "the", pl.col("layer") == "layers_avg")
        .group_by("task_id", "episode_index")
        .agg(pl.col("mass").sum(), pl.col("lift").mean())
    )
    row = words_summary(table, Sampling()).filter(pl.col("item") == "the").row(0, named=True)
    assert row["pieces"] == 2
    assert row["mass"] == pytest.approx(both["mass"].mean())
    assert row["lift"] == pytest.approx(both["lift"].mean())
    places = words_summary(table, Sampling(), by_place=True).filter(pl.col("kind") == "word")
    assert places["item"].to_list() == ["put", "the", "black", "bowl", "on", "the", "plate"]
    assert places["place"].to_list() == list(range(7))


def test_words_of_several_tasks_are_averaged_over_the_episodes_that_have_them(tmp_path):
    # "put the bowl on the plate", "open the top drawer", "turn on the stove"; state digits change from replan to
    # replan.
    path = write_store(tmp_path / "tasks.zarr", tasks=(0, 1, 2), episodes=2)
    table = words_table(question_about(path))
    summary = words_summary(table, Sampling())
    counts = {row["item"]: (row["num_episodes"], row["num_tasks"]) for row in summary.iter_rows(named=True)}
    assert (counts["the"], counts["on"], counts["drawer"]) == ((6, 3), (4, 2), (2, 1))
    chosen = table.filter((pl.col("layer") == "layers_avg") & (pl.col("item") == "on"))
    row = summary.filter(pl.col("item") == "on").row(0, named=True)
    assert row["lift"] == pytest.approx(chosen["lift"].mean())
    assert row["lift_low"] <= row["lift"] <= row["lift_high"]


@pytest.mark.drawn
def test_the_command_prints_writes_and_draws(reader_store, tmp_path, capsys):
    assert main(["words", str(reader_store), "--output", str(tmp_path), "--per-head", "--pdf"]) == 0
    printed = capsys.readouterr().out
    words = " ".join(printed.split())
    assert "'bowl' has a higher lift (3.627) than each of the other 5 words" in words
    assert (
        "'bowl' in layer 3 head 1 has a higher lift (16.79) than each of the other 35 pairs of word and layer" in words
    )
    assert "stop words" in printed
    assert all(len(line) <= 100 for line in printed.splitlines() if str(tmp_path) not in line)
    assert {path.name for path in tmp_path.iterdir()} == {
        "summary.txt", "words.parquet", "words_summary.parquet", "word_bars.png", "word_bars.pdf", "word_bars.csv",
    }  # fmt: skip
    assert pl.read_parquet(tmp_path / "words.parquet")["head"].n_unique() == 2
    assert main(["words", str(reader_store), "--output", str(tmp_path / "one"), "--task", "1"]) == 0
    printed = capsys.readouterr().out
    assert printed.index("\nput ") < printed.index("\nblack ") < printed.index("\nplate ")


def test_a_mistake_ends_with_one_sentence(reader_store, tmp_path, capsys):
    for arguments, said in (
        (["--task", "7"], "has no episode of task 7"),
        (["--site", "jont"], "Did you mean 'joint'?"),
    ):
        assert main(["words", str(reader_store), "--output", str(tmp_path), *arguments]) == 2
        error = capsys.readouterr().err
        assert said in error
        assert "Traceback" not in error
