"""Whether attention differs between solved and failed episodes, and along an episode: before and after the first touch.

What is compared, one by one: the ratio of a grouping, where it has one, and the attention per token to each group.
Differences are of logarithms, so that they are read as factors. Solved and failed episodes are compared within the
tasks that have both, as tasks that are hard look otherwise, too; parts of an episode within the episode.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
import polars as pl

from vla_attention.analyze.core.about import sides, with_interval, would_show
from vla_attention.analyze.core.axes import with_families
from vla_attention.analyze.core.estimate import estimate
from vla_attention.analyze.core.levels import Levels, groups_by, ratios_by
from vla_attention.analyze.core.result import Column, Finding, Table
from vla_attention.analyze.measures.tables import EPISODE_ID
from vla_attention.analyze.statistics.many_looks import SHOWN_AT, adjusted_p_values
from vla_attention.analyze.statistics.two_samples import mean_difference
from vla_attention.analyze.statistics.units import Sampling
from vla_attention.schemas.errors import plural

_OUTCOME, _TIME = "Do solved episodes look otherwise than failed ones?", "Does attention change in an episode?"
FIRST_CALL, BEFORE, AFTER = "at the first call", "before the touch", "after the touch"
HALVES = (FIRST_CALL, "in the first half", "in the second half")
#: Parts of an episode in their order, and what each is compared with.
_PARTS = (FIRST_CALL, BEFORE, AFTER)
_MOST_NAMED = 3


@dataclass(frozen=True)
class _Values:
    """Logarithms of the ratio and of the lifts of groups: `EPISODE_ID`, item, value, and the columns of the axes."""

    frame: pl.DataFrame
    #: The ratio's name; empty without one.
    ratio: str


def _values(levels: Levels, by: Collection[str]) -> _Values:
    columns = [*EPISODE_ID, "success", *(("replan", "env_step") if "replan" in by else ())]
    groups = groups_by(levels, by).select(*columns, item="group", value=pl.col("lift").log())
    if levels.grouping.ratio is None:
        return _Values(groups, "")
    name = " / ".join("+".join(side) for side in sides(levels.grouping))
    ratios = ratios_by(levels, by).select(*columns, item=pl.lit(name), value=pl.col("ratio").log())
    return _Values(pl.concat([ratios, groups]), name)


_MORE = "Record more episodes of each task. Outcomes that were not known are told with vla-attention store outcomes."


def of_outcome(levels: Levels) -> tuple[Finding, list[Table]]:
    """Solved against failed episodes, within the tasks that have both."""
    values = _values(levels, ())
    known = values.frame.drop_nulls("success").filter(pl.col("value").is_finite())
    both = known.filter(pl.col("success").n_unique().over("suite", "task_id", "item") == 2)
    tasks = both.select("suite", "task_id").n_unique()
    if both.is_empty():
        said = "No task has both solved and failed episodes: whether they differ cannot be told from how tasks differ."
        return Finding(
            said,
            _OUTCOME,
            {"tasks_with_both": 0},
            _MORE,
        ), []
    found = _differences(both, levels.question.sampling)
    numbers = {"tasks_with_both": tasks, "shown": found.filter(pl.col("q") <= SHOWN_AT).height}
    where = f"within the {tasks} tasks that have both" if tasks > 1 else "within the one task that has both"
    which = "as large in solved episodes as in failed ones", "as much per token in solved episodes as in failed ones"
    sentence, limit = _said(found, values.ratio, which, f"Solved and failed episodes {{}}, {where}")
    table = Table("solved_against_failed", found.drop("detectable"), _COMPARED, "Solved against failed")
    return Finding(sentence, _OUTCOME, numbers, limit), [table]


def _differences(both: pl.DataFrame, sampling: Sampling) -> pl.DataFrame:
    """Every item: means of solved and failed ones, their quotient with its interval, q over the items."""
    rows, p_values = [], []
    parts = both.partition_by("item", maintain_order=True)
    for part in parts:
        one = mean_difference(part["value"].to_numpy(), part["success"].to_numpy(), sampling.units(part))
        # A difference of logarithms is the logarithm of a quotient.
        factor = one.difference
        low, high = factor.interval() or (None, None)
        p_values.append(factor.p_value(0.0))
        tasks = part.select("suite", "task_id").n_unique()
        ends = (one.mean_first, one.mean_second, factor.value, low, high, factor.detectable(0.0, SHOWN_AT / len(parts)))
        rows.append((part["item"][0], *map(_exp, ends), one.num_first, one.num_second, tasks))
    names = ("solved", "failed", "times", "times_low", "times_high", "detectable")
    schema = {"item": pl.String, **dict.fromkeys(names, pl.Float64)}
    schema |= dict.fromkeys(("num_solved", "num_failed", "num_tasks"), pl.Int64)
    q = pl.Series("q", adjusted_p_values(p_values), pl.Float64)
    return pl.DataFrame(rows, schema=schema, orient="row").with_columns(q)


def _exp(value: float | None) -> float | None:
    return None if value is None else math.exp(min(value, 700.0))


def of_time(levels: Levels) -> tuple[Finding, list[Table]]:
    """The first call, before the first touch and after it; halves of the episodes where no touch is known."""
    values, question = _values(levels, ("replan",)), levels.question
    parts, untouched = _parts(levels)
    rows = values.frame.join(parts, on=[*EPISODE_ID, "replan"], how="inner", maintain_order="left")
    rows = rows.filter(pl.col("value").is_finite())
    cells = rows.group_by(*EPISODE_ID, "item", "part", maintain_order=True).agg(pl.mean("value"))
    names = [name for name in (*_PARTS, *HALVES[1:]) if name in cells["part"]]
    # Every part beside the one before it, of episodes that have both.
    before = dict(zip(names[1:], names, strict=False))
    pairs = cells.with_columns(old=pl.col("part").replace_strict(before, default=None, return_dtype=pl.String))
    earlier = cells.select(*EPISODE_ID, "item", old="part", earlier="value")
    pairs = pairs.join(earlier, on=[*EPISODE_ID, "item", "old"], how="left", maintain_order="left")
    pairs = pairs.with_columns(amount=pl.col("value").exp(), times=(pl.col("value") - pl.col("earlier")).exp())
    looks = pairs.filter(pl.col("times").is_not_null()).select("item", "part").n_unique()
    found = estimate(
        with_families(pairs, question.sampling), ["item", "part"], {"amount": "geometric", "times": "geometric"},
        question.sampling, {"times": 1.0}, detect={"times": SHOWN_AT / max(1, looks)},
    ).rename({"times_q": "q", "times_detectable": "detectable"})  # fmt: skip
    order = {name: place for place, name in enumerate(names)}
    items = {name: place for place, name in enumerate([values.ratio, *levels.grouping.names])}
    found = found.sort(pl.col("item").replace_strict(items), pl.col("part").replace_strict(order))
    main = values.ratio or next(name for name in levels.grouping.names if name in found["item"])
    of_main = [(row["part"], with_interval(row, "amount")) for row in found.filter(item=main).iter_rows(named=True)]
    what = f"The ratio {main}" if values.ratio else f"The attention per token to {main}, over an even share,"
    course = f"{what} is " + ", ".join(f"{amount} {part}" for part, amount in of_main)
    tested = found.drop_nulls("q")
    sentence, limit = _said(tested, values.ratio, ("as large {part} as {old}", "as much per token {part} as {old}"),
                            "Parts of the episodes {}", before)  # fmt: skip
    if untouched:
        limit = f"{limit} {plural(untouched, 'episode')} without a known touch left out.".lstrip()
    numbers = {"shown": tested.filter(pl.col("q") <= SHOWN_AT).height, "parts": len(names)}
    table = Table("by_parts", found.drop("detectable"), _COURSE, "Along an episode", rows=10)
    return Finding(f"{course}. {sentence}", _TIME, numbers, limit), [table]


def _parts(levels: Levels) -> tuple[pl.DataFrame, int]:
    """Of every call (`EPISODE_ID`, replan) the part of its episode; and how many episodes have no known touch."""
    rows, halves, untouched = [], [], 0
    for one in levels.measured:
        starts, num_steps = one.item.timing(one.env_step)
        steps = one.item.episode.attributes.steps
        moments = [moment for moment in (steps.first_touch if steps else ()) if moment is not None]
        untouched += not moments
        half = np.where(np.arange(len(starts)) == 0, 0, 1 + (2 * starts >= num_steps))
        halves += [(*one.item.key, replan, HALVES[part]) for replan, part in enumerate(half.tolist())]
        if moments:
            part_of = np.where(np.arange(len(starts)) == 0, 0, 1 + (starts >= min(moments)))
            rows += [(*one.item.key, replan, _PARTS[part]) for replan, part in enumerate(part_of.tolist())]
    schema = {"suite": pl.String, "task_id": pl.Int64, "episode_index": pl.Int64, "replan": pl.Int64, "part": pl.String}
    return pl.DataFrame(rows or halves, schema=schema, orient="row"), untouched if rows else 0


def _said(
    found: pl.DataFrame, ratio: str, which: Sequence[str], all_of: str, before: dict[str, str] | None = None
) -> tuple[str, str]:
    """What is shown of the compared items, and the limit: what would have been.

    which: the end of a sentence about the ratio, and about a group, with the names of a part and of the one before it.
    """
    shown = found.filter(pl.col("q") <= SHOWN_AT).sort("q", "item")
    if not shown.is_empty():
        said = []
        for row in shown.head(_MOST_NAMED).iter_rows(named=True):
            part = row.get("part", "")
            end = which[row["item"] != ratio].format(part=part, old=(before or {}).get(part, ""))
            subject = "the ratio is" if row["item"] == ratio else f"{row['item']} gets"
            said.append(f"{subject} {with_interval(row, 'times')} times {end}")
        rest = f" and {shown.height - _MOST_NAMED} more differ" if shown.height > _MOST_NAMED else ""
        head = all_of.format("differ")
        return f"{head}: {'; '.join(said)}{rest}.", ""
    tested = found.drop_nulls("q").height
    sentence = all_of.format(f"are not shown to differ ({plural(tested, 'comparison')})")
    known = found.drop_nulls("detectable").sort("detectable")
    if known.is_empty():
        return f"{sentence}.", "There is no interval: a task needs two episodes of each."
    return f"{sentence}.", would_show(known["detectable"][known.height // 2])


_AMOUNT = "attention per token over an even share; of the ratio, the ratio"
_Q = Column("q", "p", "q", "p of no difference, adjusted for the comparisons in this table (Benjamini-Hochberg)")
_COMPARED = [
    Column("item", "text", "ratio or group"),
    Column("solved", "number", "solved", _AMOUNT),
    Column("failed", "number", "failed"),
    Column("times", "factor", "solved / failed", "over the tasks that have both"),
    _Q,
    Column("num_solved", "count", "solved episodes"),
    Column("num_failed", "count", "failed ones"),
    Column("num_tasks", "count", "tasks"),
]
_COURSE = [
    Column("item", "text", "ratio or group"),
    Column("part", "text", "in the episode"),
    Column("amount", "factor", "times even", _AMOUNT),
    Column("times", "factor", "over the part before", "within episodes"),
    _Q,
    Column("num_episodes", "count", "episodes"),
]
