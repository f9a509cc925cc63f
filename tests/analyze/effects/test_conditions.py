"""What a condition is about, and which others are its control and its reverse."""

from __future__ import annotations

import pytest

from vla_attention.analyze.effects.conditions import Condition, GroupOfKeys, Kind, Place, group_of, kind_of
from vla_attention.schemas.interventions import (
    AttentionScale,
    AttentionUniform,
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


def test_groups_hold_selectors_and_places():
    both = Interventions(keys=(KeyKnockout("word:red", layers=(1, 2)), KeyKnockout("word:cube", layers=(1, 2))))
    assert group_of(both) == GroupOfKeys(("word:red", "word:cube"), Place((1, 2)))
    apart = Interventions(keys=(KeyKnockout("word:red", layers=(1,)), KeyKnockout("word:cube", layers=(2,))))
    assert group_of(apart) is None
    assert group_of(Interventions(attention=(AttentionUniform("role:image", heads=(0,)),))).place.heads == (0,)
    assert group_of(Interventions(prompt=PromptChange("empty"))) is None


def test_a_control_is_alike_in_all_but_the_seed():
    without = condition("without_visual", KeyKnockout("role:image", layers=(1,)))
    assert condition("r", KeyKnockout("role:image", layers=(1,), random_seed=4)).is_control_of(without)
    assert not condition("r", KeyKnockout("role:image", random_seed=4)).is_control_of(without)
    assert not condition("r", KeyKnockout("role:image", layers=(1,), keep=True, random_seed=4)).is_control_of(without)
    assert not without.is_control_of(without)


def test_the_reverse_keeps_what_the_other_knocked_out():
    without = condition("without_visual", KeyKnockout("role:image"))
    only = condition("only_visual", KeyKnockout("role:image", keep=True))
    assert only.is_reverse_of(without)
    assert without.is_reverse_of(only)
    assert not condition("o", KeyKnockout("role:image", keep=True, queries="all")).is_reverse_of(without)
    assert (without.group_name, only.group_name) == ("visual", "visual")
    assert condition("mine", KeyKnockout("role:image")).group_name == "role:image"
