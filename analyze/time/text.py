"""The text of `vla-analyze time`."""

from __future__ import annotations

import polars as pl

from vla_attention.analyze.measures.frames import LAYERS_AVG, layer_name
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.show.findings import few_families_note, findings
from vla_attention.analyze.show.headings import (
    heading,
    interval_note,
    title,
    untrained_warning,
    wrap,
)
from vla_attention.analyze.show.numbers import (
    format_number,
    format_percent,
    format_signed,
    of_tasks,
    row_interval,
    solved_text,
)
from vla_attention.analyze.show.plot_text import shortened
from vla_attention.analyze.show.text_table import text_table
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


def time_text(question: Question, courses: TimeCourses, settings: TimeSettings) -> str:
    """The whole text, at most 100 columns wide."""
    parts = [_header(question, courses), _course_section(courses, settings)]
    parts += [
        _gripper_section(courses, settings, question.units),
        outcomes_section(courses.outcomes, question.units),
        _counts_section(courses),
    ]
    return "\n\n".join(parts) + "\n"


def _outcomes(success: pl.Series) -> str:
    known = success.drop_nulls()
    return f"{int(known.sum())} successful" if len(known) == len(success) else solved_text(success)


def _header(question: Question, courses: TimeCourses) -> str:
    of = courses.autocorrelation
    layer = layer_name(courses.layer, LAYERS_AVG)
    lines = title("TIME COURSES")
    if question.untrained:
        lines += wrap(untrained_warning())
    lines += wrap(f"stores: {', '.join(str(store.path) for store in question.stores)}")
    lines += wrap(
        f"{of_tasks(of.height, of.select('suite', 'task_id').n_unique())}, {_outcomes(of['success'])}; "
        f"{layer}; grouping '{question.grouping.name}'. "
        f"{interval_note(DEFAULT_LEVEL, question.units.words, 'pointwise')}"
    )
    for line in question.remarks_on_intervals:
        lines += wrap(line)
    return "\n".join(lines)


