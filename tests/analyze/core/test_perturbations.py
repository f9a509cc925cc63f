"""Means of suites against loops over planted episodes: every task weighs the same, however many episodes it has."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import polars as pl
import pytest

from vla_attention.analyze.core.perturbations import any_perturbed, by_suite

SUITES = {"libero_goal": "nothing", "libero_pro_goal_lan": "the sentence", "libero_pro_goal_swap": "places"}
#: Episodes of each task, and how often each of them is solved.
EPISODES, SOLVED = (1, 4, 7), (1.0, 0.5, 0.2)


def test_every_task_weighs_the_same():
    generator = np.random.default_rng(0)
    keys = [(s, task, i) for s in SUITES for task, count in enumerate(EPISODES) for i in range(count)]
    solved = {key: bool(generator.random() < SOLVED[key[1]]) for key in keys}
    did = {key: bool(generator.random() < 0.6) for key in keys if key[2] != 3}
    named = {key: float(generator.normal(key[1], 1.0)) for key in keys if key[2] != 2}
    question = SimpleNamespace(
        selected=[
            SimpleNamespace(key=key, episode=SimpleNamespace(attributes=SimpleNamespace(success=solved[key])))
            for key in keys
        ]
    )
    names = ["suite", "task_id", "episode_index"]
    asked = pl.DataFrame([(*key, value) for key, value in did.items()], [*names, "as_told"], orient="row")
    parts = {suite: [(*key, value) for key, value in named.items() if key[0] == suite] for suite in SUITES}
    shown = [
        SimpleNamespace(episodes=pl.DataFrame(of_suite, [*names, "log_ratio"], orient="row"))
        for of_suite in parts.values()
    ]

    def over_tasks(suite: str, values: dict) -> float:
        of_task = [[value for key, value in values.items() if key[:2] == (suite, task)] for task in range(3)]
        return float(np.mean([np.mean(of) for of in of_task]))

    rows = by_suite(question, asked, shown).rows_by_key("suite", named=True, unique=True)
    assert {suite: row["kind"] for suite, row in rows.items()} == SUITES
    for suite, row in rows.items():
        assert row["num_episodes"] == sum(EPISODES)
        assert row["solved"] == pytest.approx(over_tasks(suite, solved))
        assert row["did"] == pytest.approx(over_tasks(suite, did))
        assert row["named"] == pytest.approx(np.exp(over_tasks(suite, named)))
    assert by_suite(question, asked, [])["named"].null_count() == len(SUITES)


def test_what_libero_pro_changed_is_the_end_of_a_whole_name():
    assert any_perturbed(["libero_10", "libero_pro_10_task"])
    assert not any_perturbed(["libero_10", "libero_goal_object", "mine_libero_pro_goal_lan", "libero_pro_goal_lanes"])
