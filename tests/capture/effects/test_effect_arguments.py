"""The options of effects: what they say, and the sentences for what they cannot say."""

from __future__ import annotations

import argparse

import pytest

from vla_attention.capture.effects.arguments import EffectSettings, add_effect_options, effect_settings
from vla_attention.schemas.errors import BadArgument


def settings(*words: str) -> EffectSettings | None:
    parser = argparse.ArgumentParser()
    add_effect_options(parser)
    return effect_settings(parser.parse_args(words))


def test_without_the_option_nothing_is_measured():
    assert settings() is None
    assert settings("--effects", "none") is None


def test_items_and_readers_are_in_a_fixed_order():
    assert settings("--effects", "cameras,text") == EffectSettings(("text", "cameras"), ("all", "action"), 1, None)
    given = settings("--effects", "text, objects", "--effects-readers", "text", "all", "--effects-every", "3")
    assert given == EffectSettings(("text", "objects"), ("all", "text"), 3, None)
    assert settings("--effects", "tokens", "--effects-steps", "5") == EffectSettings(("tokens",), denoise_steps=5)


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["--effects", "word"], "'word'.* text, cameras, objects, tokens"),
        (["--effects-readers", "all", "text"], "--effects-readers"),
    ],
)
def test_what_is_refused(words, named):
    with pytest.raises(BadArgument, match=named):
        settings(*words)
