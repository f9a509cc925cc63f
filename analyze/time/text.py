"""The text of `vla-attention time`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import polars as pl

from vla_attention.analyze.measures.frames import LAYERS_AVG, layer_name
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.show.answer import Section
from vla_attention.analyze.show.findings import few_families_note, findings
from vla_attention.analyze.show.headings import interval_note, title, untrained_warning
from vla_attention.analyze.show.numbers import format_number, of_tasks, solved_text
from vla_attention.analyze.show.plot_text import shortened
from vla_attention.analyze.show.tables import Table, count, interval, number, percent, signed_estimate, texts
from vla_attention.analyze.statistics.intervals import DEFAULT_LEVEL
from vla_attention.analyze.statistics.units import FEWEST_FAMILIES, Units
from vla_attention.analyze.time.time_courses import (
    ALL,
    EPISODE_TIME,
    FAILURE,
    RATIO,
    SUCCESS,
    TimeCourses,
    TimeSettings,
)

#: Rows of the printed course; the table and the pictures have every bin.
_SHOWN = 10
#: Groups of the printed course.
_MOST_GROUPS = 5
#: Sentences that name quantities: at the gripper's closing, and of success against failure.
_SENTENCES = 2


def time_sections(question: Question, courses: TimeCourses, settings: TimeSettings) -> list[Section]:
    """The whole answer."""
    return [
        _header(question, courses),
        _course_section(courses, settings),
        _gripper_section(courses, settings, question.units),
        _outcomes_section(courses.outcomes, question.units),
        _counts_section(courses),
    ]


def _header(question: Question, courses: TimeCourses) -> Section:
    of = courses.autocorrelation
    known = of["success"].drop_nulls()
    solved = f"{int(known.sum())} successful" if len(known) == of.height else solved_text(of["success"])
    return Section(
        [
            title("TIME COURSES"),
            untrained_warning() if question.untrained else "",
            f"stores: {', '.join(str(store.path) for store in question.stores)}",
            f"{of_tasks(of.height, of.select('suite', 'task_id').n_unique())}, {solved}; "
            f"{layer_name(courses.layer, LAYERS_AVG)}; grouping '{question.grouping.name}'. "
            f"{interval_note(DEFAULT_LEVEL, question.units.words, 'pointwise')}",
            *question.remarks_on_intervals,
        ]
    )


def _course_section(courses: TimeCourses, settings: TimeSettings) -> Section:
    course = courses.course.filter(alignment=EPISODE_TIME, outcome=ALL)
    groups = [name for name in courses.quantities if name != RATIO][:_MOST_GROUPS]
    stride = max(1, -(-settings.num_bins // _SHOWN))
    rows = []
    for part in course.partition_by("position", maintain_order=True)[::stride]:
        of = {row["quantity"]: row for row in part.iter_rows(named=True)}
        rows.append(part.row(0, named=True) | of.get(RATIO, {}) | {f"of {name}": of[name]["value"] for name in groups})
    has_ratio = RATIO in courses.quantities
    columns = [
        texts("time", lambda row: f"{row['position_low']:.2f}-{row['position_high']:.2f}", left=True),
        *([number("ratio", "value"), interval(""), number("uniform", "uniform")] if has_ratio else []),
        *(percent(shortened(name, 12), f"of {name}") for name in groups),
    ]
    every = f" (one bin in {stride}; all are in the table)" if stride > 1 else ""
    ratio = "The ratio is a geometric mean over episodes, fractions are means; a" if has_ratio else "A"
    note = f"{ratio} value holds until the next replan."
    if courses.num_nonfinite:
        note += f" {courses.num_nonfinite} replans without a finite ratio take no part in its course."
    return Section([Table(columns, rows), note], f"OVER THE EPISODE'S TIME, 0 to 1{every}")


def _gripper_section(courses: TimeCourses, settings: TimeSettings, units: Units) -> Section:
    heading = "AT THE FIRST GRIPPER CLOSING"
    if courses.closing.is_empty():
        none = "The stores hold no actions of a gripper whose commands are known, so there is nothing to align at."
        return Section([none], heading)
    closed = courses.closing.drop_nulls("closing_replan")
    rule = (
        f"The gripper closes in {closed.height} of {courses.closing.height} episodes (the first replan one of whose "
        "executed actions has a last number above 0)"
    )
    if closed.is_empty():
        return Section([f"{rule}."], heading)
    rule += (
        f", at replan {format_number(_median(closed['closing_replan'].cast(pl.Float64)))} and episode time "
        f"{format_number(_median(closed['closing_time']))} in the median."
    )
    at_once = int((closed["closing_replan"] == 0).sum())
    if at_once:
        rule += f" In {at_once} of them it closes at the first replan, so that no replan lies before it."
    if not courses.change["num_episodes"].max():
        return Section([f"{rule} No episode shows both sides of a closing."], heading)

    def factor(name: str) -> Callable[[dict[str, Any]], str]:
        return lambda row: ("x " if row["quantity"] == RATIO else "") + format_number(row[name])

    columns = [
        texts("quantity", lambda row: shortened(row["quantity"], 40), left=True),
        texts("change", factor("change")),
        interval(""),
        texts("elsewhere", factor("placebo")),
        texts("beyond", factor("beyond")),
        interval("beyond"),
        number("q", "q"),
        count("episodes", "num_episodes"),
    ]
    named = findings(
        courses.change["q"].to_list(),
        courses.change["quantity"].to_list(),
        "quantity",
        "a change beyond that elsewhere",
        _SENTENCES,
    )
    note = (
        f"change: mean over at most {settings.window + 1} replans from the closing on, against at most "
        f"{settings.window} before it, within each episode (of the ratio a factor). elsewhere: the same at the other "
        "replans; beyond: without that, so that a steady drift is none. No causal claim: much else changes then. q: p "
        "of no change, or of none beyond (the larger), adjusted for the number of quantities (Benjamini-Hochberg)."
        f" {few_families_note(courses.change, 'quantity', units)}"
    )
    return Section([rule, Table(columns, courses.change.to_dicts()), named, note], heading)


def _outcomes_section(outcomes: pl.DataFrame, units: Units) -> Section:
    """Success against failure, from `TimeCourses.outcomes`."""
    heading = "SUCCESS AGAINST FAILURE  means of the episodes' means over replans"
    if outcomes["difference"].null_count() == outcomes.height:
        counts = outcomes.row(0, named=True)
        numbers = f"{counts[f'num_{SUCCESS}']} solved and {counts[f'num_{FAILURE}']} failed"
        said = f"Not compared: of the episodes, {numbers}; at least 2 of either are needed."
        if not counts[f"num_{SUCCESS}"] and not counts[f"num_{FAILURE}"]:
            said = "Not compared: the outcomes of the episodes are not known."
        return Section([said], heading)
    columns = [
        texts("quantity", lambda row: shortened(row["quantity"], 24), left=True),
        texts("n", lambda row: f"{row[f'num_{SUCCESS}']}/{row[f'num_{FAILURE}']}"),
        *signed_estimate("difference", "difference"),
        number("q", "difference_q"),
        *signed_estimate("in tasks", "within_tasks"),
        number("q", "within_tasks_q"),
    ]
    note = (
        "n: solved / failed episodes. difference: solved minus failed (for log2_ratio, 1 is a factor of 2). in tasks: "
        f"the same inside tasks ({max(outcomes['num_tasks_with_both'])} hold both outcomes), free of differences "
        "between tasks. q: p of no difference, adjusted for the number of quantities (Benjamini-Hochberg). The table "
        "also has Hedges' g and Cliff's delta."
    )
    if (outcomes["intervals"] != units.estimand.value).any():
        note += f" Solved or failed episodes are of fewer than {FEWEST_FAMILIES} families: about these tasks."
    named = findings(
        outcomes["within_tasks_q"].to_list(), outcomes["quantity"].to_list(), "quantity", "a difference", _SENTENCES
    )
    rows = outcomes.to_dicts()
    reasons = [f"{row['quantity']}: {row['note']}." for row in rows if row["note"]]
    said = f"Inside tasks: {named[0].lower()}{named[1:]}"
    return Section([Table(columns, rows), said, note, *reasons], heading)


def _counts_section(courses: TimeCourses) -> Section:
    table = courses.autocorrelation
    known = table.drop_nulls("effective_replans")
    heading = "INDEPENDENT REPLANS  how many an episode is worth"
    if known.is_empty():
        why = (
            f"Cannot be estimated in any of the {table.height} episodes: too few replans, no change, or ratios that "
            "are not finite."
        )
        return Section([why], heading)
    text = (
        f"{int(known['num_replans'].sum())} replans of {known.height} episodes are worth "
        f"{format_number(float(known['effective_replans'].sum()))} independent ones for {known['series'][0]} "
        "(integrated autocorrelation time "
        f"{format_number(_median(known['autocorrelation_time']))} replans in the median; initial positive sequence, "
        "Geyer 1992). In series this short that is an upper bound. No interval counts replans: the episode is the unit."
    )
    if known.height < table.height:
        left_out = table.height - known.height
        text += f" {left_out} of {table.height} episodes are left out: too few replans, no change, or gaps."
    return Section([text], heading)


def _median(column: pl.Series) -> float | None:
    value = column.median()
    return value if isinstance(value, float) else None
