"""`va.language_test` on policies that hear, are deaf, or are noisy."""

from __future__ import annotations

import numpy as np
import pytest

import vla_attention as va
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
    assert rows["opposite"]["num_episodes"] == 6
    assert found["calls"].height == 6 * 4
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
    changes = np.array([0] * 18 + [1] * 6)  # the same again and two paraphrases, the opposite
    assert rows["opposite"] == pytest.approx(np.sqrt(1 / np.mean(changes**2) / 2))


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
