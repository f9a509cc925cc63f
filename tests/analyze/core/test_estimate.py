"""Means with intervals of things that only some episodes have."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest
import scipy.stats

from vla_attention.analyze.core.estimate import estimate
from vla_attention.analyze.statistics.intervals import POSITIVE, Estimand, estimates, mean_over_episodes
from vla_attention.analyze.statistics.units import Sampling, Units


def table_of(values: dict[tuple[str, int], list[float | None]]) -> pl.DataFrame:
    """Thing and task to one value per episode."""
    rows = [
        {"suite": "s", "task_id": task, "thing": thing, "value": value}
        for (thing, task), several in values.items()
        for value in several
    ]
    return pl.DataFrame(rows)


def test_a_thing_is_about_the_episodes_that_have_it():
    generator = np.random.default_rng(0)
    values = {("a", task): list(generator.gamma(4, size=3)) for task in range(4)} | {
        ("b", 2): list(generator.gamma(4, size=5))
    }
    found = estimate(table_of(values), ["thing"], {"value": "positive"}, Sampling(Estimand.THESE_TASKS), {"value": 4.0})
    assert found["thing"].to_list() == ["a", "b"]
    assert found.select("num_episodes", "num_tasks").rows() == [(12, 4), (5, 1)]
    p_values = []
    for row, thing in zip(found.iter_rows(named=True), ("a", "b"), strict=True):
        own = [(task, value) for (name, task), several in values.items() if name == thing for value in several]
        sample = [value for _, value in own]
        assert row["value"] == pytest.approx(np.mean(sample))
        expected = estimates(
            [mean_over_episodes(sample, POSITIVE)], Units.of([t for t, _ in own], Estimand.THESE_TASKS)
        )[0]
        interval = expected.interval()
        assert (row["value_low"], row["value_high"]) == pytest.approx((interval.low, interval.high))
        p_values.append(expected.p_value(4.0))
    assert found["value_q"].to_list() == pytest.approx(scipy.stats.false_discovery_control(p_values))


def test_the_interval_of_many_episodes_of_one_task_is_near_the_bootstrap_of_scipy():
    sample = np.random.default_rng(1).gamma(9, size=60)
    row = estimate(table_of({("a", 0): list(sample)}), ["thing"], {"value": "positive"}, Sampling()).row(0, named=True)
    theirs = scipy.stats.bootstrap((sample,), np.mean, method="percentile", rng=0).confidence_interval
    width = theirs.high - theirs.low
    assert abs(row["value_low"] - theirs.low) < 0.1 * width
    assert abs(row["value_high"] - theirs.high) < 0.1 * width


def test_what_is_unknown_takes_no_part():
    table = table_of({("a", 0): [1.0, None, 3.0, float("inf")], ("b", 0): [None, None], ("c", 0): [2.0]})
    a, b, c = estimate(table, ["thing"], {"value": "positive"}, Sampling()).iter_rows(named=True)
    assert (a["value"], a["num_episodes"]) == (2.0, 4)
    assert (b["value"], b["value_low"]) == (None, None)
    assert (c["value"], c["value_low"], c["value_high"]) == (2.0, None, None)