def _course_section(courses: TimeCourses, settings: TimeSettings) -> str:
    rows = courses.course.filter(pl.col("alignment") == EPISODE_TIME, pl.col("outcome") == ALL)
    groups = [name for name in courses.quantities if name != RATIO][:_MOST_GROUPS]
    header = ["time"] + (["ratio", "interval", "uniform"] if RATIO in courses.quantities else [])
    header += [shortened(name, 12) for name in groups]
    stride = max(1, -(-settings.num_bins // _SHOWN))
    body = []
    for part in rows.partition_by("position", maintain_order=True)[::stride]:
        of = {row["quantity"]: row for row in part.iter_rows(named=True)}
        first = part.row(0, named=True)
        cells = [f"{first['position_low']:.2f}-{first['position_high']:.2f}"]
        if RATIO in of:
            cells += [format_number(of[RATIO]["value"]), row_interval(of[RATIO]), format_number(of[RATIO]["uniform"])]
        body.append(cells + [format_percent(of[name]["value"]) for name in groups])
    every = f" (one bin in {stride}; all are in the table)" if stride > 1 else ""
    ratio = (
        "The ratio is a geometric mean over episodes, fractions are means; a" if RATIO in courses.quantities else "A"
    )
    note = f"{ratio} value holds until the next replan."
    if courses.num_nonfinite:
        note += f" {courses.num_nonfinite} replans without a finite ratio take no part in its course."
    return "\n".join(
        [heading(f"OVER THE EPISODE'S TIME, 0 to 1{every}"), text_table(header, body, left=(0,)), *wrap(note)]
    )


def _gripper_section(courses: TimeCourses, settings: TimeSettings, units: Units) -> str:
    above = heading("AT THE FIRST GRIPPER CLOSING")
    if courses.closing.is_empty():
        none = "The stores hold no actions of a gripper whose commands are known, so there is nothing to align at."
        return "\n".join([above, *wrap(none)])
    closed = courses.closing.drop_nulls("closing_replan")
    rule = (
        f"The gripper closes in {closed.height} of {courses.closing.height} episodes (the first replan one of whose "
        "executed actions has a last number above 0)"
    )
    if closed.is_empty():
        return "\n".join([above, *wrap(f"{rule}.")])
    rule += (
        f", at replan {format_number(closed['closing_replan'].cast(pl.Float64).median())} and episode time "  # type: ignore[arg-type]
        f"{format_number(closed['closing_time'].median())} in the median."  # type: ignore[arg-type]
    )
    at_once = int((closed["closing_replan"] == 0).sum())
    if at_once:
        rule += f" In {at_once} of them it closes at the first replan, so that no replan lies before it."
    body = [
        [
            shortened(row["quantity"], 40),
            ("x " if row["quantity"] == RATIO else "") + format_number(row["change"]),
            row_interval(row),
            *(("x " if row["quantity"] == RATIO else "") + format_number(row[name]) for name in ("placebo", "beyond")),
            row_interval(row, "beyond"),
            format_number(row["q"]),
            str(row["num_episodes"]),
        ]
        for row in courses.change.iter_rows(named=True)
    ]
    note = (
        f"change: mean over at most {settings.window + 1} replans from the closing on, against at most "
        f"{settings.window} before it, within each episode (of the ratio a factor). elsewhere: the same at the other "
        "replans; beyond: without that, so that a steady drift is none. No causal claim: much else changes then. q: p "
        "of no change, or of none beyond (the larger), adjusted for the number of quantities (Benjamini-Hochberg)."
    )
    if not courses.change["num_episodes"].max():
        return "\n".join([above, *wrap(f"{rule} No episode shows both sides of a closing.")])
    header = ["quantity", "change", "interval", "elsewhere", "beyond", "interval", "q", "episodes"]
    table = text_table(header, body, left=(0,))
    what = "a change beyond that elsewhere"
    named = findings(courses.change["q"].to_list(), courses.change["quantity"].to_list(), "quantity", what, _SENTENCES)
    note += f" {few_families_note(courses.change, 'quantity', units)}"
    return "\n".join([above, *wrap(rule), table, *wrap(named), *wrap(note)])


def outcomes_section(outcomes: pl.DataFrame, units: Units) -> str:
    """Success against failure as text, from `TimeCourses.outcomes`."""
    above = heading("SUCCESS AGAINST FAILURE  means of the episodes' means over replans")
    notes = [f"{row['quantity']}: {row['note']}." for row in outcomes.iter_rows(named=True) if row["note"]]
    if outcomes["difference"].null_count() == outcomes.height:
        counts = outcomes.row(0, named=True)
        numbers = f"{counts[f'num_{SUCCESS}']} solved and {counts[f'num_{FAILURE}']} failed"
        said = f"Not compared: of the episodes, {numbers}; at least 2 of either are needed."
        if not counts[f"num_{SUCCESS}"] and not counts[f"num_{FAILURE}"]:
            said = "Not compared: the outcomes of the episodes are not known."
        return "\n".join([above, *wrap(said)])
    header = ["quantity", "n", "difference", "interval", "q", "in tasks", "interval", "q"]
    body = [
        [
            shortened(row["quantity"], 24),
            f"{row[f'num_{SUCCESS}']}/{row[f'num_{FAILURE}']}",
            format_signed(row["difference"]),
            row_interval(row, "difference"),
            format_number(row["difference_q"]),
            format_signed(row["within_tasks"]),
            row_interval(row, "within_tasks"),
            format_number(row["within_tasks_q"]),
        ]
        for row in outcomes.iter_rows(named=True)
    ]
    both = max(outcomes["num_tasks_with_both"])
    note = (
        "n: solved / failed episodes. difference: solved minus failed (for log2_ratio, 1 is a factor of 2). in tasks: "
        f"the same inside tasks ({both} hold both outcomes), free of differences between tasks. q: p of no "
        "difference, adjusted for the number of quantities (Benjamini-Hochberg). The table also has Hedges' g and "
        "Cliff's delta."
    )
    if (outcomes["intervals"] != units.estimand.value).any():
        note += f" Solved or failed episodes are of fewer than {FEWEST_FAMILIES} families: about these tasks."
    named = findings(
        outcomes["within_tasks_q"].to_list(), outcomes["quantity"].to_list(), "quantity", "a difference", _SENTENCES
    )
    table = text_table(header, body, left=(0,))
    said = f"Inside tasks: {named[0].lower()}{named[1:]}"
    return "\n".join([above, table, *wrap(said), *wrap(note), *(w for n in notes for w in wrap(n))])


def _counts_section(courses: TimeCourses) -> str:
    table = courses.autocorrelation
    known = table.drop_nulls("effective_replans")
    above = heading("INDEPENDENT REPLANS  how many an episode is worth")
    if known.is_empty():
        why = (
            f"Cannot be estimated in any of the {table.height} episodes: too few replans, no change, or ratios that "
            "are not finite."
        )
        return "\n".join([above, *wrap(why)])
    series = known["series"][0]
    text = (
        f"{int(known['num_replans'].sum())} replans of {known.height} episodes are worth "
        f"{format_number(float(known['effective_replans'].sum()))} independent ones for {series} (integrated "
        f"autocorrelation time {format_number(_median(known['autocorrelation_time']))} replans in the median; initial "
        "positive sequence, Geyer 1992). In series this short that is an upper bound. No interval counts replans: the "
        "episode is the unit."
    )
    if known.height < table.height:
        left_out = table.height - known.height
        text += f" {left_out} of {table.height} episodes are left out: too few replans, no change, or gaps."
    return "\n".join([above, *wrap(text)])


def _median(column: pl.Series) -> float | None:
    value = column.median()
    return value if isinstance(value, float) else None
