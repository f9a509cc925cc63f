"""The units of intervals: labels, parts, families that are not known, and what can be said about how many tasks."""

from __future__ import annotations

import numpy as np
import polars as pl

from vla_attention.analyze.core.estimate import estimate
from vla_attention.analyze.statistics.units import FEWEST_FAMILIES, Estimand, Sampling, Units

LIKE, THESE = Estimand.TASKS_LIKE_THESE, Estimand.THESE_TASKS
TASKS = [7, 7, 3, 5, 9, 9]
FAMILIES = ["b", "b", "a", "b", "", ""]


def test_tasks_are_numbered_and_a_task_without_a_family_is_one_of_its_own():
    units = Units.of(TASKS, families=FAMILIES)
    assert units.tasks.tolist() == [2, 2, 0, 1, 3, 3]
    assert len(set(units.clusters)) == units.num_families == 3
    assert units.clusters[1] == units.clusters[2] != units.clusters[0]
    assert units.num_tasks == 4
    part = units.part(np.array([False, False, True, False, True, True]))
    assert (part.num_tasks, part.num_families) == (2, 2)
    assert part.tasks.tolist() == [0, 1, 1]
    # Where no family is known, tasks are the units; so they are in a part of which none is known.
    assert Units.of(TASKS, families=["", "", "", "", "", ""]).families is None
    assert Units.of(TASKS).num_families is None
    assert units.part(np.array([False] * 4 + [True] * 2)).families is None


def test_families_count_where_intervals_are_about_tasks_like_these():
    assert Units.of(TASKS, THESE, FAMILIES).families is None
    assert Units.of(TASKS, THESE, FAMILIES).decided().estimand == THESE


def test_fewer_families_than_four_show_nothing_about_other_tasks():
    assert FEWEST_FAMILIES == 4
    few = Units.of(range(8), families=list("aabbccaa"))
    assert not few.has_enough_families
    assert few.decided().estimand == THESE
    assert few.decided().families is None
    assert few.decided().words == "these tasks"
    enough = Units.of(range(8), families=list("aabbccdd"))
    assert enough.decided() is enough
    assert enough.words == "tasks like these, by 4 families"
    # Two tasks of which no family is known are units, as in stores that know none.
    assert Units.of([0, 1]).decided().estimand == LIKE
    assert Units.of([0, 1]).words == "tasks like these"
    # Each of two classes needs as many.
    first = np.arange(8) < 6
    assert enough.decided(first, ~first).estimand == THESE
    assert enough.decided(np.ones(8, dtype=bool)).estimand == LIKE


def table(values):
    rows = [(suite, task, thing, value) for (suite, task, thing), several in values.items() for value in several]
    return pl.DataFrame(rows, schema=["suite", "task_id", "thing", "value"], orient="row")


def test_a_row_says_of_how_many_families_it_is_and_what_its_intervals_are_about():
    families = {("a", task): "abcd"[task % 4] for task in range(8)} | {("b", 0): "a"}
    given = table(
        {("a", task, "everywhere"): [1.0 + task, 2.0] for task in range(8)}
        | {("a", task, "somewhere"): [1.0, 2.0 + task] for task in (0, 4, 1)}
        | {("a", 3, "once"): [1.0, 2.0], ("b", 0, "elsewhere"): [1.0], ("c", 1, "elsewhere"): [2.0]}
    )
    found = estimate(given, ["thing"], {"value": "positive"}, Sampling(LIKE, families))
    assert found.select("thing", "num_tasks", "num_families", "intervals").rows() == [
        ("everywhere", 8, 4, "tasks-like-these"),
        ("somewhere", 3, 2, "these-tasks"),
        ("once", 1, 1, "these-tasks"),
        ("elsewhere", 2, 2, "these-tasks"),
    ]
    these = estimate(given, ["thing"], {"value": "positive"}, Sampling(THESE))
    assert found.filter(thing="somewhere")["value_low"].item() == these.filter(thing="somewhere")["value_low"].item()


def test_families_are_those_of_suites_together():
    """Tasks of one template in two suites are one family."""
    units = Sampling(LIKE, {("a", 0): "x", ("b", 0): "x", ("b", 1): "y"}).units(
        pl.DataFrame({"suite": ["a", "b", "b"], "task_id": [0, 0, 1]})
    )
    assert (units.num_tasks, units.num_families) == (3, 2)
    assert units.about == {"num_families": 2, "intervals": "these-tasks"}
