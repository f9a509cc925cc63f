"""What may be said after many looks: adjusted p-values, and when one of many items leads. Pure functions.

The largest of many estimates is large by selection too: among ten words that are read alike, one is always first. Two
tools answer this. `adjusted_p_values` bounds the expected share of false findings among those that are named
(Benjamini & Hochberg 1995, Journal of the Royal Statistical Society B 57). `leader` names an item only if it is above
every other one, each difference taken by itself; that the item was chosen by looking does not raise the rate of false
names above the level (Gutmann & Maymin 1987, "Is the selected population the best?", Annals of Statistics 15).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import ArrayLike, NDArray

from vla_attention.analyze.statistics.two_samples import mean_difference
from vla_attention.analyze.statistics.episode_intervals import Sampling
from vla_attention.analyze.statistics.intervals import Estimate, estimates, mean_over_episodes
from vla_attention.analyze.statistics.units import FEWEST_FAMILIES, Units

#: What identifies an episode in a table.
EPISODE_COLUMNS = ("suite", "task_id", "episode_index")
#: A name is printed when its p-value is at most this, divided by the number of names that a text could print.
NAMED_AT = 0.05
#: Their estimates take ten times the memory of the values: a few of thousands of words and heads at a time.
_ITEMS_TOGETHER = 64
FEWEST_TASKS = 3


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
    by_place: list[float | None] = [None] * len(p_values)
    for place, q in zip(order, adjusted, strict=True):
        by_place[known[place]] = float(q)
    return by_place


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
    means = [one.value for one in _estimates(table, range(table.shape[1]), units)]
    fewest, cluster_of = fewest_clusters(units), units.clusters[units.tasks]
    clusters_of_items = [len(np.unique(cluster_of[np.isfinite(column)])) for column in table.T]
    known = [i for i, mean in enumerate(means) if mean is not None and clusters_of_items[i] >= fewest]
    if len(known) < 2:
        return None
    highest = np.array([means[i] if i in known else np.nan for i in range(len(means))], dtype=np.float64)
    first = int(np.nanargmax(highest))
    others = [i for i in known if i != first]
    p_values, apart = [], []
    for gap, other in zip(_estimates(table, others, units, table[:, first]), others, strict=True):
        shared = len(np.unique(cluster_of[np.isfinite(table[:, first] - table[:, other])]))
        if shared < min(fewest, units.fewest_clusters):
            gap = _between_episodes(table[:, first], table[:, other], units)
            apart.append(other)
        p_values.append(_one_above(gap))
    missing = any(p is None for p in p_values)
    p_value = None if missing else max(p for p in p_values if p is not None)
    return Leader(first, float(highest[first]), p_value, len(known), tuple(apart))


def _estimates(
    table: NDArray[np.float64], items: Sequence[int], units: Units, first: NDArray[np.float64] | None = None
) -> Iterator[Estimate]:
    """Of the mean of each item, or of `first` - the item where this is given."""
    for start in range(0, len(items), _ITEMS_TOGETHER):
        values = table[:, items[start : start + _ITEMS_TOGETHER]]
        yield from estimates([mean_over_episodes((values if first is None else first[:, None] - values).T)], units)


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


def leader_of_table(
    table: Iterable[pl.DataFrame], item: Sequence[str], value: str, sampling: Sampling
) -> NamedLeader | None:
    """`leader` of a table in parts with one row per (episode, item), whose columns `item` name the items."""
    episodes: dict[tuple[Any, ...], int] = {}
    names: dict[tuple[Any, ...], int] = {}
    values = [
        (
            _numbers(part.select(EPISODE_COLUMNS), episodes),
            _numbers(part.select(item), names),
            part[value].cast(pl.Float64).fill_null(np.nan).to_numpy(),
        )
        for part in table
    ]
    if not names:
        return None
    wide = np.full((len(episodes), len(names)), np.nan)
    for of_episode, of_item, numbers in values:
        wide[of_episode, of_item] = numbers
    units = sampling.units(pl.DataFrame(list(episodes), schema=EPISODE_COLUMNS, orient="row")).decided()
    leading = leader(wide, units)
    if leading is None and units.families is not None:
        units = units.about_these_tasks()
        leading = leader(wide, units)
    if leading is None:
        return None
    first, *apart = (dict(zip(item, list(names)[i], strict=True)) for i in (leading.item, *leading.apart))
    return NamedLeader(first, leading, tuple(apart), units)


def _numbers(rows: pl.DataFrame, known: dict[tuple[Any, ...], int]) -> NDArray[np.int32]:
    """The number of every row among all different ones, in order of first appearance; new ones are added."""
    different = rows.unique(maintain_order=True)
    numbers = pl.Series("number", [known.setdefault(row, len(known)) for row in different.rows()], dtype=pl.Int32)
    numbered = different.with_columns(numbers.alias("_number"))
    joined = rows.join(numbered, on=rows.columns, how="left", nulls_equal=True, maintain_order="left")
    return joined["_number"].to_numpy()


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
    return mean_difference(np.concatenate([first, other]), is_first, units.repeated(2)).difference
