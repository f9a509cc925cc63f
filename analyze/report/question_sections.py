"""Sections that come from measurements beside the ratio: sinks, the course of episodes, words, objects."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import polars as pl

from vla_attention.analyze.heads.layer_time import layer_time_table
from vla_attention.analyze.heads.plot_layer_time import plot_layer_time
from vla_attention.analyze.measures.aggregate import overall_layer
from vla_attention.analyze.measures.question import Question, ask
from vla_attention.analyze.measures.sinks import SinkRule
from vla_attention.analyze.objects.object_attention import object_tables
from vla_attention.analyze.objects.object_settings import ObjectSettings
from vla_attention.analyze.objects.object_study import objects_summary
from vla_attention.analyze.objects.object_views import ALL_CAMERAS
from vla_attention.analyze.objects.plot_object_shares import plot_object_shares
from vla_attention.analyze.ratios.analysis import Analysis
from vla_attention.analyze.ratios.plot_layer_profile import plot_layer_profile
from vla_attention.analyze.report.markup import (
    Cell,
    interval_cell,
    number_cell,
    paragraph,
    percent_cell,
    table,
    text_cell,
)
from vla_attention.analyze.report.pictures import drawn, figure, take
from vla_attention.analyze.report.sections import Section
from vla_attention.analyze.show.numbers import format_number
from vla_attention.analyze.time.plot_time_course import plot_time_courses
from vla_attention.analyze.time.time_courses import time_courses
from vla_attention.analyze.words.plot_word_bars import plot_word_bars
from vla_attention.analyze.words.word_reading import words_table
from vla_attention.analyze.words.word_study import site_of_words, words_summary
from vla_attention.schemas.errors import UserError

#: Rows of the tables of sinks and objects: what follows is weak, and the commands have it.
_MOST_ROWS = 30


def layer_figures(analysis: Analysis, folder: Path) -> list[str]:
    """Layer profile and layers over time, where there are several layers."""
    if len(set(analysis.question.selection.blocks)) < 2:
        return []
    grouping, seed = analysis.grouping, analysis.question.settings.seed
    what = "ratio" if grouping.ratio is not None else "fractions"
    time = layer_time_table(analysis.replans, grouping, seed=seed)
    cells = time.filter(pl.col("mean").is_not_null()).sort("mean")
    extremes = ""
    if cells.height and grouping.ratio is not None:
        low, high = cells.row(0, named=True), cells.row(-1, named=True)
        extremes = f" Lowest in layer {low['layer']}, highest in layer {high['layer']}."
    return [
        drawn(
            lambda where: plot_layer_profile(analysis.tasks, grouping, where),
            folder,
            f"Lines of the {what} over the layers with bootstrap intervals.",
            "Every layer with its interval over tasks and episodes.",
        ),
        drawn(
            lambda where: plot_layer_time(analysis.replans, grouping, where, seed),
            folder,
            f"A map of the {what} with layers from bottom to top and the episodes' time from left to right.{extremes}",
            "Layers over the course of the episodes, from the first replan (0) to the end (1).",
        ),
    ]


def time_section(analysis: Analysis, folder: Path) -> Section | None:
    """How the ratio runs over an episode, and around the first closing of the gripper."""
    if analysis.replans.cells["replan"].max() == 0:
        return None
    courses = time_courses(analysis.question, replans=analysis.replans)
    files = plot_time_courses(courses, analysis.grouping, folder)
    pictures = []
    for stem, what in (
        ("time_course", "Over the course of an episode, from its first replan (0) to its end (1)."),
        ("time_course_gripper", "Before and after the gripper first closes."),
    ):
        own = [path for path in files if path.stem == stem]
        if own:
            alternative = f"Lines with bands for their intervals: {what[0].lower()}{what[1:]}"
            pictures.append(
                figure(take(own, alternative, f"{what} Bands are pointwise 95 % intervals over tasks and episodes."))
            )
    return Section("time", "Over time", "".join(pictures))


def sink_section(sinks: pl.DataFrame) -> Section:
    """Keys that take far more than their share in most rows, from `sinks.merged_sinks` by the default rule."""
    rule = SinkRule()
    explanation = (
        f"A sink is a key that takes {rule} of a task. Trained transformers put what they do not need on a few such "
        f"keys, whose values may be close to "
        "nothing; a mass counts them like any other."
    )
    if sinks.is_empty():
        return Section("sinks", "Sinks", paragraph(explanation) + paragraph("No key does so here."))
    rows = [
        [
            text_cell(row["description"]),
            text_cell(row["role"]),
            Cell(str(row["num_tasks"]), row["num_tasks"]),
            percent_cell(row["share_of_rows"]),
            percent_cell(row["mean_mass"]),
            number_cell(row["times_uniform"]),
        ]
        for row in sinks.head(_MOST_ROWS).iter_rows(named=True)
    ]
    left = sinks.height - len(rows)
    heaviest = sinks.row(0, named=True)
    found = (
        f"{sinks.height} key{'s do' if sinks.height > 1 else ' does'} so here; the first, {heaviest['description']}, "
        f"takes "
        f"{100 * heaviest['mean_mass']:.1f} % of the attention to valid keys. vla-analyze ratios --without-sinks "
        f"computes everything without them."
    )
    caption = "Sinks" + (f", the first {len(rows)}; vla-analyze heads lists {left} more" if left else "")
    header = ["key", "role", "tasks", "rows %", "mass %", "times uniform"]
    return Section("sinks", "Sinks", paragraph(explanation) + paragraph(found) + table(caption, header, rows))


def word_section(question: Question, folder: Path) -> Section | None:
    """Which words are read: at the question's site, or where the policy reads when its site was not chosen."""
    try:
        site = site_of_words(question.stores[0].attributes, question.settings.site)
        if site != question.site:
            # Another site has other keys, so groups and ratio of the question need not exist there.
            settings = replace(question.settings, site=site, grouping=None, groups=(), ratio=None)
            question = ask(question.stores, settings)
        measured = words_table(question)
    except UserError as error:
        return Section("words", "Words", paragraph(str(error)))
    summary = words_summary(measured, by_place=False, seed=question.settings.seed)
    words = summary.filter((pl.col("kind") == "word") & pl.col("lift").is_not_null())
    first = ", ".join(f"{row['item']} {format_number(row['lift'])}" for row in words.head(5).iter_rows(named=True))
    picture = drawn(
        lambda where: plot_word_bars(summary, where, overall_layer(measured)),
        folder,
        f"Bars of the words' lifts, highest first: {first or 'none'}.",
        f"Words by lift, site {site}: mass per piece against the mean over valid keys; 1 is uniform attention.",
    )
    rows = [
        [
            text_cell(row["item"]),
            text_cell(row["word_class"] or "-"),
            Cell(str(row["num_episodes"]), row["num_episodes"]),
            number_cell(row["lift"]),
            interval_cell(row["lift_low"], row["lift_high"]),
            percent_cell(row["mass"]),
            percent_cell(row["share"]),
        ]
        for row in summary.filter(pl.col("kind") == "word").iter_rows(named=True)
    ]
    header = ["word", "class", "episodes", "lift", "95 % interval", "mass %", "of the text %"]
    return Section("words", "Words", picture + table("Words of the instructions", header, rows))


