"""From one value per episode to what may be said: means over tasks, intervals by families, q after many looks."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any, Literal, TypeAlias

import numpy as np
import polars as pl

from vla_attention.analyze.measures.tables import float_values
from vla_attention.analyze.statistics.intervals import (
    NO_LIMITS,
    POSITIVE,
    SHARE,
    EpisodeStatistic,
    Estimate,
    estimates,
    geometric_mean_over_episodes,
    mean_over_episodes,
    ratio_of_means_over_episodes,
)
from vla_attention.analyze.statistics.many_looks import adjusted_p_values
from vla_attention.analyze.statistics.units import Sampling, Units

#: positive: masses, lifts, ratios; the interval is symmetric on the log scale. share: 0..1, log odds. correlation:
#: -1..1, in the same way. plain: as it is. geometric: a column of ratios, of which the mean of logarithms is taken.
Scale: TypeAlias = Literal["positive", "share", "correlation", "plain", "geometric"]
_LIMITS = {"positive": POSITIVE, "share": SHARE, "correlation": (-1.0, 1.0), "plain": NO_LIMITS}


def estimate(
    table: pl.DataFrame,
    by: Sequence[str],
    values: Mapping[str, Scale],
    sampling: Sampling,
    nulls: Mapping[str, float] | None = None,
    family: Collection[str] = (),
    quotients: Mapping[str, tuple[str, str]] | None = None,
    together: Collection[str] = (),
    detect: Mapping[str, float] | None = None,
) -> pl.DataFrame:
    """Mean of each value for every item of `by`, over tasks of the tasks' means, with its interval (see `intervals`).

    The mean and the interval of an item use the episodes that have it. Values that are null or not finite are left out
    of their mean.

    Args:
        table: one row per (episode, item), with `suite` and `task_id`.
        by: the columns that name an item.
        values: columns to average, each with its scale.
        sampling: what the intervals are about, and which tasks are related.
        nulls: for some values or quotients, what they would be if nothing were there.
        family: of `by`, the columns inside of whose values the looks are counted; all rows are one look's unless given.
        quotients: further columns, each the mean of one column / the mean of another over the episodes that have both.
        together: of `nulls`, those of which an item is named by any: their looks are counted together.
        detect: of `nulls`, the ones of which is asked what would have been shown, with the p at which one is.

    Returns:
        One row per item in order of first appearance: `by`, num_episodes, num_tasks, num_families, intervals; per value
        V, V_low, V_high (null where there is none), and of `nulls` V_q, the p of this null adjusted for the number of
        rows (Benjamini-Hochberg); of `detect` V_detectable, see `Estimate.detectable`.
    """
    nulls, quotients, detect = nulls or {}, quotients or {}, detect or {}
    needed = dict.fromkeys([*values, *(name for pair in quotients.values() for name in pair)])
    logs = {name: table[name].log() if values.get(name) == "geometric" else table[name] for name in needed}
    columns = {name: float_values(column) for name, column in logs.items()}
    whole = sampling.units(table)
    items = table.select(by).with_row_index("_row").group_by(by, maintain_order=True).agg("_row")
    # Items whose episodes are of the same tasks, one by one, are computed together: there can be thousands.
    alike: dict[bytes, list[int]] = {}
    members = [rows.to_numpy().astype(np.intp) for rows in items["_row"]]
    for i, rows in enumerate(members):
        alike.setdefault(whole.tasks[rows].tobytes(), []).append(i)
    found: list[dict[str, Any]] = [{} for _ in members]
    for numbers in alike.values():
        at = np.stack([members[i] for i in numbers])  # (item, episode)
        given = whole.of_tasks(whole.tasks[at[0]])
        statistics = {
            name: geometric_mean_over_episodes(columns[name][at])
            if scale == "geometric"
            else mean_over_episodes(columns[name][at], _LIMITS[scale])
            for name, scale in values.items()
        } | {
            name: ratio_of_means_over_episodes(columns[above][at], columns[below][at])
            for name, (above, below) in quotients.items()
        }
        each = iter(estimates(list(statistics.values()), given.decided()))
        for i in numbers:
            found[i] |= {"num_episodes": at.shape[1], "num_tasks": given.num_tasks, **given.about}
        for name, statistic in statistics.items():
            for place, i in enumerate(numbers):
                one = _of_what_is_left(statistic, place, given, next(each))
                found[i][name] = one.value
                found[i][f"{name}_low"], found[i][f"{name}_high"] = one.interval() or (None, None)
                if name in nulls:
                    found[i][f"{name}_p"] = one.p_value(nulls[name])
                if name in detect:
                    found[i][f"{name}_detectable"] = one.detectable(nulls[name], detect[name])
    schema: dict[str, Any] = {"num_episodes": pl.Int64, "num_tasks": pl.Int64, "num_families": pl.Int64,
                              "intervals": pl.String}  # fmt: skip
    for name in (*values, *quotients):
        more = [f"{name}_p"] * (name in nulls) + [f"{name}_detectable"] * (name in detect)
        ends = (name, f"{name}_low", f"{name}_high", *more)
        schema |= dict.fromkeys(ends, pl.Float64)
    rows = pl.concat([items.drop("_row"), pl.DataFrame(found, schema=schema)], how="horizontal")
    for name in nulls:
        if name not in together:
            rows = with_q(rows, [name], family)
    return with_q(rows, [*together], family) if together else rows


def _of_what_is_left(statistic: EpisodeStatistic, place: int, given: Units, one: Estimate) -> Estimate:
    """The estimate about these tasks, where episodes that have a value are of fewer families than all; else `one`."""
    used = statistic.used[place]
    left = given if used.all() or not used.any() else given.part(used)
    if left is given or left.decided().estimand == given.decided().estimand:
        return one
    part = EpisodeStatistic(
        statistic.numerator[place, used], statistic.denominator[place, used], used[used], statistic.exponentiate,
        statistic.limits,
    )  # fmt: skip
    return estimates([part], left.decided())[0]


def with_q(table: pl.DataFrame, names: Sequence[str], family: Collection[str] = ()) -> pl.DataFrame:
    """The table with NAME_q in the place of NAME_p, adjusted for the looks of all names in all rows, or by `family`."""
    parts = table.partition_by(*family, maintain_order=True) if family else [table]
    adjusted = []
    for part in parts:
        p_values = [p for name in names for p in part[f"{name}_p"].to_list()]
        by_name = np.array(adjusted_p_values(p_values), dtype=object).reshape(len(names), part.height)
        q_values = [pl.Series(f"{name}_q", list(of), pl.Float64) for name, of in zip(names, by_name, strict=True)]
        adjusted.append(part.with_columns(q_values).drop(f"{name}_p" for name in names))
    return pl.concat(adjusted) if adjusted else table.rename({f"{name}_p": f"{name}_q" for name in names})
