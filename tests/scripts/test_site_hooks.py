"""`scripts/site_hooks.py`: links between docs/ and the rest of the checkout, and what is put in at build time."""

from __future__ import annotations

import re

import pytest

from scripts.site_hooks import OUTSIDE, commands_of, fill_marks, help_texts, names_of_pages, translate_links
from vla_attention.analyze.commands import COMMANDS
from vla_attention.capture.policies.families import policy_families


def test_links_are_those_of_the_site():
    assert translate_links("[a](docs/store.md#codecs) ![b](docs/pictures/sink.png)", "index.md", {}) == (
        "[a](store.md#codecs) ![b](pictures/sink.png)"
    )
    assert translate_links("[a](../CONTRIBUTING.md#checks)", "store.md", {}) == "[a](contributing.md#checks)"
    assert (
        translate_links("[a](../../README.md), [b](../store.md)", "errors/stores.md", {})
        == "[a](../index.md), [b](../store.md)"
    )
    assert translate_links("[a](../docs/benchmarks.md)", "benchmark-scripts.md", {}) == "[a](benchmarks.md)"


def test_a_link_with_the_name_of_its_file_gets_the_name_of_the_page():
    names = dict(names_of_pages([{"Guides": [{"Store": "store.md"}, {"More": ["more.md", {"Scale": "scale.md"}]}]}]))
    assert names == {"store.md": "Store", "more.md": "More", "scale.md": "Scale"}
    assert translate_links("[docs/store.md](docs/store.md#tree)", "index.md", names) == "[Store](store.md#tree)"
    assert translate_links("[store.md](../store.md), [a](../scale.md)", "errors/stores.md", names) == (
        "[Store](../store.md), [a](../scale.md)"
    )
    assert translate_links("[python.md](python.md)", "store.md", names) == "[python.md](python.md)"


def test_other_links_and_code_stay():
    text = "[a](https://b.org/docs/store.md) [c](#here) [d](../Makefile)\n```\n[e](../README.md)\n```\n"
    assert translate_links(text, "store.md", {}) == text


@pytest.mark.thorough
def test_every_command_has_its_help_text():
    text = help_texts()
    headings = re.findall(r"^#+ `(.*)`$", text, re.MULTILINE)
    assert {f"vla-analyze {command}" for command in COMMANDS} <= set(headings)
    assert {f"vla-capture {family.name}" for family in policy_families()} <= set(headings)
    assert "vla-capture replay" in headings
    assert len(headings) == text.count("usage: ") == len(set(headings))
    assert commands_of("vla-analyze") == list(COMMANDS)


def test_marks_are_filled():
    assert fill_marks("a\n<!-- docstring: vla_attention.open -->\nb") == "a\n::: vla_attention.open\nb"
    text = fill_marks("<!-- schema: grouping -->")
    assert "- `overlap`: boolean" in text
    assert "schemas/grouping.schema.json" in OUTSIDE.values()
    assert fill_marks("<!-- another comment -->") == "<!-- another comment -->"
