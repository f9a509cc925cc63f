"""`va.language_test` on policies that hear, are deaf, or are noisy."""

from __future__ import annotations

import itertools

import numpy as np
import polars as pl
import pytest

import vla_attention as va
from benchmarks.null_stores import NOTHING_HEARD, says_it_hears
from vla_attention.schemas.errors import BadArgument

INPUTS = [(float(place), "go left") for place in range(6)]
KINDS = {"opposite": "go right", "paraphrased": ["move left", "left please"]}


def hears(noise: float):
    draws = np.random.default_rng(0)

    def call(place, told):
        plan = np.full((4, 2), [place, 1.0])
        plan[:, 0] += 3 * ("right" in told)
        return plan + noise * draws.normal(size=plan.shape)

    return call


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_a_policy_that_hears(noise, capsys):
    found = va.language_test(hears(noise), INPUTS, KINDS)
    rows = {row["kind"]: row for row in found["sentences"].iter_rows(named=True)}
    if not noise:  # the dimension that never moves is left out
        assert rows["opposite"]["change"] == pytest.approx(3 / np.arange(6.0).std())
        assert rows["paraphrased"]["change"] == 0
    else:
        assert rows["opposite"]["times_low"] > 1 > rows["paraphrased"]["times_low"]
        assert rows["opposite"]["times_q"] < 0.05 < rows["paraphrased"]["times_q"]
    assert found.findings[1].numbers["hears"] == 1
    assert rows["opposite"]["num_episodes"] == 6
    assert found["calls"].height == 6 * (3 + 3)  # the same sentence again after each other one
    assert found.findings[0].numbers["n"] == 18
    assert str(found) in capsys.readouterr().out


def test_a_deaf_policy_and_a_noisy_one():
    deaf = va.language_test(lambda place, told: np.full((1, 4, 2), place), INPUTS, ["go right"])
    assert [one.numbers["change"] for one in deaf.findings] == [0.0]
    draws = np.random.default_rng(1)
    noisy = va.language_test(lambda place, told: place + draws.normal(size=(4, 2)), INPUTS, ["go right"])
    row = noisy["sentences"].filter(kind="go right").row(0, named=True)
    assert row["times_low"] < 1 < row["times_high"]
    assert "times" in noisy.findings[0].numbers  # whether words get through is not said of what noise does as well


def test_a_dimension_that_only_the_words_move():
    found = va.language_test(lambda place, told: [[place, "right" in told]], INPUTS, KINDS)
    rows = {row["kind"]: row["change"] for row in found["sentences"].iter_rows(named=True)}
    assert rows["paraphrased"] == 0
    changes = np.array([0] * 30 + [1] * 6)  # the same again and two paraphrases, the opposite
    assert rows["opposite"] == pytest.approx(np.sqrt(1 / np.mean(changes**2) / 2))


@pytest.mark.parametrize("words", [0.0, 0.5])
def test_a_drift_is_no_hearing_and_a_change_beside_it_is_found(words):
    calls = itertools.count()

    def call(place, told):
        return np.full((4, 2), place + 0.1 * next(calls) + words * ("right" in told))

    found = va.language_test(call, INPUTS, KINDS)
    assert found.findings[-1].numbers.get("hears", 0) == (words > 0)
    # The drift is linear, so that the own sentence before and after gives what it would have done without.
    spread = np.std([place + 0.1 * 9 * number for number, (place, _) in enumerate(INPUTS)])
    row = found["sentences"].row(by_predicate=pl.col("kind") == "opposite", named=True)
    assert row["change"] == pytest.approx(words / spread, abs=1e-12)


@pytest.mark.parametrize("rest", [0.0, 1.0])
def test_rounding_is_no_hearing(rest):
    """Differences of 1e-5 by the sentence, also in a dimension that is the same for all inputs."""

    def call(place, told):
        return np.full((4, 3), [place, rest, 5.0]) * (1 + 1e-5 * len(told))

    found = va.language_test(call, INPUTS, KINDS)
    assert [one.numbers.get("hears") for one in found.findings] == [None]
    assert found.findings[0].numbers["change"] < 1e-3


@pytest.mark.parametrize(("policy", "kinds"), NOTHING_HEARD)
def test_what_hears_nothing_is_said_to_hear_in_at_most_five_of_a_hundred(policy, kinds):
    assert says_it_hears(policy, kinds, 40) <= 0.05


def test_one_of_six_kinds_that_is_heard_is_found():
    assert says_it_hears("noise", 6, 20, planted=2.0) > 0.8


@pytest.mark.parametrize(
    ("call", "inputs", "prompts"),
    [
        (hears(0), INPUTS[:1], ["x"]),
        (hears(0), INPUTS, []),
        (hears(0), INPUTS, ["go left"]),
        (hears(0), INPUTS, {"up": ["a", 3]}),
        (lambda place, told: {"actions": place}, INPUTS, ["x"]),
        (lambda place, told: np.full((len(told), 2), place), INPUTS, ["x"]),
        (lambda place, told: np.zeros((0, 2)), INPUTS, ["x"]),
        (lambda place, told: np.zeros((4, 2)), INPUTS, ["x"]),
        (lambda place, told: np.full((4, 2), np.nan), INPUTS, ["x"]),
        (lambda place, told: np.zeros((1 + int(place), 2)), INPUTS, ["x"]),
    ],
)
def test_what_cannot_be_tested(call, inputs, prompts):
    with pytest.raises(BadArgument):
        va.language_test(call, inputs, prompts)


@pytest.mark.parametrize(
    "inputs", [["go left", "go left"], [1.0, 2.0], [(1.0, "go left", 0), (2.0, "go left", 0)], [(1.0,)]]
)
def test_inputs_that_are_no_pairs_are_refused(inputs):
    with pytest.raises(BadArgument, match="pair"):
        va.language_test(hears(0.0), inputs, KINDS)
