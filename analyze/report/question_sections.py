"""Sections with the answers of other commands: sinks (`heads`), the course of episodes (`time`), `words`, `objects`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import polars as pl

from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.measures.sink_kinds import SMALL_VALUES, kind_name
from vla_attention.analyze.measures.sinks import SinkRule, SinkSearch, cannot_fire, merged_sinks
from vla_attention.analyze.objects.object_attention import object_tables
from vla_attention.analyze.objects.object_settings import ObjectSettings
from vla_attention.analyze.objects.object_study import ObjectStudy
from vla_attention.analyze.objects.object_views import ALL_CAMERAS
from vla_attention.analyze.objects.plot_object_shares import plot_object_shares
from vla_attention.analyze.objects.text import followed_sentence
from vla_attention.analyze.ratios.analysis import Analysis
from vla_attention.analyze.report.pictures import diagram_of, drawn
from vla_attention.analyze.report.section_parts import (
    Paragraph,
    Section,
    Table,
    count_cell,
    interval_cell,
    number_cell,
    percent_cell,
    text_cell,
)
from vla_attention.analyze.show.findings import few_families_note
from vla_attention.analyze.show.numbers import format_number, format_percent, interval_name
from vla_attention.analyze.statistics.intervals import DEFAULT_LEVEL
from vla_attention.analyze.time.plot_time_course import plot_time_courses
from vla_attention.analyze.time.time_courses import time_courses
from vla_attention.analyze.words.plot_word_bars import plot_word_bars
from vla_attention.analyze.words.text import leading_sentence
from vla_attention.analyze.words.word_study import study_words
from vla_attention.schemas.errors import UserError

#: Rows of the tables of sinks and objects; the rows after these are small, and the commands print them.
_MOST_ROWS = 30
_INTERVAL = interval_name(DEFAULT_LEVEL)


def time_section(analysis: Analysis, folder: Path) -> Section | None:
    """The ratio over an episode, and around the first closing of the gripper; None when episodes have one replan."""
    if analysis.replans.cells["replan"].max() == 0:
        return None
    courses = time_courses(analysis.question, replans=analysis.replans)
    files = plot_time_courses(courses, analysis.grouping, folder)
    diagrams = []
    for stem, what in (
        ("time_course", "Over the course of an episode, from its first replan (0) to its end (1)."),
        ("time_course_gripper", "Before and after the gripper first closes."),
    ):
        own = [path for path in files if path.stem == stem]
        if own:
            alternative = f"Lines with bands for their intervals: {what[0].lower()}{what[1:]}"
            caption = f"{what} Bands are pointwise {_INTERVAL}s."
            diagrams.append(diagram_of(own, alternative, caption))
    return Section("time", "Over time", diagrams)


def sink_section(search: SinkSearch) -> Section:
    """Keys that take far more than their share in a head, by the default rule."""
    sinks, beyond = merged_sinks(search.sinks), cannot_fire(search.num_valid, SinkRule())
    explanation = Paragraph(
        f"A sink is a key that takes {SinkRule()}; keys of the policy's own actions are not counted. Trained "
        "transformers put attention that nothing needs on a few keys without content, often the first one, whose "
        "values may be near zero; a key of a word or a patch may be what a head looks for. A mass includes both. "
        f"{beyond}".rstrip()
    )
    if sinks.is_empty():
        return Section("sinks", "Sinks", [explanation, Paragraph("No key is one here.")])
    shown, heaviest = sinks.head(_MOST_ROWS), sinks.row(0, named=True)
    rows = [
        [
            text_cell(row["description"]),
            text_cell(row["role"]),
            count_cell(row["num_tasks"]),
            percent_cell(row["heads_share"]),
            percent_cell(row["heads_by_mass_share"]),
            percent_cell(row["share_of_rows"]),
            percent_cell(row["mean_mass"]),
            number_cell(row["times_uniform"]),
            text_cell(kind_name(row["value_ratio"])),
        ]
        for row in shown.iter_rows(named=True)
    ]
    found = (
        f"{'One key is a sink' if sinks.height == 1 else f'{sinks.height} keys are sinks'} here; the first, "
        f"{heaviest['description']}, takes {format_percent(heaviest['mean_mass'])} of the attention to valid keys. "
        "vla-analyze ratios --without-sinks computes everything without those of many heads. Values: what the key adds "
        f"per unit of mass, beside all other keys (small: less than {SMALL_VALUES:g} of it; ?: it cannot be told)."
    )
    left = sinks.height - len(rows)
    caption = f"Sinks, the first {len(rows)}; vla-analyze heads lists {left} more" if left else "Sinks"
    header = ["key", "role", "tasks", "heads %", "heads by mass %", "rows %", "mass %", "times uniform", "values"]
    return Section("sinks", "Sinks", [explanation, Paragraph(found), Table(caption, header, rows)])


def word_section(question: Question, folder: Path) -> Section:
    """Which words are read: at the site that was chosen, or without a choice at the site that reads the instruction."""
    # Words need no groups, and another site may not have the keys of the question's groups.
    settings = replace(question.settings, grouping=None, groups=(), ratio=None)
    try:
        study = study_words(question.stores, settings)
    except UserError as error:
        return Section("words", "Words", [Paragraph(str(error))])
    of_words = study.summary.filter(pl.col("kind") == "word")
    diagram = drawn(
        lambda where: plot_word_bars(study.summary, where, study.layer),
        folder,
        f"Bars of the words' lifts, highest first: {_named(of_words.head(5), 'lift') or 'none'}.",
        f"Words by lift, site {study.question.site}: mass over what uniform attention gives; 1 is uniform attention.",
    )
    rows = [
        [
            text_cell(row["item"]),
            text_cell(row["word_class"] or "-"),
            count_cell(row["num_episodes"]),
            number_cell(row["lift"]),
            interval_cell(row["lift_low"], row["lift_high"]),
            number_cell(row["lift_q"]),
            percent_cell(row["mass"]),
            percent_cell(row["share"]),
        ]
        for row in of_words.iter_rows(named=True)
    ]
    header = ["word", "class", "episodes", "lift", _INTERVAL, "q", "mass %", "of the text %"]
    caption = "Words of the instructions. q: p of lift 1, adjusted for the number of words (Benjamini-Hochberg)"
    few = few_families_note(of_words, "item", study.question.units)
    said = [Paragraph(leading_sentence(study)), *([Paragraph(few)] if few else [])]
    return Section("words", "Words", [diagram, *said, Table(caption, header, rows)])


def object_section(question: Question, folder: Path) -> Section | None:
    """Which objects get the image attention; None where no object masks were stored for the site's cameras."""
    if not any(item.tokens.coverage for item in question.selected):
        return None
    settings = ObjectSettings(spatial=False)
    try:
        study = ObjectStudy(question, settings, question.selected[0], object_tables(question, settings))
    except UserError as error:
        return Section("objects", "Objects", [Paragraph(str(error))])
    cameras = study.summary["camera"]
    together = ALL_CAMERAS if ALL_CAMERAS in cameras else cameras[0]
    whole = study.summary.filter(pl.col("camera") == together)
    diagram = drawn(
        lambda where: plot_object_shares(study, where),
        folder,
        "Shares of image attention over time, by object and by class. "
        f"Enrichment of the classes: {_named(whole.filter(pl.col('kind') == 'class'), 'enrichment') or 'none'}.",
        "Where image attention goes, by object in one episode and by class over all. Dashed: the area that is covered, "
        "which is what uniform attention would give. Dotted: the control, the same maps on the objects' masks of other "
        "episodes.",
    )
    rows = [
        [
            text_cell(row["item"]),
            text_cell(row["kind"]),
            count_cell(row["num_episodes"]),
            percent_cell(row["share"]),
            interval_cell(row["share_low"], row["share_high"], times=100),
            percent_cell(row["area_share"]),
            number_cell(row["enrichment"]),
            interval_cell(row["enrichment_low"], row["enrichment_high"]),
            number_cell(row["enrichment_over_control"]),
            interval_cell(row["enrichment_over_control_low"], row["enrichment_over_control_high"]),
            number_cell(row["enrichment_over_control_q"]),
        ]
        for row in whole.head(_MOST_ROWS).iter_rows(named=True)
    ]
    header = ["object", "kind", "episodes", "share %", _INTERVAL, "area %", "enrichment", _INTERVAL]
    header += ["over control", _INTERVAL, "q"]
    more = f" (the first {_MOST_ROWS}; vla-analyze objects has all)" if whole.height > _MOST_ROWS else ""
    caption = (
        f"Objects, all cameras together{more}. No value over control: there is none, or it cannot tell because the "
        "object hardly moves. q: p of 1 over control, adjusted (Benjamini-Hochberg)"
    )
    few = few_families_note(whole, "item", study.question.units)
    said = [Paragraph(followed_sentence(study)), *([Paragraph(few)] if few else [])]
    return Section("objects", "Objects", [diagram, *said, Table(caption, header, rows)])


def _named(summary: pl.DataFrame, measure: str) -> str:
    """Names with a measure, for people who do not see the diagram."""
    rows = summary.filter(pl.col(measure).is_not_null()).iter_rows(named=True)
    return ", ".join(f"{row['item']} {format_number(row[measure])}" for row in rows)
