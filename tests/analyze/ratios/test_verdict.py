"""The guide's word never stands where attention may be uniform, and never without its word for uniform attention."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.kit.made_up_steps import default_grouping
from tests.kit.questions import question_about
from vla_attention.analyze.ratios.analysis import analyse
from vla_attention.analyze.ratios.verdict import AS_UNIFORM, UNDECIDED, UNTRAINED, meanings, reading, verdict_sentence
from vla_attention.testing.stores import StoreSpec, write_store


def row_of(mean: float | None, low: float | None, high: float | None, uniform: float | None = 40.0) -> dict[str, Any]:
    """A row of the tasks table; the lift is the ratio over the uniform one."""
    values = {"geometric_mean": mean, "geometric_mean_low": low, "geometric_mean_high": high, "uniform_ratio": uniform}
    ends = ("geometric_mean", "geometric_mean_low", "geometric_mean_high")
    known = uniform is not None
    lifts = {
        name.replace("geometric_mean", "ratio_lift"): None
        if values[name] is None or not known
        else values[name] / uniform
        for name in ends
    }
    return values | lifts


@pytest.mark.parametrize(
    ("row", "untrained", "word"),
    [
        (row_of(80.0, 60.0, 100.0), False, "visual-dominant"),
        (row_of(20.0, 10.0, 30.0), False, "visual-dominant"),
        (row_of(0.3, 0.2, 0.4), False, "linguistic-dominant"),
        (row_of(1.0, 0.9, 1.1), False, "balanced"),
        (row_of(38.0, 30.0, 46.0), False, AS_UNIFORM),
        (row_of(38.0, 30.0, 39.0) | {"ratio_lift_high": 1.01}, False, AS_UNIFORM),
        (row_of(80.0, None, None), False, UNDECIDED),
        (row_of(80.0, 60.0, 100.0), True, UNTRAINED),
        (row_of(38.0, 30.0, 46.0), True, UNTRAINED),
        (row_of(None, None, None), False, "undefined"),
        (row_of(80.0, None, None, None), False, "visual-dominant"),
    ],
)
def test_a_word_is_withheld_without_training_without_interval_and_near_uniform_attention(row, untrained, word):
    assert reading(row, untrained) == word
    assert bool(meanings([word])) == (word in (UNTRAINED, AS_UNIFORM, UNDECIDED))


def test_the_verdict_stands_beside_that_of_uniform_attention() -> None:
    grouping = default_grouping()
    assert "uniform attention the same" in verdict_sentence(grouping, row_of(20.0, 10.0, 30.0), False)
    other = verdict_sentence(grouping, row_of(0.5, 0.4, 0.6), False)
    assert "'linguistic-dominant'" in other
    assert "'visual-dominant'" in other
    assert verdict_sentence(grouping, row_of(None, None, None), False) == ""
    assert verdict_sentence(replace(grouping, ratio=None), row_of(3.0, 2.0, 4.0), False) == ""
    assert "looks as uniform attention does" in verdict_sentence(grouping, row_of(38.0, 30.0, 46.0), False)
    for row, untrained in ((row_of(38.0, 30.0, 46.0), False), (row_of(80.0, 60.0, 100.0), True)):
        assert "dominant" not in verdict_sentence(grouping, row, untrained)


def test_the_printed_summary_of_uniform_attention_calls_nothing_dominant(tmp_path):
    """The made-up policy is untrained; with the same rows of a trained one, the interval decides."""

    def plant(task, episode, tokens, rows):
        noise = np.exp(np.random.default_rng([task, episode]).normal(0, 0.2, rows.shape))
        planted = noise * tokens.valid[:, None, None, None, None]
        return planted / planted.sum(axis=-1, keepdims=True)

    path = write_store(tmp_path / "a.zarr", spec=StoreSpec(plant_rows=plant, episodes=4))
    question = question_about(path)
    (store,) = question.stores
    trained = replace(store.attributes, policy=replace(store.attributes.policy, untrained=False))
    asked = replace(question, stores=(replace(store, attributes=trained),))
    for one, said in ((question, "untrained: the weights are random"), (asked, "looks as uniform attention does")):
        text = " ".join(analyse(one).summary.split())
        assert said in text
        table = text[text.index("RATIO") : text.index("mean, std, median")]
        assert "dominant" not in table
