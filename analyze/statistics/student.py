"""Student's t distribution: quantiles and tails. Pure functions.

Degrees of freedom need not be whole: those of few families of tasks (`intervals`) are not, and 1.9 are far from 1.
"""

from __future__ import annotations

import functools
import math
from statistics import NormalDist

#: Beyond this many degrees of freedom Student's t is the normal distribution to three digits.
_MANY = 2000
#: p-values below this are not computed: the difference of two numbers near 1 has no more digits.
_SMALLEST = 1e-16


@functools.lru_cache(maxsize=4096)
def student_quantile(level: float, degrees: float) -> float:
    """The x with P(|t| < x) = `level` for Student's t with `degrees` degrees of freedom (from 1)."""
    if degrees > _MANY:
        return NormalDist().inv_cdf(0.5 + level / 2)
    low, high = 0.0, math.pi / 2
    # The sums take the angle atan(t / sqrt(degrees)), which is bounded; t is not.
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if _share_within(middle, degrees) < level else (low, middle)
    return math.sqrt(degrees) * math.tan((low + high) / 2)


def two_sided_p(t: float, degrees: float) -> float:
    """P(|T| > |t|) for Student's t with `degrees` degrees of freedom (from 1)."""
    if degrees > _MANY:
        return max(_SMALLEST, math.erfc(abs(t) / math.sqrt(2)))
    return max(_SMALLEST, 1.0 - _share_within(math.atan(abs(t) / math.sqrt(degrees)), degrees))


def _share_within(angle: float, degrees: float) -> float:
    """P(|t| < sqrt(degrees) * tan(angle)), by the finite sums of Abramowitz & Stegun 1964, 26.7.3 and 26.7.4.

    Degrees that are not whole: 1 - I(cos(angle)^2; degrees / 2, 1 / 2), the regularised incomplete beta function.
    """
    if degrees != int(degrees):
        return 1.0 - _incomplete_beta(math.cos(angle) ** 2, degrees / 2, 0.5)
    degrees = int(degrees)
    cosine_squared = math.cos(angle) ** 2
    odd = degrees % 2 == 1
    term, total = (math.cos(angle), 0.0) if odd else (1.0, 0.0)
    for k in range(degrees // 2):
        total += term
        # Odd: 2/3, 4/5, 6/7 ... ; even: 1/2, 3/4, 5/6 ...
        term *= cosine_squared * ((2 * k + 2) / (2 * k + 3) if odd else (2 * k + 1) / (2 * k + 2))
    return 2 / math.pi * (angle + math.sin(angle) * total) if odd else math.sin(angle) * total


def _incomplete_beta(x: float, a: float, b: float) -> float:
    """I(x; a, b), by its continued fraction (Abramowitz & Stegun 1964, 26.5.8), where that converges quickly."""
    if not 0.0 < x < 1.0:
        return max(0.0, min(1.0, x))
    if x > (a + 1) / (a + b + 2):
        return 1.0 - _incomplete_beta(1.0 - x, b, a)
    factor = math.lgamma(a + b) - math.lgamma(a) - math.lgamma(b) + a * math.log(x) + b * math.log1p(-x)
    # Convergents A(n) / B(n) with the same recurrence for both, scaled so that B(n) is 1 (Lentz 1976).
    above, below, value = 1.0, 0.0, 1.0
    for n in range(1, 1000):
        half = n // 2
        if n % 2:
            term = -(a + half) * (a + b + half) * x / ((a + n - 1) * (a + n))
        else:
            term = half * (b - half) * x / ((a + n - 1) * (a + n))
        above, below = 1.0 + term / above, 1.0 / (1.0 + term * below)
        value *= above * below
        if abs(above * below - 1.0) < 1e-15:
            break
    return math.exp(factor) / (a * value)
