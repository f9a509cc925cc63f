"""How well groups of episodes are told apart from what they look like: ridge regression, cross-validated. Pure numpy.

A look is a block of numbers of each episode, as the pictures of one camera. With K its (episode, episode) kernel and
G = (K + l I)^-1, what kernel ridge regression makes of the indicators Y of the groups in a fold f, learned from all
other folds, is Y_f - G_ff^-1 (G Y)_f: one matrix for all ways to deal the groups out (Hastie, Tibshirani & Friedman
2009, "The elements of statistical learning", 7.10, for a fold instead of one episode). Which look is believed in a fold
is decided by the likelihood of the groups in the others.

Folds have equally many episodes of each group. Else a group that is rare where it is learned is frequent where it is
asked for, and a look that tells nothing is wrong more often than a guess. Episodes that look the same are in one fold:
a scene in which two things are told would be found with the other one. Groups are shuffled within folds.

Answers of one cross-validation are not independent: their mean varies more than that of as many coins does, as
episodes that happen to look alike are right or wrong together.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from statistics import NormalDist
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = NDArray[np.float64]
Labels: TypeAlias = NDArray[np.intp]

FOLDS, SHUFFLES = 5, 99
#: The ridge l, of kernels whose mean diagonal is 1.
_RIDGE = 0.3
#: Temperatures at which scores become probabilities; the last one leaves the shares of the groups as they are.
_TEMPERATURES = (*np.geomspace(0.02, 2.0, 13), np.inf)
#: By how much more (variance) the share of right answers varies than that of independent ones: 1.2 to 2.0 in simulated
#: pairs of 10 to 80 episodes. With this, 95% intervals cover 91 to 98% of what such pairs are told apart in.
_DEPENDENCE = 1.5
#: Columns of shuffled indicators that are multiplied at once.
_COLUMNS = 4096
#: Scores that differ by less are equal: products of single precision.
_ROUNDING = 1e-4
_NORMAL = NormalDist()


@dataclass(frozen=True)
class Look:
    """What episodes look like: (episode, number). curved: whether a Gaussian kernel is used, else products."""

    numbers: NDArray[np.floating]
    curved: bool = False

    def of(self, chosen: Labels) -> Look:
        """That of some of the episodes."""
        return Look(self.numbers[chosen], self.curved)

    def kernel(self) -> Array:
        """How alike episodes are, (episode, episode), with a mean diagonal of 1."""
        x = self.numbers.astype(np.float64)
        x -= x.mean(axis=0)
        products = x @ x.T
        squares = np.diag(products)
        mean = squares.mean()
        if mean <= 1e-12:
            return np.ones_like(products)
        if not self.curved:
            products /= mean
            return products
        kernel: Array = np.exp(-np.maximum(squares[:, None] + squares - 2 * products, 0.0) / (2 * mean))
        return kernel


@dataclass(frozen=True)
class Share:
    """A share of right answers, and with how many independent ones its error is: their number over `_DEPENDENCE`.

    Intervals and tests are Wilson's (1927, Journal of the American Statistical Association 22).
    """

    value: float
    effective: float

    @classmethod
    def of(cls, value: float, answers: float) -> Share:
        """The share of this many answers of one cross-validation."""
        return cls(float(value), answers / _DEPENDENCE)

    def interval(self, level: float = 0.95) -> tuple[float, float]:
        """The interval of the share."""
        z, n = _NORMAL.inv_cdf((1 + level) / 2), self.effective
        middle = (self.value + z * z / (2 * n)) / (1 + z * z / n)
        reach = z / (1 + z * z / n) * math.sqrt(self.value * (1 - self.value) / n + z * z / (4 * n * n))
        return max(0.0, middle - reach), min(1.0, middle + reach)

    def p_less(self, limit: float) -> float:
        """One-sided p of the truth being less than a limit."""
        return _NORMAL.cdf((self.value - limit) / math.sqrt(limit * (1 - limit) / self.effective))

    def p_more(self, limit: float) -> float:
        """One-sided p of the truth being more than a limit."""
        return 1.0 - self.p_less(limit)


@dataclass(frozen=True)
class Told:
    """How well groups are told.

    Attributes:
        scenes: how many episodes look different.
        right: (episode,) whether the episode's group was told, 1 or 0; of groups that it ties with, a part.
        by_look: the same with each look alone.
        gained: (episode,) what the look adds to the log probability of the episode's own group, in nats, over the
            groups' shares.
        entropy: of the groups' shares, in nats.
        shuffled: (shuffle,) part of the episodes whose group was told, with the groups shuffled.
        p: share of the shuffles, with the groups as they are among them, with at least as many right.
    """

    scenes: int
    right: NDArray[np.float32]
    by_look: Mapping[str, NDArray[np.float32]]
    gained: Array
    entropy: float
    shuffled: Array
    p: float

    @property
    def is_shown(self) -> bool:
        """Whether groups are told more often than in any of the ways to shuffle them: of null data, in 1 %."""
        return self.p * (SHUFFLES + 1) < 1.5


def tell(looks: Mapping[str, Look], groups: Labels) -> Told:
    """How well the groups (episode,), numbers from 0, are told from the looks."""
    rng = np.random.default_rng(0)
    same = _same(looks.values())
    folds = _folds(groups, same)
    dealt = np.stack([groups, *(_shuffled(groups, folds, rng) for _ in range(SHUFFLES))])
    number = int(groups.max()) + 1
    shares = np.bincount(groups, minlength=number) / len(groups)
    surprise = np.empty((len(looks), len(dealt), FOLDS))
    right = np.empty((len(looks), *dealt.shape), dtype=np.float32)
    scores = np.empty((len(looks), len(groups), number), dtype=np.float32)
    at_once = max(1, _COLUMNS // number)
    for i, look in enumerate(looks.values()):
        fitted = _Fitted.of(look, folds)
        for first in range(0, len(dealt), at_once):
            some = dealt[first : first + at_once]
            y = (some.T[..., None] == np.arange(number)).astype(np.float32)  # (episode, dealt, group)
            off, surprise[i, first : first + at_once] = fitted.errors(y - shares.astype(np.float32))
            said = y - off
            own = np.take_along_axis(said, some.T[..., None], axis=2)[..., 0]
            tied = said >= said.max(axis=2, keepdims=True) - _ROUNDING
            right[i, first : first + at_once] = ((own >= said.max(axis=2) - _ROUNDING) / tied.sum(axis=2)).T
            if first == 0:
                scores[i] = said[:, 0]
    best = surprise.argmin(axis=0)[None][:, :, folds]  # (1, dealt, episode)
    found = np.take_along_axis(right, best, axis=0)[0]
    believed = np.take_along_axis(scores, best[0, 0][None, :, None], axis=0)[0]
    rate = found.mean(axis=1)
    p = float((rate >= rate[0] - _ROUNDING).mean())
    by_look = dict(zip(looks, right[:, 0], strict=True))
    entropy = float(-(shares * np.log(shares)).sum())
    scenes = len(np.unique(same))
    return Told(
        scenes, found[0], by_look, _gained(believed.astype(np.float64), groups, shares, folds), entropy, rate[1:], p
    )


def tell_apart(looks: Sequence[Look], first: Labels, second: Labels) -> Share:
    """How well two groups of episodes, by their numbers, are told apart.

    It is the mean of both groups' shares of right answers, so that 0.5 is guessing. Its error is that of
    4 / (1 / n + 1 / m) answers where the groups have n and m episodes that look different.
    """
    chosen = np.concatenate([first, second])
    groups = np.repeat([0, 1], [len(first), len(second)])
    own = [look.of(chosen) for look in looks]
    same = _same(own)
    folds = _folds(groups, same)
    y = np.where(groups == 0, -1.0, 1.0)
    fits = [_Fitted.of(look, folds).errors((y - y.mean())[:, None, None]) for look in own]
    best = np.stack([surprise[0] for _, surprise in fits]).argmin(axis=0)  # (fold,)
    right = np.zeros(len(chosen))
    for fold in range(FOLDS):
        here, said = folds == fold, y - fits[best[fold]][0][:, 0, 0]
        # Where one group is larger, the border is in the middle of both groups' means in the other folds.
        of_groups = [said[~here & (groups == group)] for group in (0, 1)]
        if all(len(one) for one in of_groups):
            beyond = said[here] - np.mean([one.mean() for one in of_groups])
            right[here] = np.where(abs(beyond) < _ROUNDING, 0.5, (beyond > 0) == (groups[here] == 1))
        else:  # all of a group look the same: nothing is known of it
            right[here] = 0.5
    value = float(np.mean([right[groups == group].mean() for group in (0, 1)]))
    number, other = (len(np.unique(same[groups == group])) for group in (0, 1))
    return Share.of(value, 4 / (1 / number + 1 / other))


def enough(limit: float, tests: int, level: float, power: float = 0.8) -> int:
    """Episodes of each of two groups that look the same that show them to be told apart in less than a limit.

    In this part of such pairs, with so many pairs tested at once (Bonferroni).
    """
    z = _NORMAL.inv_cdf(1 - level / max(tests, 1)) * math.sqrt(limit * (1 - limit)) + _NORMAL.inv_cdf(power) / 2
    return math.ceil(_DEPENDENCE * (z / (limit - 0.5)) ** 2 / 2)


def _same(looks: Iterable[Look]) -> Labels:
    """Number of each episode's appearance, (episode,): those that look the same in every way share one."""
    rows = np.ascontiguousarray(np.concatenate([look.numbers for look in looks], axis=1))
    seen: dict[bytes, int] = {}
    return np.array([seen.setdefault(row.tobytes(), len(seen)) for row in rows], dtype=np.intp)


