"""`data` on made-up data sets of which it is known what the first pictures tell."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import polars as pl
import pytest

import vla_attention as va
from tests.kit.lerobot_data_sets import MadeUpEpisode, write_data_set
from tests.kit.stores import write_store
from vla_attention.analyze.__main__ import main as analyze
from vla_attention.analyze.commands.data import data
from vla_attention.analyze.core.data_episodes import Episode, collected
from vla_attention.analyze.core.shared_scenes import APART, OPEN, SHARED
from vla_attention.schemas.errors import UserError

FRONT, WRIST = "observation.images.front", "observation.images.wrist"
MUST, WHERE, WORDS = "Must a policy read the sentence here?", "Where must it?", "Which words?"
FRAMES = 16


def episode(sentence, rng, *, spot=None, light=0, turn=0.0, several=False):
    """One episode of grey noise. spot: where a white square is; light: added; turn: of the actions from half on."""
    front, side = (rng.integers(60, 120, (24, 24, 3)) for _ in range(2))
    if spot is not None:
        front[3 * spot : 3 * spot + 6, :6] = 255
    images = dict(
        zip((FRONT, WRIST), (np.clip(one + light, 0, 255).astype(np.uint8) for one in (front, side)), strict=True)
    )
    actions, times = rng.normal(size=(FRAMES, 2)), np.arange(FRAMES) / 8
    actions[FRAMES // 2 :, 0] += turn
    return Episode(sentence, several, images, rng.normal(size=3), actions, times, None)


def asked(episodes, encoder=None):
    """The answer, and its findings by what they ask."""
    moments = np.arange(1, 9) / 8 * FRAMES / 8
    answer = data(collected("made up", len(episodes), len(episodes), iter(episodes), moments, "s", encoder))
    return answer, {one.asks: one for one in answer.findings}


def written(folder, episodes):
    """The same as a data set, of its first two frames."""
    made = [
        MadeUpEpisode(
            {name: np.stack([picture] * 2) for name, picture in one.images.items()},
            {"observation.state": np.stack([one.state] * 2), "action": one.actions[:2]},
            [one.instruction, "pick it" if one.several else one.instruction],
        )
        for one in episodes
    ]
    return write_data_set(folder, "v3.0", made, episodes_per_file=100)


CUPS = ["pick the red cup", "pick the blue cup", "push the red cup", "push the blue cup"]


def test_a_picture_that_tells_every_sentence():
    rng = np.random.default_rng(1)
    made = [episode(text, rng, spot=i) for _ in range(18) for i, text in enumerate(CUPS)]
    answer, found = asked(made)
    assert found[MUST].sentence.startswith("No:")
    assert found[MUST].numbers["low"] > 0.9
    assert found[MUST].numbers["explained"] > 0.5
    assert "Record 'pick" in found[MUST].limit
    assert found[WHERE].numbers["apart"] == 6
    assert found[WHERE].sentence.startswith("Nowhere")
    assert set(answer["words"]["verdict"]) == {APART}
    assert found[WORDS].numbers["apart"] == 4
    assert answer["looks"].row(0, named=True)["look"] in ("picture of front", "all of it")
    assert found["By what?"].numbers["look"] == "picture of front"


def test_scenes_that_all_sentences_share():
    rng = np.random.default_rng(21)
    turns = {CUPS[0]: 0.0, CUPS[1]: 6.0, CUPS[2]: 0.0, CUPS[3]: 6.0}
    made = [episode(text, rng, turn=turns[text]) for _ in range(30) for text in CUPS]
    answer, found = asked(made)
    assert found[MUST].sentence.startswith("Perhaps:")
    assert found[MUST].numbers["p"] > 0.1  # far from being named
    assert found[WHERE].sentence.startswith("Everywhere: all 4 sentences")
    pairs = answer["pairs"]
    assert set(pairs["verdict"]) == {SHARED}
    # The arm turns in the second of two seconds, told of the blue cup; else both do the same.
    same_colour = pl.col("sentence").str.contains("red") == pl.col("other").str.contains("red")
    assert pairs.filter(same_colour)["parts_at"].to_list() == [None, None]
    assert pairs.filter(~same_colour)["parts_at"].is_between(1.0, 1.5, closed="right").all()
    assert found["Do the demonstrations differ there?"].numbers["differ"] == 4
    colours = answer["words"].filter(kind="colour")
    assert set(colours["verdict"]) == {SHARED}
    assert set(colours["word"]) == {"red", "blue"}


def test_half_of_the_sentences_have_a_scene_of_their_own():
    rng = np.random.default_rng(3)
    texts = [*CUPS, "open the left drawer", "open the right drawer"]
    made = [episode(text, rng, spot=None if text in CUPS else i) for _ in range(30) for i, text in enumerate(texts)]
    answer, found = asked(made)
    assert found[MUST].sentence.startswith("Only in part:")
    assert found[WHERE].numbers["groups"] == 1
    assert sum(f"'{text}'" in found[WHERE].sentence for text in CUPS) >= 3
    assert "drawer" not in found[WHERE].sentence
    verdicts = dict(answer["words"].select("word", "verdict").rows())
    assert (verdicts["left"], verdicts["right"], verdicts["red"]) == (APART, APART, SHARED)


def test_few_episodes_say_how_many_would_show_it():
    rng = np.random.default_rng(4)
    made = [episode(text, rng) for _ in range(5) for text in CUPS]
    answer, found = asked(made)
    assert OPEN in set(answer["pairs"]["verdict"])
    assert "episodes a sentence" in found[WHERE].limit


def test_light_that_drifts_while_tasks_are_recorded_one_after_the_other():
    rng = np.random.default_rng(5)
    made = [episode(text, rng, light=3 * (20 * i + j)) for i, text in enumerate(CUPS[:2]) for j in range(20)]
    _, found = asked(made)
    assert found[MUST].sentence.startswith(("No:", "Only in part:"))
    assert found["By what?"].numbers["look"].startswith("brightness of")
    assert "light of its own" in found["By what?"].limit


def test_an_encoder_sees_what_small_pictures_do_not():
    """A dot of one pixel in noise."""
    rng = np.random.default_rng(13)
    made = [episode(text, rng) for _ in range(15) for text in CUPS[:2]]
    for one in made:
        one.images[FRONT][5, 5] = 118 if one.instruction == CUPS[0] else 62
    _, without = asked(made)
    _, found = asked(made, encoder=lambda picture: picture[5, 5])
    assert found["By what?"].numbers["look"] == "encoder of front"
    assert found[MUST].numbers["told"] > 0.95 > without[MUST].numbers["told"]


def test_a_black_camera_and_one_scene_for_all():
    rng = np.random.default_rng(6)
    one = episode(CUPS[0], rng)
    black = {FRONT: np.zeros((24, 24, 3), np.uint8), WRIST: one.images[WRIST]}
    made = [replace(one, images=black, instruction=text) for _ in range(20) for text in CUPS]
    answer, found = asked(made)
    assert found[MUST].numbers["told"] == pytest.approx(0.25, abs=1e-3)
    assert answer["pairs"]["told"].to_list() == pytest.approx([0.5] * 6)


def test_free_annotation_is_asked_by_word():
    rng = np.random.default_rng(7)
    made = []
    for number in range(48):
        verb, thing = ("take", "push")[number % 2], ("cup", "bowl")[number // 2 % 2]
        made.append(episode(f"{verb} the {thing} number {number}", rng, spot=2 * (number % 2)))
    answer, found = asked(made)
    assert "Asked by word" in found[MUST].sentence
    verdicts = {row["word"]: row["verdict"] for row in answer["words"].iter_rows(named=True)}
    assert (verdicts["take"], verdicts["push"]) == (APART, APART)
    assert (verdicts["cup"], verdicts["bowl"]) == (SHARED, SHARED)


def test_faults_of_the_sentences():
    rng = np.random.default_rng(8)
    texts = ["Pick the red cup.", "pick the red cup", "pick up the red cup", "push the blue cup", "", "turn it"]
    made = [episode(text, rng) for text in texts for _ in range(6)]
    made.append(episode("push the blue cup", rng, several=True))
    answer, found = asked(made)
    faults = found["Faults?"]
    assert (faults.numbers["otherwise"], faults.numbers["several"], faults.numbers["empty"]) == (1, 1, 6)
    ways = {row["sentence"].casefold().rstrip("."): row["ways"] for row in answer["ways"].iter_rows(named=True)}
    assert ways == {"pick the red cup": 2, "push the blue cup": 1, "turn it": 1}  # "up" says nothing of its own
    assert found["Is it said in more than one way?"].numbers["words"] == 9  # those of every way to say it
    assert {row["num_first"] for row in answer["pairs"].iter_rows(named=True)} >= {12}


def test_some_episodes_are_spread_over_all_and_sentences_of_few_are_left_out(tmp_path):
    rng = np.random.default_rng(9)
    made = [episode(text, rng, spot=i) for i, text in enumerate(CUPS) for _ in range(12)]
    made += [episode("wave", rng, several=True)]
    answer = va.data(written(tmp_path / "many", made), num_episodes=25)
    assert "25 of 49 episodes" in answer.about[0]
    assert answer.findings[0].numbers["n"] == 24
    assert "1 episode of 1 sentence left out" in answer.notes[0]
    assert answer.findings[-1].numbers["several"] == 1
    assert answer.findings[0].numbers["told"] > 0.9


def test_the_command_line_writes_files_and_refuses_what_shows_nothing(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(10)
    folder = written(tmp_path / "told", [episode(text, rng, spot=i) for _ in range(8) for i, text in enumerate(CUPS)])
    assert analyze(["data", str(folder), "--output", "out", "--csv"]) == 0
    assert "Must a policy read the sentence here?" in capsys.readouterr().out
    assert {path.name for path in (tmp_path / "out").iterdir()} >= {
        "result.json",
        "pairs.csv",
        "pairs.png",
        "words.csv",
    }
    assert json.loads((tmp_path / "out" / "result.json").read_text())["findings"][0]["asks"] == MUST
    one = written(tmp_path / "one", [episode("pick it", rng)] * 2)
    assert analyze(["data", str(one)]) == 2
    assert "expected two or more" in capsys.readouterr().err
    assert analyze(["data", str(folder), "--num-episodes", "0"]) == 2
    assert analyze(["data", "nowhere"]) == 2


def test_a_store_of_rollouts(tmp_path):
    answer = va.data(write_store(tmp_path / "run.zarr", episodes=5))
    assert answer["ways"].height == 2
    with pytest.raises(UserError):
        answer["wyas"]
    assert answer.findings[0].asks == MUST
    assert answer.findings[0].numbers["n"] == 10
    with pytest.raises(UserError):
        va.data(write_store(tmp_path / "bare.zarr", frames=False))
