"""Looks or reads? Masses, fractions and ratios of a grouping; kept apart by layers, heads, time and more."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import replace
from typing import Any

import polars as pl

from vla_attention.analyze.core.about import about, enough, notes
from vla_attention.analyze.core.axes import COLUMNS, check_axes, columns_of, with_families
from vla_attention.analyze.core.by_axes import groups_by, ratios_by
from vla_attention.analyze.core.estimate import Scale, estimate
from vla_attention.analyze.core.levels import Levels, levels_of, overall, task_cells, task_groups
from vla_attention.analyze.core.result import Column, Figure, Finding, Result, Table
from vla_attention.analyze.measures.frames import LAYERS_AVG
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.measures.sinks import SinkRule, search_sinks, without_sinks as take_out
from vla_attention.analyze.published.results_writer import results_files
from vla_attention.schemas.errors import BadArgument, plural
from vla_attention.schemas.groupings.builtin_groupings import find_grouping
from vla_attention.schemas.groupings.grouping import Grouping

AVERAGE = pl.col("layer") == LAYERS_AVG
_SHARE = "part of the attention to all groups"
_EVEN = "per token, over what it would get if attention were spread evenly over all tokens"
_GROUPS = (
    Column("group", "text"),
    Column("fraction", "percent", "of the attention", _SHARE),
    Column("lift", "factor", "times even", _EVEN),
    Column("keys", "number", "tokens"),
)
_RATIO = (
    Column("geometric_mean", "factor", "ratio", "attention to one side over the other (geometric mean)"),
    Column("uniform_ratio", "number", "if even", "the ratio that evenly spread attention gives"),
    Column("ratio_lift", "factor", "token by token", "the ratio per token: ratio / ratio if even"),
)
_VALUES: dict[str, Scale] = {
    "ratio": "geometric",
    "uniform_ratio": "geometric",
    "ratio_lift": "geometric",
    "numerator_fraction": "share",
    "denominator_fraction": "share",
}


def analyze(question: Question, by: Collection[str] = (), without_sinks: SinkRule | None = None,
            save_viz: bool = False) -> Result:  # fmt: skip
    """Fractions and lifts of the groups, and their ratio, over all tasks and by task and layer; with `by` kept apart.

    Args:
        question: stores, selection and grouping.
        by: axes that are kept apart, of `axes.COLUMNS` and "camera".
        without_sinks: take the keys that are sinks by this rule out of every group; reads all rows.
        save_viz: also a picture per episode and layer.
    """
    check_axes(by, (*COLUMNS, "camera"))
    sinks = []
    if without_sinks is not None:
        search = search_sinks(question, without_sinks)
        question = take_out(question, search.sinks, without_sinks)
        sinks = [Table("sinks", search.sinks), Table("sink_heads", search.heads)]
    if "camera" in by:
        cameras = replace(find_grouping("cameras", question.vocabulary), ratio=None)
        question = replace(question, grouping=cameras)
    levels = levels_of(question, heads="head" in by)
    if by:
        return _kept_apart(levels, [axis for axis in by if axis != "camera"], by, sinks)
    episodes, of_groups = levels.episodes(), levels.episodes_groups()
    tasks, groups = task_cells(episodes, question.sampling), task_groups(of_groups, question.sampling)
    grouping, whole = question.grouping, overall(groups).filter(AVERAGE)
    rows = {row["group"]: row for row in whole.iter_rows(named=True)}
    found = [_of_fractions(question, rows)]
    cell = overall(tasks).filter(AVERAGE).row(0, named=True)
    if grouping.ratio is not None:
        found = _of_ratio(question, rows, cell)
    shown = [name for name in grouping.names if rows[name]["keys"] or rows[name]["mass"]]
    by_task = pl.col("scope") == "task"
    columns = _RATIO if grouping.ratio is not None else ()
    several = question.num_tasks > 1
    tables = [
        Table("tasks_groups", groups, _GROUPS, "Groups", _is_overall(groups) & AVERAGE & pl.col("group").is_in(shown)),
        *([Table("layers", tasks, (Column("layer", "text"), *columns), "Layers", _is_overall(tasks) & ~AVERAGE, 30, of="tasks")] if columns else []),
        Table("tasks", tasks, (Column("task_id", "count", "task"), *columns, Column("num_episodes", "count", "episodes"),
              Column("success_rate", "percent", "solved"), Column("instruction", "text")) if several else (), "Tasks", by_task & AVERAGE),
        Table("episodes", episodes), Table("episodes_groups", of_groups),
        Table("steps", levels.steps()), Table("steps_groups", levels.steps_groups()),
        Table("replans", levels.replans()), Table("replans_groups", levels.groups("replan", "layer")),
        *sinks,
    ]  # fmt: skip
    files = results_files(levels) if grouping.ratio is not None else {}
    return Result(
        "Looks or reads?" if grouping.compares_modalities else "Where attention goes",
        about(question),
        found,
        tables,
        _figures(levels, tasks, groups, episodes, shown),
        [*notes(question), *_notes(levels, cell)],
        files,
    )


def _is_overall(table: pl.DataFrame) -> pl.Expr:
    return pl.col("scope") == ("combined" if (table["scope"] == "combined").any() else "all")


def _of_fractions(question: Question, rows: Mapping[str, Mapping[str, Any]]) -> Finding:
    """The groups that get most attention, for a grouping without a ratio."""
    most = sorted((row for row in rows.values() if row["fraction"]), key=lambda row: -row["fraction"])
    said = ", ".join(f"{row['group']} {row['fraction']:.0%}" for row in most[:5])
    more = f" and {len(most) - 5} more groups" if len(most) > 5 else ""
    numbers = {row["group"]: row["fraction"] for row in most}
    return Finding(f"Of the attention: {said}{more}.", "Where does attention go?", numbers, enough(question))


def _of_ratio(question: Question, rows: Mapping[str, Mapping[str, Any]], cell: Mapping[str, Any]) -> list[Finding]:
    """How attention is divided between both sides, and token by token; then the ratio itself."""
    grouping = question.grouping
    assert grouping.ratio is not None
    compares = grouping.compares_modalities
    above, below = ("the pictures", "the text") if compares else map(" + ".join, (grouping.ratio.numerator, grouping.ratio.denominator))
    shares = [sum(rows[name]["fraction"] or 0.0 for name in side) for side in (grouping.ratio.numerator, grouping.ratio.denominator)]
    asks = "Looks or reads?" if compares else "Where does attention go?"
    sentence = f"{shares[0]:.0%} of the attention goes to {above}, {shares[1]:.0%} to {below}."
    numbers = {"numerator_fraction": shares[0], "denominator_fraction": shares[1],
               **{name: cell[name] for name in _NUMBERS}}  # fmt: skip
    limit = enough(question)
    if cell["geometric_mean"] is None:
        return [Finding(f"{sentence} In no episode do both get some, so there is no ratio.", asks, numbers, limit)]
    if cell["episodes_with_ratio"] < cell["num_episodes"]:
        some = f"{cell['episodes_with_ratio']} of {plural(cell['num_episodes'], 'episode')}"
        some += f" ({cell['tasks_with_ratio']} of {plural(cell['num_tasks'], 'task')})"
        limit = f"The ratio is of {some}: in the others one side got no attention. {limit}".rstrip()
    ratio = f"The ratio of {above} to {below} is {_number(cell, 'geometric_mean')}"
    if cell["ratio_lift"] is None or cell["uniform_ratio"] is None:
        return [Finding(f"{sentence} {ratio}.", asks, numbers, limit)]
    even = f"; evenly spread attention would give {cell['uniform_ratio']:.3g}, as there are as many more tokens"
    return [
        Finding(f"{sentence} {_token_by_token(question, cell, compares, above, below)}", asks, numbers, limit),
        Finding(f"{ratio}{even if cell['uniform_ratio'] > 1 else even.split(',')[0]}.", "The ratio?"),
    ]


_NUMBERS = ("geometric_mean", "geometric_mean_low", "geometric_mean_high", "uniform_ratio", "ratio_lift",
            "ratio_lift_low", "ratio_lift_high", "num_episodes", "num_tasks")  # fmt: skip


def _token_by_token(question: Question, cell: Mapping[str, Any], compares: bool, above: str, below: str) -> str:
    """Which side a single token gets more attention on, in words; nothing is claimed that the interval does not show."""
    lift, low, high = (cell[f"ratio_lift{end}"] for end in ("", "_low", "_high"))
    one, other = ("an image patch", "a token of the text") if compares else (f"one of {above}", f"one of {below}")
    verb = "looks"
    if lift < 1:  # the side that gets more stands first
        one, other, verb = other, one, "reads"
        lift, low, high = 1 / lift, None if high is None else 1 / high, None if low is None else 1 / low
    bounds = "" if low is None else f" [{low:.2g}, {high:.2g}]"
    gets = f"{one} gets {lift:.2g} times the attention of {other}{bounds}"
    if question.untrained or not compares:
        return f"Token by token, {gets}."
    if low is None:
        return f"Token by token, {gets}; without an interval nobody knows whether that is more."
    if low <= 1 <= high:
        return f"Token by token it is not shown to do either more: {gets}."
    return f"Token by token it {verb}: {gets}."


def _number(row: Mapping[str, Any], name: str) -> str:
    low, high = row[f"{name}_low"], row[f"{name}_high"]
    return f"{row[name]:.3g}" + ("" if low is None else f" [{low:.3g}, {high:.3g}]")


def _notes(levels: Levels, cell: Mapping[str, Any]) -> list[str]:
    """What the ratio leaves out or counts twice."""
    said = []
    if levels.grouping.overlap:
        said.append("The groups overlap: a token that two of them share counts in both.")
    if levels.grouping.ratio is not None and cell["num_nonfinite"]:
        said.append(
            f"{cell['num_nonfinite']} of {cell['num_replans']} ratios are infinite or undefined and in no mean of ratios; "
            f"tasks.parquet counts them."
        )
    return said


def _kept_apart(levels: Levels, axes: list[str], by: Collection[str], sinks: list[Table]) -> Result:
    """A row for each cell of the axes: the ratio, and the groups."""
    question, sampling = levels.question, levels.question.sampling
    columns = columns_of(axes)
    names = [column.name for column in columns]
    order = [*(["layer_number"] if "layer" in axes else []), *names]
    tables = []
    title = f"By {' and '.join(by)}"
    if levels.grouping.ratio is not None:
        rows = with_families(ratios_by(levels, axes), sampling)
        ratios = estimate(rows, order, _VALUES, sampling, {"ratio_lift": 1.0})
        counts = rows.group_by(order).agg(pl.col("num_nonfinite").sum())
        ratios = ratios.join(counts, on=order, how="left", nulls_equal=True, maintain_order="left").sort(order, nulls_last=True)
        shown = (*columns, Column("ratio", "factor", meaning=_RATIO[0].meaning), *_RATIO[1:],
                 Column("ratio_lift_q", "p", "q", "p of no difference token by token, adjusted for the number of rows"),
                 Column("num_episodes", "count", "episodes"))  # fmt: skip
        tables.append(Table("by", ratios, shown, title, rows=24))
    rows = with_families(groups_by(levels, axes), sampling)
    groups = estimate(rows, [*order, "group"], {"fraction": "share", "lift": "positive", "keys": "plain"}, sampling,
                      {"lift": 1.0}, [])  # fmt: skip
    groups = groups.drop("keys_low", "keys_high").sort(order, nulls_last=True, maintain_order=True)
    having = groups.filter(pl.col("fraction") > 0)["group"].unique()
    tables.append(Table("by_groups", groups, (*columns, *_GROUPS), f"{title}: groups", pl.col("group").is_in(having.implode()), 24))
    return Result(f"Where attention goes, by {' and '.join(by)}", about(question), [_apart(levels, tables, columns, by)],
                  [*tables, *sinks], _figures_by(levels, tables, axes), notes(question))  # fmt: skip


def _apart(levels: Levels, tables: list[Table], columns: list[Column], by: Collection[str]) -> Finding:
    """Which cells have the lowest and the highest ratio, or that a table tells."""
    limit = enough(levels.question)
    known = tables[0].shown
    if tables[0].name != "by" or (known := known.filter(pl.col("ratio").is_not_null())).height < 2:
        return Finding(f"A row for each group and {' and '.join(by)}.", "Where does attention go?", limit=limit)
    ends = [known.sort("ratio").row(i, named=True) for i in (0, -1)]
    low, high = (f"{_number(row, 'ratio')} ({_cell(row, columns)})" for row in ends)
    side = " / ".join(" + ".join(part) for part in _sides(levels.grouping))
    return Finding(f"The ratio {side} runs from {low} to {high}.", "Where does it look, where read?",
                   {"lowest": ends[0]["ratio"], "highest": ends[1]["ratio"]}, limit)  # fmt: skip


def _sides(grouping: Grouping) -> tuple[tuple[str, ...], tuple[str, ...]]:
    assert grouping.ratio is not None
    return grouping.ratio.numerator, grouping.ratio.denominator


def _cell(row: Mapping[str, Any], columns: list[Column]) -> str:
    return ", ".join(f"{column.title} {row[column.name]}" for column in columns if column.screen)


def _figures(levels: Levels, tasks: pl.DataFrame, groups: pl.DataFrame, episodes: pl.DataFrame, shown: list[str]) -> list[Figure]:
    return []


def _figures_by(levels: Levels, tables: list[Table], axes: list[str]) -> list[Figure]:
    return []


__all__ = ["BadArgument", "analyze", "math"]
