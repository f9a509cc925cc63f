"""Intervals of tables: which units their episodes have, and means of items that not every episode has, such as words.

The input is a table with one row per (episode, item).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import polars as pl

from vla_attention.analyze.statistics.intervals import (
    DEFAULT_LEVEL,
    EpisodeStatistic,
    Estimate,
    estimates,
    geometric_mean_over_episodes,
    mean_over_episodes,
    named_interval,
    ratio_of_means_over_episodes,
)
from vla_attention.analyze.statistics.units import Estimand, Units

#: Columns of a row: of how many families its tasks are (null: none known), and what its intervals are about.
ABOUT_COLUMNS: dict[str, Any] = {"num_families": pl.Int64, "intervals": pl.String}
_TASK = "_task_of_suite"
#: Suite and number of a task.
TaskName = tuple[str, int]


@dataclass(frozen=True)
class Sampling:
    """What intervals over several tasks are about, and which tasks are related.

    Attributes:
        estimand: what was asked for.
        families: those of the tasks that have a known one; tasks of one family may be of different suites.
    """

    estimand: Estimand = Estimand.TASKS_LIKE_THESE
    families: Mapping[TaskName, str] = field(default_factory=dict)

    def units(self, table: pl.DataFrame) -> Units:
        """The units of the rows of a table with `suite` and `task_id`, not decided (`Units.decided`)."""
        numbered = table.select("suite", "task_id", task_number().alias(_TASK))
        names = numbered.unique(_TASK).sort(_TASK).select("suite", "task_id").rows()
        units = Units.of(np.arange(len(names)), self.estimand, [self.families.get(name, "") for name in names])
        return units.of_tasks(numbered[_TASK].to_numpy() - 1)


def task_number() -> pl.Expr:
    """The number of each row's task; task ids repeat between suites, so a task is a pair of both."""
    return pl.struct("suite", "task_id").rank("dense").cast(pl.Int64)


def about_row(units: Units) -> dict[str, Any]:
    """The values of `ABOUT_COLUMNS` of a row over units, which are not decided yet."""
    estimand = units.decided().estimand if units.num_tasks > 1 else Estimand.THESE_TASKS
    return {"num_families": units.num_families, "intervals": estimand.value}


def means_with_intervals(
    table: pl.DataFrame,
    by: Sequence[str],
    values: Mapping[str, tuple[float, float]],
    sampling: Sampling,
    level: float = DEFAULT_LEVEL,
    quotients: Mapping[str, tuple[str, str]] | None = None,
    nulls: Mapping[str, float] | None = None,
    geometric: Mapping[str, str] | None = None,
) -> pl.DataFrame:
    """Mean of each value for every item, over tasks of the tasks' means, with its interval (see `intervals`).

    The mean and the interval of an item use the episodes that have it. Values that are null or not finite are left out
    of their mean.

    Args:
        table: one row per (episode, item), with `suite` and `task_id`.
        by: the columns that identify an item.
        values: columns to average, with their natural limits (`intervals.NO_LIMITS`, `POSITIVE`, `SHARE`).
        sampling: what the intervals are about, and which tasks are related.
        level: level of the intervals.
        quotients: further columns, each the mean of one column / the mean of another over the episodes that have both.
        nulls: for some of the values or quotients, what they would be if nothing were there.
        geometric: further columns, each exp of the mean of a column of natural logarithms.

    Returns:
        One row per item in order of first appearance: `by`, `num_episodes`, `num_tasks`, `ABOUT_COLUMNS`, and per value
        or quotient `V`, `V_low`, `V_high` (null where there is none) and `V_episodes`, the number of episodes with a
        finite value; for those in `nulls` also `V_p`, the p-value of that null, not adjusted for the number of items.
    """
    quotients, nulls, geometric = quotients or {}, nulls or {}, geometric or {}
    names = (*values, *quotients, *geometric)
    schema: dict[str, Any] = {name: table.schema[name] for name in by}
    schema |= {"num_episodes": pl.Int64, "num_tasks": pl.Int64, **ABOUT_COLUMNS}
    for name in names:
        schema |= dict.fromkeys((name, f"{name}_low", f"{name}_high"), pl.Float64) | {f"{name}_episodes": pl.Int64}
    schema |= dict.fromkeys((f"{name}_p" for name in nulls), pl.Float64)
    if table.is_empty():
        return pl.DataFrame(schema=schema)
    whole = sampling.units(table)
    needed = dict.fromkeys([*values, *(name for pair in quotients.values() for name in pair), *geometric.values()])
    columns = {name: table[name].cast(pl.Float64).fill_null(float("nan")).to_numpy() for name in needed}
    items = table.select(by).with_row_index("_row").group_by(by, maintain_order=True).agg("_row")
    # Items whose episodes are of the same tasks, one by one, are computed together: there can be thousands.
    alike: dict[bytes, list[int]] = {}
    members = [rows.to_numpy().astype(np.intp) for rows in items["_row"]]
    for i, rows in enumerate(members):
        alike.setdefault(whole.tasks[rows].tobytes(), []).append(i)
    found: dict[int, dict[str, Any]] = {}
    for numbers in alike.values():
        at = np.stack([members[i] for i in numbers])  # (item, episode)
        given = whole.of_tasks(whole.tasks[at[0]])
        statistics = {name: mean_over_episodes(columns[name][at], limits) for name, limits in values.items()}
        for name, (above, below) in quotients.items():
            statistics[name] = ratio_of_means_over_episodes(columns[above][at], columns[below][at])
        for name, logs in geometric.items():
            statistics[name] = geometric_mean_over_episodes(columns[logs][at])
        each = iter(estimates(list(statistics.values()), given.decided()))
        about = {"num_episodes": at.shape[1], "num_tasks": given.num_tasks, **about_row(given)}
        rows_of = {i: dict(about) for i in numbers}
        for name, statistic in statistics.items():
            for row, (i, used) in enumerate(zip(numbers, statistic.used.sum(axis=1).tolist(), strict=True)):
                one = next(each)
                if 0 < used < at.shape[1]:  # families are counted of the episodes that are left
                    one = _of_what_is_left(statistic, row, given) or one
                rows_of[i] |= named_interval(name, one.value, one.interval(level)) | {f"{name}_episodes": used}
                if name in nulls:
                    rows_of[i][f"{name}_p"] = one.p_value(nulls[name])
        found |= rows_of
    made = pl.DataFrame(
        [found[i] for i in range(items.height)], schema={k: v for k, v in schema.items() if k not in by}
    )
    return pl.concat([items.drop("_row"), made], how="horizontal").select(*schema)


def _of_what_is_left(statistic: EpisodeStatistic, row: int, given: Units) -> Estimate | None:
    """The estimate about these tasks, where episodes that have a value are of fewer families than all; else None."""
    used = statistic.used[row]
    left = given.part(used)
    if left.decided().estimand == given.decided().estimand:
        return None
    part = EpisodeStatistic(
        statistic.numerator[row, used], statistic.denominator[row, used], used[used], statistic.exponentiate,
        statistic.limits,
    )  # fmt: skip
    return estimates([part], left.decided())[0]