def _folds(groups: Labels, same: Labels) -> Labels:
    """The fold of each episode, (episode,): of what looks the same one, the most frequent appearances first."""
    order = np.argsort(same, kind="stable")
    alike = sorted(np.split(order, np.flatnonzero(np.diff(same[order])) + 1), key=lambda one: (-len(one), one[0]))
    counts = np.zeros((groups.max() + 1, FOLDS), dtype=np.intp)
    folds = np.empty(len(groups), dtype=np.intp)
    for members in alike:
        own = groups[members]
        # Where these groups have the fewest episodes yet; then where all have.
        fold = np.lexsort((counts.sum(axis=0), counts[np.unique(own)].sum(axis=0)))[0]
        folds[members] = fold
        np.add.at(counts, (own, fold), 1)
    return folds


def _shuffled(groups: Labels, folds: Labels, rng: np.random.Generator) -> Labels:
    dealt = groups.copy()
    for fold in range(FOLDS):
        here = np.flatnonzero(folds == fold)
        dealt[here] = groups[rng.permutation(here)]
    return dealt


@dataclass(frozen=True)
class _Fitted:
    """A look whose kernel was inverted once.

    inverse: G, (episode, episode). of_folds: the episodes of each fold and G_ff^-1. volume: log determinant of the
    inverse kernel of all other folds, (fold,).
    """

    inverse: NDArray[np.float32]
    of_folds: Sequence[tuple[Labels, NDArray[np.float32]]]
    volume: Array

    @classmethod
    def of(cls, look: Look, folds: Labels) -> _Fitted:
        """Invert the kernel of a look."""
        ridged = look.kernel() + _RIDGE * np.eye(len(folds))
        inverse = np.linalg.inv(ridged)
        whole, members, volume = -np.linalg.slogdet(ridged)[1], [], []
        for fold in range(FOLDS):
            here = np.flatnonzero(folds == fold)
            own = inverse[np.ix_(here, here)]
            members.append((here, np.linalg.inv(own).astype(np.float32)))
            volume.append(whole - np.linalg.slogdet(own)[1])
        return cls(inverse.astype(np.float32), members, np.array(volume))

    def errors(self, y: NDArray[np.floating]) -> tuple[NDArray[np.float32], Array]:
        """What y (episode, dealt, group) is off from what the other folds say of it, and a surprise (dealt, fold).

        The surprise of a fold is of the y in all other folds: minus twice the log likelihood of a Gaussian process with
        this kernel, at its best scale. By the chain rule it follows from the whole's and the fold's own.
        """
        y = y.astype(np.float32)
        flat = np.tensordot(self.inverse, y, 1)
        off, total = np.empty_like(flat), np.einsum("idk,idk->d", y, flat)
        surprise = np.empty((y.shape[1], FOLDS))
        for fold, (here, own) in enumerate(self.of_folds):
            off[here] = np.tensordot(own, flat[here], 1)
            rest = np.maximum(total - np.einsum("idk,idk->d", off[here], flat[here]), 1e-9)
            surprise[:, fold] = (len(y) - len(here)) * np.log(rest) - self.volume[fold]
        return off, surprise


def _by_fold(values: Array, folds: Labels) -> Array:
    """Sums over the episodes of each fold: (..., episode) -> (..., fold)."""
    return np.stack([values[..., folds == fold].sum(axis=-1) for fold in range(FOLDS)], axis=-1)


def _gained(scores: Array, groups: Labels, shares: Array, folds: Labels) -> Array:
    """What scores (episode, group) add to each episode's log probability; the temperature is of the other folds."""
    gains = np.empty((len(_TEMPERATURES), len(groups)))
    for i, temperature in enumerate(_TEMPERATURES):
        logs = (scores - scores.max(axis=1, keepdims=True)) / temperature + np.log(shares)
        own = logs[np.arange(len(groups)), groups]
        highest = logs.max(axis=1)
        gains[i] = own - highest - np.log(np.exp(logs - highest[:, None]).sum(axis=1)) - np.log(shares[groups])
    by_fold = _by_fold(gains, folds)  # (temperature, fold)
    best = (by_fold.sum(axis=-1, keepdims=True) - by_fold).argmax(axis=0)
    gained: Array = gains[best[folds], np.arange(len(groups))]
    return gained
