"""A run repeats another one where each of its stores holds calls of that one's stores."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from vla_attention.analyze.core.runs import Run


def run(*sources: tuple[str, str | None]) -> Run:
    """Of each store the id of its run, and that of the run whose calls it made again."""
    stores = [
        SimpleNamespace(run=own, attributes=SimpleNamespace(rerun_of=of and SimpleNamespace(run=of)))
        for own, of in sources
    ]
    question: Any = SimpleNamespace(stores=stores)
    return Run("a", question)


@pytest.mark.parametrize(
    ("sources", "repeats"),
    [
        ([("x", "base")], True),
        ([("x", "base"), ("y", "second")], True),
        ([("x", "another")], False),
        ([("x", "base"), ("y", "another")], False),
        ([("x", "base"), ("y", None)], False),
    ],
)
def test_a_rerun_is_one_of_the_run_that_it_names(sources, repeats):
    assert run(*sources).repeats(run(("base", None), ("second", None))) is repeats
