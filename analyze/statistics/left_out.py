"""Errors of a statistic to which an episode adds in several ways, by leaving out one unit at a time. Pure functions.

Where each episode is compared with other ones, these are shared: the differences of two episodes are then correlated,
and an interval over them is too short (in simulations of three tasks without anything to find, it named something in 8
to 26 % of them). What the statistic loses without an episode, or without a family of tasks, counts all that it adds
(jackknife: Efron & Tibshirani 1993, "An introduction to the bootstrap", chapter 11).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from vla_attention.analyze.statistics.units import Units

#: A change below this share of the statistic, or of 1, is rounding: the unit adds nothing.
_ROUNDING = 1e-9


def pseudo_values(statistic: Callable[[NDArray[np.bool_]], float], units: Units) -> NDArray[np.float64]:
    """A value for each episode whose mean over tasks is the statistic, and whose spread is the statistic's.

    Their mean and interval by `intervals.estimates`, with the same units, are those of the statistic. About tasks like
    these, one family is left out at a time, and a family of n of the T tasks has (T - n) / n times what the statistic
    loses; else one of a task's m episodes, which has T (m - 1) times that. An episode without which nothing changes
    is not used.

    Args:
        statistic: of the episodes that are kept, (episode,) bool; NaN where there is none.
        units: the episodes' tasks and families.

    Returns:
        (episode,) float64; NaN for episodes that are not used. Where there is no statistic without one of the units, or
        none of them changes it, the statistic itself for each, which gives no interval.
    """
    used = np.ones(len(units.tasks), dtype=bool)
    value = statistic(used)
    # What adds nothing is no unit: it would only add degrees of freedom.
    without = np.array([statistic(used & (np.arange(len(used)) != i)) for i in range(len(used))])
    used = ~(np.abs(without - value) <= _ROUNDING * max(1.0, abs(value)))
    if not np.isfinite(value) or not used.any():
        return np.full(len(used), value)
    found = np.full(len(used), np.nan)
    part, places = units.part(used).decided(), np.flatnonzero(used)
    if part.estimand.of_other_tasks and part.num_tasks > 1:
        size = np.bincount(part.clusters)
        left = np.empty(len(size))
        for i in range(len(size)):
            kept = np.ones(len(used), dtype=bool)
            kept[places[part.clusters[part.tasks] == i]] = False
            left[i] = statistic(kept)
        of_task = ((left.mean() - left) * (part.num_tasks - size) / size)[part.clusters]
        deviations = (of_task - of_task.mean())[part.tasks]
    else:
        size = np.bincount(part.tasks)
        mean = np.bincount(part.tasks, without[used]) / size
        deviations = part.num_tasks * (size - 1)[part.tasks] * (mean[part.tasks] - without[used])
    found[used] = value + (deviations if np.isfinite(deviations).all() else 0.0)
    return found
