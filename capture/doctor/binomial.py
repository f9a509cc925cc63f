"""The exact interval of a rate, and what a few episodes can tell. Pure functions; needs the standard library only."""

from __future__ import annotations

import math
from collections.abc import Callable

_LEVEL = 0.95


def at_most(successes: int, count: int, rate: float) -> float:
    """Return the probability of at most `successes` of `count` at a rate of success."""
    if successes >= count or rate <= 0:
        return 1.0
    if successes < 0 or rate >= 1:
        return 0.0
    logs = [
        math.lgamma(count + 1)
        - math.lgamma(k + 1)
        - math.lgamma(count - k + 1)
        + k * math.log(rate)
        + (count - k) * math.log1p(-rate)
        for k in range(successes + 1)
    ]
    return min(1.0, math.fsum(map(math.exp, logs)))


def exact_interval(successes: int, count: int) -> tuple[float, float]:
    """Return the 95 % interval of a rate by Clopper and Pearson (1934): it covers the rate at least that often."""
    if not 0 <= successes <= count or count < 1:
        raise ValueError(f"{successes} of {count} is no number of successes")
    tail = (1 - _LEVEL) / 2
    # The highest rate at which so few, and the lowest at which so many successes are not yet improbable.
    low = 0.0 if successes == 0 else _solve(lambda rate: 1 - at_most(successes - 1, count, rate) - tail)
    high = 1.0 if successes == count else _solve(lambda rate: tail - at_most(successes, count, rate))
    return low, high


def most_that_is_too_few(count: int, lowest_rate: float) -> int:
    """Return the largest number of successes whose interval lies below `lowest_rate`; -1 if there is none."""
    return max((k for k in range(count) if exact_interval(k, count)[1] < lowest_rate), default=-1)


def rate_found_in_nine_of_ten(count: int, too_few: int) -> float:
    """Return the rate of success at which nine of ten trials of `count` episodes have at most `too_few` successes."""
    return 0.0 if too_few < 0 else _solve(lambda rate: 0.9 - at_most(too_few, count, rate))


def _solve(rising: Callable[[float], float]) -> float:
    """Return where a function that rises from a rate of 0 to 1 is zero."""
    low, high = 0.0, 1.0
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (low, middle) if rising(middle) > 0 else (middle, high)
    return (low + high) / 2
