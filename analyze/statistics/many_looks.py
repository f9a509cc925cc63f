"""What may be said after many looks: adjusted p-values, and when one of many items leads. Pure functions.

The largest of many estimates is large by selection too: among ten words that are read alike, one is always first. Two
tools answer this. `adjusted_p_values` bounds the expected share of false findings among those that are named
(Benjamini & Hochberg 1995, Journal of the Royal Statistical Society B 57). `leader` names an item only if it is above
every other one, each difference taken by itself; that the item was chosen by looking does not raise the rate of false
names above the level (Gutmann & Maymin 1987, "Is the selected population the best?", Annals of Statistics 15).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import ArrayLike, NDArray

from vla_attention.analyze.statistics.effect_sizes import FEWEST_TASKS, mean_difference
from vla_attention.analyze.statistics.episode_intervals import Sampling
from vla_attention.analyze.statistics.intervals import Estimate, estimates, mean_over_episodes
from vla_attention.analyze.statistics.units import FEWEST_FAMILIES, Units

#: What identifies an episode in a table.
EPISODE_COLUMNS = ("suite", "task_id", "episode_index")
#: A name is printed when its p-value is at most this, divided by the number of names that a text could print.
NAMED_AT = 0.05


def adjusted_p_values(p_values: Sequence[float | None]) -> list[float | None]:
    """Benjamini-Hochberg q of every p (None stays None and does not count as a look).

    q_(i) = min over j >= i of p_(j) * n / j, with p sorted upwards. Naming all items with q <= 0.05 makes at most 5 %
    of the named ones false on average, for independent and for positively dependent p-values.
    """
    known = [i for i, p in enumerate(p_values) if p is not None]
    p = np.array([p_values[i] for i in known], dtype=np.float64)
    order = np.argsort(p, kind="stable")
    scaled = p[order] * len(p) / np.arange(1, len(p) + 1)
    adjusted = np.minimum(np.minimum.accumulate(scaled[::-1])[::-1], 1.0)
    found: list[float | None] = [None] * len(p_values)
    for place, q in zip(order, adjusted, strict=True):
        found[known[place]] = float(q)
    return found


@dataclass(frozen=True)
class Leader:
    """The item with the highest mean.

    Attributes:
        item: its number.
        value: its mean over tasks.
        p_value: the largest p of its differences to the other items; None where one has none.
        num_items: how many items have a mean.
        apart: the items that it was compared with between episodes, because too few have both: these differences are
            between tasks too, with their other scenes and instructions.
    """

    item: int
    value: float
    p_value: float | None
    num_items: int
    apart: tuple[int, ...] = ()

    def is_named(self, num_names: int = 1) -> bool:
        """Whether it may be called the first, in a text that could name `num_names` leaders (Bonferroni)."""
        return self.p_value is not None and self.p_value <= NAMED_AT / num_names


def leader(values: ArrayLike, units: Units) -> Leader | None:
    """The item with the highest mean over tasks, and how surely it is above every other item.

    Two items are compared within the episodes that have both; where these are too few, between episodes. About tasks
    like these, items of fewer than `fewest_clusters` take no part: an item of one task shows nothing about others.

    Args:
        values: (episode, item); not finite where an episode lacks the item.
        units: the episodes' tasks and families, and what the differences are about.

    Returns:
        None without two items that have a mean.
    """
    table = np.asarray(values, dtype=np.float64)
    means = [one.value for one in estimates([mean_over_episodes(column) for column in table.T], units)]
    fewest, cluster_of = fewest_clusters(units), units.clusters[units.tasks]
    clusters_of_items = [len(np.unique(cluster_of[np.isfinite(column)])) for column in table.T]
    known = [i for i, mean in enumerate(means) if mean is not None and clusters_of_items[i] >= fewest]
    if len(known) < 2:
        return None
    highest = np.array([means[i] if i in known else np.nan for i in range(len(means))], dtype=np.float64)
    first = int(np.nanargmax(highest))
    others = [i for i in known if i != first]
    gaps = table[:, [first]] - table[:, others]
    paired = estimates([mean_over_episodes(gap) for gap in gaps.T], units)
    p_values, apart = [], []
    for column, gap, other in zip(gaps.T, paired, others, strict=True):
        shared = len(np.unique(cluster_of[np.isfinite(column)]))
        if shared < min(fewest, units.fewest_clusters):
            gap = _between_episodes(table[:, first], table[:, other], units)
            apart.append(other)
        p_values.append(_one_above(gap))
    missing = any(p is None for p in p_values)
    p_value = None if missing else max(p for p in p_values if p is not None)
    return Leader(first, float(highest[first]), p_value, len(known), tuple(apart))


@dataclass(frozen=True)
class NamedLeader:
    """A leader of a table.

    Attributes:
        name: its columns.
        found: the leader.
        apart: the columns of the items in `Leader.apart`.
        units: what the differences are about: these tasks, where fewer than two items are of enough families.
    """

    name: dict[str, Any]
    found: Leader
    apart: tuple[dict[str, Any], ...]
    units: Units


def leader_of_table(table: pl.DataFrame, item: Sequence[str], value: str, sampling: Sampling) -> NamedLeader | None:
    """`leader` of a table with one row per (episode, item), whose columns `item` name the items."""
    names = table.select(item).unique(maintain_order=True)
    episodes = table.select(EPISODE_COLUMNS).unique(maintain_order=True)
    place = names.with_row_index("_item")
    wide = np.full((episodes.height, names.height), np.nan)
    numbered = table.join(place, on=list(item), nulls_equal=True).join(
        episodes.with_row_index("_episode"), on=list(EPISODE_COLUMNS)
    )
    wide[numbered["_episode"].to_numpy(), numbered["_item"].to_numpy()] = (
        numbered[value].cast(pl.Float64).fill_null(np.nan).to_numpy()
    )
    units = sampling.units(episodes).decided()
    found = leader(wide, units)
    if found is None and units.families is not None:
        units = units.about_these_tasks()
        found = leader(wide, units)
    if found is None:
        return None
    apart = tuple(names.row(i, named=True) for i in found.apart)
    return NamedLeader(names.row(found.item, named=True), found, apart, units)


def fewest_clusters(units: Units) -> int:
    """In how many families an item must occur to take part in `leader`, or in how many tasks where these are the units.

    In all of up to three tasks. About these tasks, in one.
    """
    if not units.estimand.of_other_tasks:
        return 1
    return FEWEST_FAMILIES if units.families is not None else min(FEWEST_TASKS, units.num_tasks)


def _one_above(difference: Estimate) -> float | None:
    # Within the episodes that have both, the order may be the other way round.
    return 1.0 if difference.value is not None and difference.value <= 0 else difference.p_value(0.0)


def _between_episodes(first: NDArray[np.float64], other: NDArray[np.float64], units: Units) -> Estimate:
    is_first = np.repeat([True, False], len(first))
    return mean_difference(np.concatenate([first, other]), is_first, units.repeated(2))
