"""Default names of conditions: what differs has another name, and none is too long for a file."""

from __future__ import annotations

from itertools import combinations

import pytest

from vla_attention.capture.interventions.condition_name import condition_name
from vla_attention.schemas.interventions import (
    AttentionScale,
    ImageChange,
    Interventions,
    KeyKnockout,
    NoiseChange,
    PromptChange,
)


def knockout(selector: str = "role:image", **fields) -> Interventions:
    return Interventions(keys=(KeyKnockout(selector, **fields),))


def scaled(factor: float = 0.5, **fields) -> Interventions:
    return Interventions(attention=(AttentionScale("role:image", factor, **fields),))


def prompt(kind: str, **fields) -> Interventions:
    return Interventions(prompt=PromptChange(kind, **fields))


def image(kind: str, **fields) -> Interventions:
    return Interventions(images=(ImageChange("base", kind, **fields),))


NAMES = [
    (Interventions(), ""),
    (knockout("camera:base_0_rgb"), "without_camera_base_0_rgb"),
    (knockout("role:image - camera:base"), "without_role_image_but_camera_base"),
    (knockout(keep=True), "only_role_image"),
    (
        knockout(queries="prefix", query_selector="word:bowl"),
        "without_role_image_queries_prefix_of_word_bowl",
    ),
    (knockout(layers=(0, 1, 2, 9)), "without_role_image_layers_0_to_2_9"),
    (knockout(weight=0.5), "without_role_image_weight_0.5"),
    (knockout(random_seed=1, keep=True), "random_only_role_image_seed_1"),
    (scaled(2), "role_image_times_2"),
    (scaled(queries="all"), "role_image_times_0.5_queries_all"),
    (prompt("synonyms", synonyms={"bowl": "cup"}), "prompt_synonyms_bowl_cup"),
    (image("shifted", rows=-1, columns=2), "base_shifted_up_1_right_2"),
    (Interventions(noise=NoiseChange(3)), "noise_3"),
]


@pytest.mark.parametrize(("interventions", "name"), NAMES, ids=[name or "nothing" for _, name in NAMES])
def test_a_name_has_everything_that_is_not_the_default(interventions, name) -> None:
    assert condition_name(interventions) == name


def test_no_two_names_are_alike() -> None:
    for (_, one), (_, other) in combinations(NAMES, 2):
        assert one != other
