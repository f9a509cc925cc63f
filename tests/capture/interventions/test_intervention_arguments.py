"""The options of interventions: what they mean, and one sentence for each mistake."""

from __future__ import annotations

import argparse

import pytest

from vla_attention.capture.interventions.arguments import InterventionSettings, read_interventions
from vla_attention.schemas.errors import UserError
from vla_attention.schemas.interventions import (
    AttentionScale,
    AttentionUniform,
    ImageChange,
    Interventions,
    KeyKnockout,
    NoiseChange,
    PromptChange,
)
from vla_attention.schemas.options import add_options


def read(*words: str) -> Interventions:
    parser = argparse.ArgumentParser()
    add_options(parser, InterventionSettings)
    return read_interventions(parser.parse_args(words))


def test_nothing():
    assert read() == Interventions()
    assert read().is_none


def test_knockouts():
    given = read(
        *("--knockout", "camera:base", "--knockout", "word:bowl | word:plate", "--keep", "role:image"),
        *("--knockout-queries", "all", "--knockout-layers", "3", "1", "3", "--knockout-heads", "0"),
        *("--knockout-weight", "0.5", "--random-keys", "4"),
    )
    places = {"queries": "all", "layers": (1, 3), "heads": (0,), "weight": 0.5, "random_seed": 4}
    assert given.keys == (
        KeyKnockout("camera:base", **places),
        KeyKnockout("word:bowl | word:plate", **places),
        KeyKnockout("role:image", keep=True, **places),
    )


def test_queries_of_the_prefix():
    given = read("--knockout", "role:image", "--knockout-queries", "prefix:span:prompt - word:bowl")
    assert given.keys == (KeyKnockout("role:image", queries="prefix", query_selector="span:prompt - word:bowl"),)


def test_attention():
    given = read(
        "--attention", "word:bowl=0.5", "--attention", "keys:1-4 = uniform", "--knockout-steps", "9", "--allow-empty"
    )
    assert given.attention == (
        AttentionScale("word:bowl", 0.5, queries="all", denoise_steps=(9,)),
        AttentionUniform("keys:1-4", queries="all", denoise_steps=(9,)),
    )


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("shuffled:3", PromptChange("shuffled", seed=3)),
        ("task:7", PromptChange("task", task_id=7)),
        ("text:close the drawer: now", PromptChange("text", text="close the drawer: now")),
    ],
)
def test_prompts(text, expected):
    assert read("--prompt", text).prompt == expected


def test_synonyms(tmp_path):
    file = tmp_path / "words.json"
    file.write_text('{"bowl": "dish"}')
    assert read("--prompt", f"synonyms:{file}").prompt == PromptChange("synonyms", synonyms={"bowl": "dish"})


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("base=noise", ImageChange("base", "noise")),
        ("base=shifted:2,-1", ImageChange("base", "shifted", rows=2, columns=-1)),
        ("base=masked:bowl_1", ImageChange("base", "masked", object="bowl_1")),
    ],
)
def test_images(text, expected):
    assert read("--image", text, "--image", "wrist=blank").images == (expected, ImageChange("wrist", "blank"))


def test_noise():
    assert read("--noise-seed", "8").noise == NoiseChange(8)


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["--random-keys", "0"], "--random-keys .*--knockout"),
        (["--allow-empty"], "--allow-empty"),
        (["--prompt", "task:²"], "'task:²'"),
    ],
)
def test_mistakes(words, named):
    with pytest.raises(UserError, match=named):
        read(*words)
