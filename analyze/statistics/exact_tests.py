"""Exact tests of counts: instructions that are shuffled over episodes, and pairs that differ. Pure functions."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import comb, factorial, prod

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
    chances, expected, least = np.ones(1), 0.0, 1.0
    for stratum in sorted(set(strata)):
        members = [(t, d) for t, d, s in zip(told, did, strata, strict=True) if s == stratum]
        names = sorted({t for t, _ in members})
        counts = [(sum(t == name for t, _ in members), sum(d == name for _, d in members)) for name in names]
        chances = np.convolve(chances, _chances_of_matches(counts, len(members)))
        expected += sum(of_told * of_did for of_told, of_did in counts) / len(members)
        least *= prod(factorial(of_told) for of_told, _ in counts) / factorial(len(members))
    matches = sum(t == d for t, d in zip(told, did, strict=True))
    # Rounding of the convolution must not make a certain event less than certain.
    p_value = min(1.0, float(chances[matches:].sum()) / float(chances.sum()))
    return Shuffled(matches, expected, p_value, least)


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
