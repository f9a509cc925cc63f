"""Rates of an exchange against loops over planted rollouts, some of which do not count."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from vla_attention.analyze.core.behaviour import ALONE, SCHEMA
from vla_attention.analyze.core.exchanged import EXCHANGED, OWN, exchanged
from vla_attention.analyze.statistics.units import Sampling

SENTENCES = {0: "push the red cup", 1: "push the blue cup", 2: "lift the blue bowl to the left"}
#: Words of the sentences by kind.
WORDS = {
    "verb": ("push", "push", "lift"),
    "object": ("cup", "cup", "bowl"),
    "colour": ("red", "blue", "blue"),
    "place": ("", "", "left"),
}


@pytest.fixture(scope="module")
def rollouts() -> list[dict]:
    """Four of every told task in every scene: each did one of the sentences, or nothing; every fourth is left out."""
    generator, rows = np.random.default_rng(5), []
    for told in SENTENCES:
        for scene in SENTENCES:
            for number in range(4):
                did = [0, 1, 2, None][generator.integers(4)]
                left_out = [None, ALONE, None, "the told goal held at the beginning"][number]
                rows.append(
                    {
                        "suite": "made_up", "task_id": told, "told": SENTENCES[told], "told_goal": f"goal_{told}",
                        "scene_task_id": scene, "scene_instruction": SENTENCES[scene], "scene_goal": f"goal_{scene}",
                        "episode_index": 4 * scene + number, "did": None if did is None else SENTENCES[did],
                        "as_told": did == told, "followed": [None, True, False][generator.integers(3)],
                        "left_out": left_out,
                    }
                )  # fmt: skip
    return rows


@pytest.fixture(scope="module")
def found(rollouts):
    asked = pl.DataFrame(rollouts, schema_overrides={**SCHEMA, "left_out": pl.String})
    _, tables, _ = exchanged(asked, Sampling())
    return {table.name: table.frame for table in tables}


def over_tasks(values: list[tuple[int, float | None]]) -> float:
    """Mean over told tasks of their means, of the rollouts that have a value."""
    known = [(task, value) for task, value in values if value is not None]
    return float(np.mean([np.mean([value for own, value in known if own == task]) for task in {t for t, _ in known}]))


def counts(row: dict) -> bool:
    return row["left_out"] in (None, ALONE)


def did_scene(row: dict) -> bool:
    """Whether it reached the goal of the sentence that it was not told."""
    return row["did"] == row["scene_instruction"] and row["did"] != row["told"]


def test_rates_are_of_the_rollouts_that_count(rollouts, found):
    rates = {row["sentence"]: row for row in found["exchange"].iter_rows(named=True)}
    for sentence in (OWN, EXCHANGED):
        kept = [
            row for row in rollouts if counts(row) and (row["task_id"] == row["scene_task_id"]) == (sentence == OWN)
        ]
        row = rates[sentence]
        told = [(one["task_id"], float(one["did"] == one["told"])) for one in kept]
        seen = [(one["task_id"], None if one["followed"] is None else float(one["followed"])) for one in kept]
        assert row["num_episodes"] == len(kept)
        assert row["did_told"] == pytest.approx(over_tasks(told))
        assert row["right"] == sum(value for _, value in told)
        assert row["followed"] == pytest.approx(over_tasks(seen))
        assert row["seen"] == sum(value is not None for _, value in seen) < len(kept)
    instead = [(row["task_id"], float(did_scene(row))) for row in rollouts if counts(row)]
    others = [
        one
        for one, row in zip(instead, filter(counts, rollouts), strict=True)
        if row["task_id"] != row["scene_task_id"]
    ]
    assert rates[EXCHANGED]["did_scene"] == pytest.approx(over_tasks(others))
    assert rates[EXCHANGED]["scenes"] == sum(value for _, value in others) != rates[EXCHANGED]["right"]
    assert rates[OWN]["did_scene"] is None


def test_all_rollouts_right_have_an_exact_interval(rollouts):
    right = [row | {"did": row["told"], "as_told": True, "left_out": None} for row in rollouts]
    (finding,), _, _ = exchanged(pl.DataFrame(right, schema_overrides={**SCHEMA, "left_out": pl.String}), Sampling())
    n = sum(row["task_id"] != row["scene_task_id"] for row in rollouts)
    assert (finding.numbers["right"], finding.numbers["n"], finding.numbers["high"]) == (n, n, 1.0)
    assert finding.numbers["low"] == pytest.approx(0.025 ** (1 / n))


def test_words_are_compared_where_told_and_scene_differ(rollouts, found):
    number = {sentence: task for task, sentence in SENTENCES.items()}
    rows = {row["kind"]: row for row in found["exchange_kinds"].iter_rows(named=True)}
    assert rows.keys() == WORDS.keys()
    for kind, words in WORDS.items():
        kept = [row for row in rollouts if counts(row) and words[row["task_id"]] != words[row["scene_task_id"]]]
        done = [None if row["did"] is None else words[number[row["did"]]] for row in kept]
        for name, task in (("as_told", "task_id"), ("as_scene", "scene_task_id")):
            heard = [(row["task_id"], float(did == words[row[task]])) for row, did in zip(kept, done, strict=True)]
            assert rows[kind][name] == pytest.approx(over_tasks(heard)), (kind, name)
        assert rows[kind]["num_episodes"] == len(kept)


def test_cells_hold_the_rollouts_of_a_sentence_in_a_scene(rollouts, found):
    for cell in found["exchange_matrix"].iter_rows(named=True):
        own = [
            row
            for row in rollouts
            if (row["task_id"], row["scene_task_id"]) == (cell["task_id"], cell["scene_task_id"])
        ]
        assert cell["rollouts"] == len(own) == 4
        assert cell["counted"] == sum(map(counts, own)) == 3
        assert cell["did_told"] == sum(row["did"] == row["told"] for row in own)
        assert cell["did_scene"] == sum(map(did_scene, own))
        assert cell["nothing"] == sum(row["did"] is None for row in own)


def test_rollouts_that_do_not_count_have_their_own_reasons(rollouts):
    reasons = ["it names no goal", "it held at the beginning", "it held at the beginning"]
    rows = [
        {**row, "told_goal": goal, "left_out": reason}
        for row, reason, goal in zip(rollouts, reasons, (None, "a", "b"), strict=False)
    ]
    rows = [{**row, "scene_task_id": 1, "scene_goal": "goal_1"} for row in rows]
    (finding,), _, _ = exchanged(pl.DataFrame(rows, schema_overrides={**SCHEMA, "left_out": pl.String}), Sampling())
    assert "1 rollout (it names no goal)" in finding.limit
    assert "2 rollouts (it held at the beginning)" in finding.limit
