"""Groups told apart: held against fits without the fold, one at a time, and on data of which the answer is known."""

import math

import numpy as np
import pytest

from vla_attention.analyze.statistics import told_apart
from vla_attention.analyze.statistics.told_apart import FOLDS, Look, Share, enough, tell, tell_apart


def numbers(groups, strength, rng, dims=5):
    """One number that goes with the group, among others that do not."""
    x = rng.normal(size=(len(groups), dims))
    x[:, 0] += strength * groups
    return x / np.sqrt((x**2).sum(axis=1).mean())


@pytest.mark.parametrize("curved", [False, True])
def test_errors_and_likelihoods_are_those_of_fits_without_the_fold(curved):
    rng = np.random.default_rng(1)
    groups = np.repeat([0, 1, 2], 10)
    look = Look(numbers(groups, 1.0, rng), curved)
    folds = told_apart._folds(groups, np.arange(30))
    y = np.eye(3)[groups] - 1 / 3
    off, surprise = told_apart._Fitted.of(look, folds).errors(y[:, None, :])
    ridged = look.kernel() + told_apart._RIDGE * np.eye(30)
    for fold in range(FOLDS):
        here, rest = folds == fold, folds != fold
        weights = np.linalg.solve(ridged[np.ix_(rest, rest)], y[rest])
        assert np.allclose(off[here, 0], y[here] - ridged[np.ix_(here, rest)] @ weights, atol=1e-5)
        expected = rest.sum() * math.log((y[rest] * weights).sum()) + np.linalg.slogdet(ridged[np.ix_(rest, rest)])[1]
        assert surprise[0, fold] == pytest.approx(expected, abs=1e-3)


def test_folds_have_equally_many_of_each_group_and_hold_together_what_looks_the_same():
    groups = np.array([0] * 12 + [1] * 23)
    folds = told_apart._folds(groups, np.arange(35))
    for group in (0, 1):
        counts = np.bincount(folds[groups == group], minlength=FOLDS)
        assert counts.max() - counts.min() <= 1
    same = np.arange(35) // 2
    folds = told_apart._folds(groups, same)
    assert all(len(set(folds[same == one])) == 1 for one in range(17))


def test_what_a_look_tells_is_told_and_shuffled_groups_are_not():
    rng = np.random.default_rng(2)
    groups = np.repeat(np.arange(4), 15)
    looks = {"noise": Look(rng.normal(size=(60, 8))), "tells": Look(numbers(groups, 8.0, rng), curved=True)}
    found = tell(looks, groups)
    assert found.right.mean() > 0.95
    assert found.p == 1 / (told_apart.SHUFFLES + 1)
    assert found.by_look["noise"].mean() < 0.6 < 0.95 < found.by_look["tells"].mean()
    assert found.gained.mean() / found.entropy > 0.8
    assert found.entropy == pytest.approx(math.log(4))
    assert 0.1 < found.shuffled.mean() < 0.4


def test_a_look_without_anything_in_it_guesses():
    groups = np.repeat(np.arange(4), 10)
    found = tell({"black": Look(np.zeros((40, 3)))}, groups)
    assert found.right.mean() == pytest.approx(0.25)
    assert found.p == 1.0
    assert found.gained == pytest.approx(np.zeros(40), abs=1e-3)
    assert tell_apart([Look(np.zeros((20, 3)))], np.arange(5), np.arange(5, 20)).value == pytest.approx(0.5)


def test_the_same_pictures_under_two_sentences_are_guessed_not_mistaken():
    """Left out one at a time, each would be found by its twin under the other sentence: 0 % instead of 50 %."""
    scenes = np.random.default_rng(3).normal(size=(20, 6))
    looks = [Look(np.concatenate([scenes, scenes]))]
    assert tell_apart(looks, np.arange(20), np.arange(20, 40)).value == pytest.approx(0.5, abs=1e-3)


def test_groups_of_different_size_are_told_apart_and_a_guess_is_one_half():
    rng = np.random.default_rng(4)
    groups = np.repeat([0, 1], [8, 60])
    first, second = np.flatnonzero(groups == 0), np.flatnonzero(groups == 1)
    assert tell_apart([Look(numbers(groups, 20.0, rng))], first, second).value > 0.9
    guesses = [tell_apart([Look(rng.normal(size=(68, 5)))], first, second).value for _ in range(60)]
    assert np.mean(guesses) == pytest.approx(0.5, abs=0.06)


def test_intervals_are_the_shares_that_the_tests_do_not_refuse():
    share = Share.of(0.8, 60)
    low, high = share.interval()
    assert share.p_more(low) == pytest.approx(0.025)
    assert share.p_less(high) == pytest.approx(0.025)
    assert Share.of(1.0, 30).interval()[1] == 1.0
    assert Share.of(0.0, 30).interval()[0] == 0.0


def test_enough_episodes_show_what_fewer_do_not():
    """Counted from drawn answers, as many as count: four in five of such pairs are shown, and not much more."""
    number, limit, level = enough(0.75, 10, 0.05), 0.75, 0.005
    rng = np.random.default_rng(5)

    def shown(episodes):
        answers = round(2 * episodes / told_apart._DEPENDENCE)
        values = rng.binomial(answers, 0.5, 4000) / answers
        return np.mean([Share(float(value), answers).p_less(limit) <= level for value in values])

    assert 0.7 < shown(number) < 0.9
    assert shown(number // 2) < 0.6
