"""Cases of a parametrised test that only the slow part of the suite runs, or `make test-thorough` alone."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from typing import Any

import pytest


def slow_except(
    fast: Collection[Any], cases: Iterable[Any], *, slow: Collection[Any] | None = None, several: bool = False
) -> list[Any]:
    """The cases; the fast ones have no mark, those in `slow` (default: all others) `slow`, and the rest `thorough`.

    `several`: a case is a tuple, of which each is an argument of the test.
    """
    found = []
    for case in cases:
        marks = () if case in fast else (pytest.mark.slow,) if slow is None or case in slow else (pytest.mark.thorough,)
        found.append(pytest.param(*(case if several else (case,)), marks=marks))
    return found


def asked_for(request: pytest.FixtureRequest, argument: str, cases: Iterable[str]) -> list[str]:
    """Those of the cases that a test of this session has as this argument: what a fixture of all has to make."""
    given = {item.callspec.params.get(argument) for item in request.session.items if hasattr(item, "callspec")}
    return [case for case in cases if case in given]
