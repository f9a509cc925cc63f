"""Exact tests and intervals of counts: instructions shuffled over episodes, shares, pairs. Pure functions."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from math import comb, exp, factorial, fsum, lgamma, log, log1p, prod

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Shuffled:
    """How often told and did agree, beside what they would if the told were shuffled among the episodes.

    Attributes:
        matches: episodes that did what they were told.
        expected: mean number of matches over all ways to shuffle.
        p_value: share of the ways to shuffle with at least as many matches (one-sided, exact).
        least_p: the p-value if every episode had done what it was told: what the data could show at most.
    """

    matches: int
    expected: float
    p_value: float
    least_p: float


def shuffled(told: Sequence[str], did: Sequence[str | None], strata: Sequence[str]) -> Shuffled:
    """Whether what is done goes with what is told, by shuffling the told among the episodes of each stratum.

    Of a policy that does not hear what it is told, every way to deal the instructions out among episodes that could all
    have been given them is as likely as the one that was used. The number of ways with k matches is counted by rook
    polynomials (Riordan 1958, "An introduction to combinatorial analysis", chapter 7): the cells (episode, instruction)
    that match are one rectangle for each instruction. So nothing is drawn, and neither order nor names matter.

    Args:
        told: (episode,) what each was told.
        did: (episode,) what each did; None: nothing that anybody was told.
        strata: (episode,) within which instructions are shuffled.
    """
    expected, least = 0.0, 1.0
    for counts, number in _counted(told, did, strata):
        expected += sum(of_told * of_did for of_told, of_did in counts) / number
        least *= prod(factorial(of_told) for of_told, _ in counts) / factorial(number)
    matches = sum(t == d for t, d in zip(told, did, strict=True))
    return Shuffled(matches, expected, float(_tails(told, did, strata)[matches]), least)


def share_shown(told: Sequence[str], strata: Sequence[str], level: float, power: float = 0.8) -> float | None:
    """The smallest share of right episodes that `shuffled` would show, with p at most `level`, in a run of this size.

    It is shown with this power, of a policy that reaches each goal as often as it is told; None where no share is
    enough.
    """
    enough = np.flatnonzero(_tails(told, told, strata) <= level)
    return _share_where(lambda share: at_least(int(enough[0]), len(told), share) >= power) if len(enough) else None


def _counted(
    told: Sequence[str], did: Sequence[str | None], strata: Sequence[str]
) -> Iterator[tuple[list[tuple[int, int]], int]]:
    """Of every stratum: how many episodes were told and did each thing that was told, and how many there are."""
    members: dict[str, list[tuple[str, str | None]]] = {}
    for t, d, stratum in zip(told, did, strata, strict=True):
        members.setdefault(stratum, []).append((t, d))
    for pairs in members.values():
        of_told, of_did = Counter(t for t, _ in pairs), Counter(d for _, d in pairs)
        yield [(number, of_did[name]) for name, number in sorted(of_told.items())], len(pairs)


def _tails(told: Sequence[str], did: Sequence[str | None], strata: Sequence[str]) -> NDArray[np.float64]:
    """Probability (matches,) of at least 0, 1, ... matches over all ways to shuffle."""
    chances = np.ones(1)
    for counts, number in sorted(_counted(told, did, strata)):  # equal strata in any order give equal digits
        chances = np.convolve(chances, _chances_of_matches(counts, number))
    # Rounding of the convolution must not make a certain event less than certain.
    tails: NDArray[np.float64] = np.minimum(1.0, np.cumsum(chances[::-1])[::-1] / chances.sum())
    return tails


def _chances_of_matches(counts: Iterable[tuple[int, int]], number: int) -> NDArray[np.float64]:
    """Probability (matches,) of 0, 1, ... matches, from how many of `number` episodes were told and did each thing."""
    rooks = [1]
    for told, did in counts:
        rooks = _product(rooks, [comb(told, j) * comb(did, j) * factorial(j) for j in range(min(told, did) + 1)])
    # sum over j of (ways in which j chosen matches hold, whatever else does) (x - 1)^j: the coefficient of x^k is the
    # number of ways with exactly k. By Horner's scheme in whole numbers: in floats the signs cancel all digits.
    ways = [chosen * factorial(number - j) for j, chosen in enumerate(rooks)]
    for first in range(len(ways) - 1):
        for k in range(len(ways) - 2, first - 1, -1):
            ways[k] -= ways[k + 1]
    return np.array([exactly / factorial(number) for exactly in ways])


def _product(one: Sequence[int], other: Sequence[int]) -> list[int]:
    """The product of polynomials with coefficients of 0 and more: as one product of the two numbers at x = 2^width."""
    width = (max(one) * max(other) * min(len(one), len(other))).bit_length()
    whole = sum(a << (width * i) for i, a in enumerate(one)) * sum(b << (width * i) for i, b in enumerate(other))
    mask = (1 << width) - 1
    return [(whole >> (width * i)) & mask for i in range(len(one) + len(other) - 1)]


def mcnemar(won: int, lost: int) -> float:
    """Two-sided exact p of pairs that differ being won as often as lost (McNemar 1947); 1 where no pair differs."""
    number = won + lost
    return float(min(1.0, 2 * sum(comb(number, k) for k in range(min(won, lost) + 1)) / 2**number))


def fewer(right: int, number: int, right_elsewhere: int, elsewhere: int) -> float:
    """One-sided exact p of `right` of `number` being a smaller share than that of the others (Fisher 1922)."""
    whole, hits = number + elsewhere, right + right_elsewhere
    ways = sum(comb(hits, k) * comb(whole - hits, number - k) for k in range(max(0, hits - elsewhere), right + 1))
    return ways / comb(whole, number)


def share_interval(right: int, number: int, level: float = 0.95) -> tuple[float, float]:
    """The exact interval of a share (Clopper & Pearson 1934), also where all or none of `number` >= 1 are right.

    It holds the truth at least as often as `level` says, also where tasks have shares of their own.
    """
    tail = (1.0 - level) / 2
    low = _share_where(lambda share: at_least(right, number, share) >= tail) if right else 0.0
    high = _share_where(lambda share: 1.0 - at_least(right + 1, number, share) <= tail) if right < number else 1.0
    return low, high


def at_least(right: int, number: int, share: float) -> float:
    """The chance that at least `right` of `number` episodes are right, each with the chance `share`."""
    if share in (0.0, 1.0):
        return float(right <= number * share)
    whole, (log_yes, log_no) = lgamma(number + 1), (log(share), log1p(-share))
    return fsum(
        exp(whole - lgamma(k + 1) - lgamma(number - k + 1) + k * log_yes + (number - k) * log_no)
        for k in range(right, number + 1)
    )


def _share_where(holds: Callable[[float], bool]) -> float:
    """The smallest share from which on something holds."""
    low, high = 0.0, 1.0
    for _ in range(40):
        middle = (low + high) / 2
        low, high = (low, middle) if holds(middle) else (middle, high)
    return high
