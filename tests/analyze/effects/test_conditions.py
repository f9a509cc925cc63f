"""What a condition is about, and which other is its reverse."""

from __future__ import annotations

import pytest

from vla_attention.analyze.effects.conditions import Condition, Kind, kind_of
from vla_attention.schemas.interventions import (
    AttentionScale,
    ImageChange,
    Interventions,
    KeyKnockout,
    NoiseChange,
    PromptChange,
)


def condition(name: str, *keys: KeyKnockout, **more) -> Condition:
    return Condition(name, None, Interventions(name, keys=keys, **more))


@pytest.mark.parametrize(
    ("interventions", "kind"),
    [
        (Interventions(), Kind.NOTHING),
        (Interventions(noise=NoiseChange(3)), Kind.NOISE),
        (Interventions(keys=(KeyKnockout("role:image"),)), Kind.WITHOUT),
        (Interventions(keys=(KeyKnockout("role:image"), KeyKnockout("role:state"))), Kind.WITHOUT),
        (Interventions(keys=(KeyKnockout("role:image", keep=True),)), Kind.ONLY),
        (Interventions(keys=(KeyKnockout("role:image", keep=True, random_seed=1),)), Kind.RANDOM),
        (Interventions(keys=(KeyKnockout("role:image"), KeyKnockout("role:state", keep=True))), Kind.SEVERAL),
        (Interventions(keys=(KeyKnockout("role:image"),), noise=NoiseChange(1)), Kind.SEVERAL),
        (Interventions(attention=(AttentionScale("role:image", 0.5),)), Kind.ATTENTION),
        (Interventions(prompt=PromptChange("empty")), Kind.PROMPT),
        (Interventions(images=(ImageChange("base_0_rgb", "blank"),)), Kind.IMAGE),
        (Interventions(prompt=PromptChange("empty"), images=(ImageChange("c", "blank"),)), Kind.SEVERAL),
    ],
)
def test_kinds(interventions, kind):
    assert kind_of(interventions) == kind


def test_the_reverse_keeps_what_the_other_knocked_out():
    without = condition("without_visual", KeyKnockout("role:image"))
    only = condition("only_visual", KeyKnockout("role:image", keep=True))
    assert only.is_reverse_of(without)
    assert without.is_reverse_of(only)
    assert not condition("o", KeyKnockout("role:image", keep=True, queries="all")).is_reverse_of(without)
    assert (without.group_name, only.group_name) == ("visual", "visual")
    assert condition("mine", KeyKnockout("role:image")).group_name == "role:image"