def object_section(question: Question, folder: Path) -> Section | None:
    """Which objects get the image attention; None where no object masks were stored for the site's cameras."""
    if not any(item.tokens.coverage for item in question.selected):
        return None
    try:
        tables = object_tables(question, ObjectSettings(spatial=False))
    except UserError as error:
        return Section("objects", "Objects", paragraph(str(error)))
    seed = question.settings.seed
    summary = objects_summary(tables.objects, seed)
    whole = summary.filter(
        pl.col("camera") == (ALL_CAMERAS if ALL_CAMERAS in summary["camera"] else summary["camera"][0])
    )
    classes = [row for row in whole.filter(pl.col("kind") == "class").iter_rows(named=True) if row["lift"] is not None]
    told = ", ".join(f"{row['item']} {format_number(row['lift'])}" for row in classes)
    picture = drawn(
        lambda where: plot_object_shares(tables.times, question.selected[0], where, seed),
        folder,
        f"Shares of image attention over time, by object and by class. Lifts of the classes: {told or 'none'}.",
        "Where image attention goes, by object in one episode and by class over all. Dashed: the area that is "
        "covered, which is what uniform "
        "attention would give.",
    )
    rows = [
        [
            text_cell(row["item"]),
            text_cell(row["kind"]),
            Cell(str(row["num_episodes"]), row["num_episodes"]),
            percent_cell(row["share"]),
            interval_cell(*(None if bound is None else 100 * bound for bound in (row["share_low"], row["share_high"]))),
            percent_cell(row["area_share"]),
            number_cell(row["lift"]),
            interval_cell(row["lift_low"], row["lift_high"]),
        ]
        for row in whole.head(_MOST_ROWS).iter_rows(named=True)
    ]
    header = ["object", "kind", "episodes", "share %", "95 % interval", "area %", "lift", "95 % interval"]
    caption = "Objects, all cameras together" + (
        f" (the first {_MOST_ROWS}; vla-analyze objects has all)" if whole.height > _MOST_ROWS else ""
    )
    return Section("objects", "Objects", picture + table(caption, header, rows))
