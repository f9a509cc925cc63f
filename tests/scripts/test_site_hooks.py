"""`scripts/site_hooks.py`: links between docs/ and the rest of the checkout, and the help texts."""

from __future__ import annotations

import re

import pytest

from scripts.site_hooks import commands_of, help_texts, translate_links
from vla_attention.analyze.registry import COMMANDS
from vla_attention.capture.policies.families import policy_families


def test_links_are_those_of_the_site():
    assert translate_links("[a](docs/store.md#codecs) ![b](docs/pictures/sink.png)", "index.md", {}) == (
        "[a](store.md#codecs) ![b](pictures/sink.png)"
    )
    assert translate_links("[a](../CONTRIBUTING.md#tests)", "store.md", {}) == "[a](contributing.md#tests)"
    assert translate_links("[a](../README.md), [b](page.md)", "store.md", {}) == "[a](index.md), [b](page.md)"
    assert translate_links("[a](../docs/store.md)", "benchmarks.md", {}) == "[a](store.md)"


@pytest.mark.thorough
def test_every_command_has_its_help_text():
    text = help_texts()
    headings = re.findall(r"^#+ `(.*)`$", text, re.MULTILINE)
    assert {f"vla-attention {command}" for command in COMMANDS} <= set(headings)
    assert {f"vla-attention capture {family.name}" for family in policy_families()} <= set(headings)
    assert "vla-attention capture replay" in headings
    assert len(headings) == text.count("usage: ") == len(set(headings))
    assert commands_of("vla-attention") == list(COMMANDS)
