"""Pseudo-values of a plain mean over tasks are its values; shared controls count."""

from __future__ import annotations

import numpy as np
import pytest

from vla_attention.analyze.statistics.intervals import estimates, mean_over_episodes
from vla_attention.analyze.statistics.left_out import pseudo_values
from vla_attention.analyze.statistics.units import Units

TASKS = np.repeat(np.arange(6), [3, 2, 4, 3, 2, 5])


def mean_of(values: np.ndarray):
    def mean(kept: np.ndarray) -> float:
        parts = [values[kept & (task == TASKS)] for task in range(6)]
        return float(np.mean([part.mean() for part in parts if len(part)]))

    return mean


@pytest.mark.parametrize("families", [None, list("aabcdd"), list("aabbbb")])
def test_a_plain_mean_has_the_interval_of_its_values(families):
    values = np.random.default_rng(1).normal(1.0, 1.0, len(TASKS))
    units = Units.of(TASKS, families=None if families is None else np.array(families)[TASKS]).decided()
    found = pseudo_values(mean_of(values), units)
    one, other = estimates([mean_over_episodes(values), mean_over_episodes(found)], units)
    assert other.value == pytest.approx(one.value)
    # With families of different sizes the means without one of them are not centred at the mean.
    assert other.interval() == pytest.approx(one.interval(), rel=1e-9 if families is None else 0.1)


def test_what_changes_nothing_is_not_used():
    values = np.random.default_rng(2).normal(size=len(TASKS))
    found = pseudo_values(lambda kept: mean_of(values)(kept | (TASKS > 4)), Units.of(TASKS))
    assert np.isnan(found).tolist() == (TASKS > 4).tolist()


def test_a_statistic_without_spread_or_that_needs_a_unit_has_no_interval():
    units = Units.of(TASKS)
    for statistic in (lambda kept: 2.0, lambda kept: 2.0 if kept.all() else float("nan")):
        found = pseudo_values(statistic, units)
        assert (found == 2.0).all()
        assert estimates([mean_over_episodes(found)], units)[0].interval() is None
