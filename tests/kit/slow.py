"""Cases of a parametrised test that only the slow part of the suite runs."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from typing import Any

import pytest


def slow_except(fast: Collection[Any], cases: Iterable[Any]) -> list[Any]:
    """The cases, all but the fast ones with the mark `slow`."""
    return [case if case in fast else pytest.param(case, marks=pytest.mark.slow) for case in cases]
