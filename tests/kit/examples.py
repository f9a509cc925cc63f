"""How many random examples a property test tries."""

from __future__ import annotations

from hypothesis import settings

#: Examples of a test that names no number, by profile. `make test-thorough` loads the second.
PROFILES = {"fast": 50, "thorough": 500}


def examples(count: int) -> int:
    """`count` in the fast profile, ten times as many in the thorough one; for `settings(max_examples=examples(8))`."""
    return count * settings().max_examples // PROFILES["fast"]
