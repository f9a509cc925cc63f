"""What an intervention is: its checks, its words, and its way through JSON."""

from __future__ import annotations

import json

import pytest

from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.interventions import (
    AttentionScale,
    AttentionUniform,
    ImageChange,
    Interventions,
    KeyKnockout,
    NoiseChange,
    PromptChange,
    RerunSource,
)
from vla_attention.schemas.jsonable import from_json, to_json

EVERYTHING = Interventions(
    name="all of it",
    keys=(
        KeyKnockout("word:bowl | camera:base", layers=(0, 3), denoise_steps=(9,), weight=0.5),
        KeyKnockout("camera:base", keep=True, queries="all", random_seed=3, heads=(1,)),
        KeyKnockout("role:image", queries="prefix", query_selector="role:instruction"),
    ),
    attention=(AttentionUniform("camera:base"), AttentionScale("role:image", 0.25)),
    prompt=PromptChange("synonyms", synonyms={"bowl": "dish"}),
    images=(ImageChange("base", "shifted", rows=3, columns=-2), ImageChange("base", "masked", object="bowl_1")),
    noise=NoiseChange(4),
)


def test_json_and_back():
    document = json.loads(json.dumps(to_json(EVERYTHING)))
    assert from_json(Interventions, document) == EVERYTHING
    assert from_json(Interventions, {}) == Interventions()


def test_what_counts_as_none():
    assert Interventions().is_none
    assert Interventions(name="base").is_none
    assert Interventions().describe() == "none"
    for changes in (
        {"keys": EVERYTHING.keys},
        {"attention": EVERYTHING.attention},
        {"prompt": EVERYTHING.prompt},
        {"images": EVERYTHING.images},
        {"noise": EVERYTHING.noise},
    ):
        assert not Interventions(**changes).is_none


def test_what_differs_is_described_differently():
    alike = [
        (AttentionScale("word:a", 0.5), AttentionScale("word:a", 0.5, queries="all")),
        (AttentionUniform("word:a"), AttentionUniform("word:a", queries="prefix")),
        (ImageChange("base", "noise"), ImageChange("base", "noise", seed=3)),
        (PromptChange("synonyms", synonyms={"a": "b"}), PromptChange("synonyms", synonyms={"a": "c"})),
    ]
    for one, other in alike:
        assert one.describe() != other.describe()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: PromptChange("shuffled", seed=-1), "-1"),
        (lambda: KeyKnockout(" "), "no selector"),
        (lambda: KeyKnockout("word:a\nb"), "control characters"),
        (lambda: KeyKnockout("word:a", weight=1.5), r"1\.5; .*0 to 1"),
        (lambda: KeyKnockout("word:a", heads=(3, 1)), "heads 3, 1"),
        (lambda: KeyKnockout("word:a", query_selector="role:text"), "'role:text'.*'prefix'.*'action'"),
        (lambda: AttentionScale("word:a", -0.5), r"-0\.5"),
        (lambda: PromptChange("task"), "'task'.*None"),
        (lambda: PromptChange("synonyms"), "'synonyms'.* 0 "),
        (lambda: ImageChange("base", "masked"), "'masked'.*''"),
        (lambda: ImageChange("a/b", "blank"), "'a/b'"),
        (lambda: RerunSource("ab\x1b", "a.zarr"), "control characters"),
    ],
)
def test_bad_values(make, message):
    with pytest.raises(BadArgument, match=message):
        make()
