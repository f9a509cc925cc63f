"""Adjusted p-values and leaders: against scipy, and on samples in which nothing leads."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from vla_attention.analyze.statistics.episode_intervals import Sampling
from vla_attention.analyze.statistics.intervals import Estimand
from vla_attention.analyze.statistics.many_looks import adjusted_p_values, leader, leader_of_table
from vla_attention.analyze.statistics.units import Units


@given(st.lists(st.floats(0, 1), max_size=20))
def test_adjusted_p_values_are_those_of_scipy(p_values):
    expected = stats.false_discovery_control(p_values, method="bh") if p_values else []
    assert adjusted_p_values(p_values) == pytest.approx(list(expected))


def test_a_missing_p_value_is_not_a_look():
    assert adjusted_p_values([0.01, None, 0.04]) == [pytest.approx(0.02), None, pytest.approx(0.04)]
    assert adjusted_p_values([None]) == [None]


@pytest.mark.parametrize("num_items", [2, 8])
@pytest.mark.parametrize("num_tasks", [1, 6])
def test_where_all_items_are_alike_a_leader_is_seldom_named(num_items, num_tasks):
    generator = np.random.default_rng(num_items + num_tasks)
    tasks = np.arange(30) % num_tasks
    named = 0
    for _ in range(400):
        values = generator.normal(1.0, 0.3, (30, num_items)) + generator.normal(0, 1, (30, 1))
        named += leader(values, Units.of(tasks)).is_named()
    # Two items alike reach the level, more stay below it; three standard errors of 400 samples are 3.3 %.
    assert named / 400 <= 0.05 + 0.033 * (num_items == 2)


@pytest.mark.parametrize("estimand", Estimand)
def test_a_planted_leader_is_named_and_two_equal_leaders_are_not(estimand):
    generator = np.random.default_rng(0)
    tasks = np.arange(40) // 8
    values = generator.normal(1.0, 0.3, (40, 5))
    values[:, 3] += 0.8
    found = leader(values, Units.of(tasks, estimand))
    assert found.item == 3
    assert found.num_items == 5
    assert found.is_named(10)
    values[:, 1] = values[:, 3] + generator.normal(0, 0.3, 40)
    assert not leader(values, Units.of(tasks, estimand)).is_named()


def test_items_that_share_no_episode_are_compared_between_episodes():
    generator = np.random.default_rng(1)
    values = np.full((40, 2), np.nan)
    values[:20, 0] = generator.normal(1.0, 0.2, 20)
    values[20:, 1] = generator.normal(2.0, 0.2, 20)
    tasks = np.repeat([0, 1, 2, 3, 4, 5, 6, 7], 5)
    found = leader(values, Units.of(tasks))
    assert found.item == 1
    assert found.is_named()


def test_an_item_of_one_task_leads_nothing_about_tasks_like_these():
    generator = np.random.default_rng(4)
    tasks = np.repeat(np.arange(5), 6)
    values = generator.normal(1.0, 0.05, (30, 3))
    values[:, 2] = np.where(tasks == 0, 3.0 + generator.normal(0, 0.05, 30), np.nan)
    assert leader(values, Units.of(tasks)).item != 2
    assert leader(values, Units.of(tasks)).num_items == 2
    found = leader(values, Units.of(tasks, Estimand.THESE_TASKS))
    assert (found.item, found.num_items) == (2, 3)
    assert found.is_named()


def test_one_item_has_nothing_to_lead():
    assert leader(np.ones((4, 1)), Units.of(np.zeros(4))) is None
    assert leader(np.stack([np.ones(4), np.full(4, np.nan)], axis=1), Units.of(np.zeros(4))) is None
    # Without spread there is no p-value, and so no name.
    assert not leader(np.array([[1.0, 2.0]] * 4), Units.of(np.zeros(4))).is_named()


def test_the_leader_of_a_table_is_named_by_its_columns():
    generator = np.random.default_rng(2)
    rows = [
        {"suite": "s", "task_id": e % 3, "episode_index": e, "word": word, "head": None, "lift": lift}
        for e in range(12)
        for word, lift in (("bowl", generator.normal(3, 0.1)), ("the", generator.normal(1, 0.1)))
    ]
    table = pl.DataFrame(rows, schema_overrides={"head": pl.Int64})
    leading = leader_of_table([table], ("word", "head"), "lift", Sampling())
    assert leading.name == {"word": "bowl", "head": None}
    assert leading.apart == ()
    assert leading.found.is_named()
    assert leading.found.value == pytest.approx(table.filter(word="bowl")["lift"].mean())


def test_families_are_the_units_of_leaders():
    """Items of fewer than four families take no part, and families that differ keep a leader from being named."""
    generator = np.random.default_rng(6)
    tasks = np.repeat(np.arange(12), 3)
    families = tasks // 2
    values = generator.normal(1.0, 0.1, (36, 3))
    values[:, 1] += 0.5 + generator.normal(0, 0.1, 6)[families]
    values[:, 2] = np.where(families < 3, 5.0 + values[:, 2], np.nan)
    found = leader(values, Units.of(tasks, families=families.astype(str)))
    assert (found.item, found.num_items, found.apart) == (1, 2, ())
    assert found.is_named()
    # The same mean difference, but that of two families alone.
    values[:, 1] = values[:, 0] + np.where(
        families < 2, 1.5 + generator.normal(0, 0.1, 36), generator.normal(0, 0.1, 36)
    )
    assert not leader(values, Units.of(tasks, families=families.astype(str))).is_named()
    assert leader(values, Units.of(tasks, Estimand.THESE_TASKS)).item == 2


def test_where_one_item_alone_is_of_four_families_leaders_are_about_these_tasks():
    generator = np.random.default_rng(8)
    rows = [
        {"suite": "s", "task_id": e % 8, "episode_index": e, "word": word, "lift": generator.normal(lift, 0.1)}
        for e in range(40)
        for word, lift in (("the", 3.0), ("bowl", 1.0))
        if word == "the" or e % 8 < 4
    ]
    families = {("s", task): "abcd"[task // 2] for task in range(8)}
    leading = leader_of_table([pl.DataFrame(rows)], ("word",), "lift", Sampling(families=families))
    assert leading.name == {"word": "the"}
    assert leading.found.is_named()
    assert leading.units.words == "these tasks"
    everywhere = [row | {"word": "on"} for row in rows if row["word"] == "the"]
    leading = leader_of_table([pl.DataFrame(rows + everywhere)], ("word",), "lift", Sampling(families=families))
    assert (leading.found.num_items, leading.units.words) == (2, "tasks like these, by 4 families")


def test_a_leader_says_with_which_items_it_shares_too_few_episodes():
    generator = np.random.default_rng(7)
    tasks = np.repeat(np.arange(8), 4)
    values = generator.normal(1.0, 0.1, (32, 3))
    values[:16, 0] += 1.0
    values[16:, 0] = np.nan
    values[:16, 2] = np.nan
    found = leader(values, Units.of(tasks))
    assert (found.item, found.apart) == (0, (2,))
    assert leader(values, Units.of(tasks, Estimand.THESE_TASKS)).apart == (2,)
    values[12:16, 2] = 1.0  # in one task: its episodes alone would not be compared about tasks like these
    assert leader(values, Units.of(tasks)).apart == (2,)
    assert leader(values, Units.of(tasks, Estimand.THESE_TASKS)).apart == ()
