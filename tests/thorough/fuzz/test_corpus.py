"""Inputs that a fuzzer found (`make fuzz`), and valid ones: every parser takes them or refuses them in a sentence."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.thorough.fuzz_targets import TARGETS, run, seeds

# A number that overflows is no reason for a line of numpy's on the terminal.
pytestmark = pytest.mark.filterwarnings("error")
CORPUS = Path(__file__).with_name("corpus")
FILES = sorted(CORPUS.glob("*/*"))


@pytest.mark.parametrize("path", FILES, ids=lambda path: f"{path.parent.name}-{path.name}")
def test_what_was_found_stays_mended(path):
    run(path.parent.name, path.read_bytes())


#: What no parser expects.
ANYWHERE = {
    "nothing": b"",
    "no text": b"\xff\xfe{}",
    "lists in lists": b"[" * 5000 + b"]" * 5000,
    "5,000 digits": b"9" * 5000,
    "a large number": b"1e999",
    "a field twice": b'{"a": 1, "a": 2}',
    "half a character": b'"\\ud800"',
}


@pytest.mark.parametrize("what", ANYWHERE)
@pytest.mark.parametrize("target", TARGETS)
def test_nonsense_is_refused(target, what):
    run(target, ANYWHERE[what])


@pytest.mark.parametrize("target", TARGETS)
def test_valid_inputs_are_taken(target):
    for content in seeds(target):
        TARGETS[target](content)
