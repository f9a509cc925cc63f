"""A first screen names something where it was planted, and nothing where there is nothing to find.

`benchmarks/null_stores.py` measures the rates over 200 stores of each kind; here are a few of them.
"""

from __future__ import annotations

import pytest

from benchmarks.null_stores import names_something

pytestmark = pytest.mark.thorough


KINDS = ["analyze", "outcome", "time", "words", "words here", "compare"]


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_planted_is_named(kind, tmp_path):
    assert names_something(kind, 0, planted=True, folder=tmp_path)


@pytest.mark.parametrize("kind", KINDS)
def test_nothing_is_named_in_null_stores(kind, tmp_path):
    """At most 5 % of null stores get a name: two of four would be most unlikely."""
    named = 0
    for number in range(4):
        (tmp_path / str(number)).mkdir()
        named += names_something(kind, number, planted=False, folder=tmp_path / str(number))
    assert named <= 1
