"""Cases of a parametrised test that only `make test-thorough` runs."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from typing import Any

import pytest


def thorough_except(gate: Collection[Any], cases: Iterable[Any], *, several: bool = False) -> list[Any]:
    """The cases; those that are not in `gate` have the mark `thorough`.

    `several`: a case is a tuple, of which each is an argument of the test.
    """
    return [
        pytest.param(*(case if several else (case,)), marks=() if case in gate else pytest.mark.thorough)
        for case in cases
    ]


def asked_for(request: pytest.FixtureRequest, argument: str, cases: Iterable[str]) -> list[str]:
    """Those of the cases that a test of this session has as this argument: what a fixture of all has to make."""
    given = {item.callspec.params.get(argument) for item in request.session.items if hasattr(item, "callspec")}
    return [case for case in cases if case in given]
