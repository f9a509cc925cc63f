"""What further questions found: time, sinks, words, objects, effects of interventions, deviation from a data set."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from vla_attention.analyze.ask import answer_to
from vla_attention.analyze.deviation.deviation_study import has_dataset_actions, study_deviation
from vla_attention.analyze.deviation.plot_deviation import plot_deviation
from vla_attention.analyze.deviation.text import answer, correlation_sentence, dimension_table
from vla_attention.analyze.effects.answer import answer_lines
from vla_attention.analyze.effects.effect_study import study_of
from vla_attention.analyze.effects.group_rows import group_rows
from vla_attention.analyze.effects.plot_attention_and_effect import plot_attention_and_effect
from vla_attention.analyze.effects.plot_effects import plot_effects
from vla_attention.analyze.effects.reruns import open_reruns, recorded_conditions
from vla_attention.analyze.effects.text import counted_actions, group_table, item_table
from vla_attention.analyze.heads.text import sink_table
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.measures.sink_kinds import SMALL_VALUES
from vla_attention.analyze.measures.sinks import SinkRule, SinkSearch, cannot_fire
from vla_attention.analyze.ratios.analysis import Analysis
from vla_attention.analyze.report.pictures import diagram_of, drawn
from vla_attention.analyze.report.section_parts import PageTable, Paragraph, Part, ResultPart, Section
from vla_attention.analyze.show.numbers import format_number, format_percent
from vla_attention.analyze.show.tables import INTERVAL
from vla_attention.analyze.time.plot_time_course import plot_time_courses
from vla_attention.analyze.time.time_courses import time_courses
from vla_attention.schemas.errors import BadArgument, UserError

#: Rows of the tables of sinks and objects; the rows after these are small, and the commands print them.
_MOST_ROWS = 30
_DEVIATION = (
    "Root mean square of (policy's action - data set's), each dimension in its standard deviation in the data set's "
    "actions; 1: as far as the data set's mean action is. The chunk: all its steps that the data set has too."
)
_EFFECT = (
    "A group of keys was knocked out, or everything but it, and the same policy calls were run again. The effect is "
    "the root mean square change of the {which} actions, each dimension in its standard deviation in the base; "
    "effects do not add up. An effect is held against that of another noise seed on the same inputs, and of as many "
    "random keys."
)


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
        diagram_files = [path for path in files if path.stem == stem]
        if diagram_files:
            alternative = f"Lines with bands for their intervals: {what[0].lower()}{what[1:]}"
            caption = f"{what} Bands are pointwise {INTERVAL}s."
            diagrams.append(diagram_of(diagram_files, alternative, caption))
    return Section("time", "Over time", diagrams)


def sink_section(search: SinkSearch) -> Section:
    """Keys that take far more than their share in a head, by the default rule."""
    rows, beyond = sink_table(search).rows, cannot_fire(search.num_valid, SinkRule())
    explanation = Paragraph(
        f"A sink is a key that takes {SinkRule()}; keys of the policy's own actions are not counted. Trained "
        "transformers put attention that nothing needs on a few keys without content, often the first one, whose "
        "values may be near zero; a key of a word or a patch may be what a head looks for. A mass includes both. "
        f"{beyond}".rstrip()
    )
    if not rows:
        return Section("sinks", "Sinks", [explanation, Paragraph("No key is one here.")])
    sentence = (
        f"{'One key is a sink' if len(rows) == 1 else f'{len(rows)} keys are sinks'} here; the first, "
        f"{rows[0]['description']}, takes {format_percent(rows[0]['mean_mass'])} of the attention to valid keys. "
        "vla-attention ratios --without-sinks computes everything without those of many heads. Values: what the key "
        "adds "
        f"per unit of mass, beside all other keys (small: less than {SMALL_VALUES:g} of it; ?: it cannot be told)."
    )
    left = len(rows) - _MOST_ROWS
    caption = f"Sinks, the first {_MOST_ROWS}; vla-attention heads lists {left} more" if left > 0 else "Sinks"
    table = replace(sink_table(search, caption), rows=rows[:_MOST_ROWS])
    return Section("sinks", "Sinks", [explanation, Paragraph(sentence), PageTable(table)])


def word_section(question: Question) -> Section:
    """Which words are read: at the site that was chosen, or without a choice at the site that reads the instruction."""
    # Words need no groups, and another site may not have the keys of the question's groups.
    settings = replace(question.settings, grouping=None, groups=(), ratio=None)
    try:
        return Section("words", "Words", [ResultPart(answer_to("words", question.stores, settings))])
    except UserError as error:
        return Section("words", "Words", [Paragraph(str(error))])


def object_section(question: Question) -> Section | None:
    """Which objects get the image attention; None where no object masks were stored for the site's cameras."""
    if not any(item.tokens.coverage for item in question.selected):
        return None
    settings = replace(question.settings, grouping=None, groups=(), ratio=None)
    try:
        answer = answer_to("objects", question.stores, settings, {"iou": False})
    except UserError as error:
        return Section("objects", "Objects", [Paragraph(str(error))])
    return Section("objects", "Objects", [ResultPart(answer)])


def effect_section(analysis: Analysis, given: Sequence[Path], folder: Path) -> Section | None:
    """Effects of the reruns that were given, else those that the store holds; None where there are none.

    Raises:
        BadArgument: the page is about several stores, or `effects.reruns.open_reruns` refuses a rerun.
    """
    stores = analysis.question.stores
    if not given and not (len(stores) == 1 and recorded_conditions(stores[0])):
        return None
    if len(stores) > 1:
        raise BadArgument(
            f"--reruns goes with one store, and the report is about {len(stores)}; make a report for each."
        )
    try:
        study = study_of(analysis, open_reruns(stores[0], given))
    except BadArgument as error:
        if given:
            raise
        return Section("effects", "Interventions", [Paragraph(str(error), quiet=True)])
    parts: list[Part] = [
        Paragraph(_EFFECT.format(which=counted_actions(study)), quiet=True),
        *(Paragraph(line) for line in answer_lines(study) if line),
    ]
    table = group_table(study, "Groups without which, and with which alone")
    if study.is_recorded:
        items = item_table(study)
        table = replace(items, caption="Each without which, by who no longer reads it") if items.rows else table
    if study.conditions:
        rows = [(row.label, row.without) for row in group_rows(study) if row.without is not None]
        told = [f"{label} {format_number(without['effect'])}" for label, without in rows]
        alternative = f"Points with intervals: effects without each group: {', '.join(told[:12]) or 'none'}."
        parts.append(drawn(lambda where: plot_effects(study, where), folder, alternative, "Effects on the action."))
    if table.rows:
        alternative = "Points: groups by the base's attention to them and by the effect of knocking them out."
        caption = "Attention and effect: were attention a measure of use, points would rise to the right."
        parts.append(drawn(lambda where: plot_attention_and_effect(study, where), folder, alternative, caption))
        parts.append(PageTable(table))
    parts += [Paragraph(note, quiet=True) for note in study.notes]
    return Section("effects", "Interventions", parts)


def deviation_section(analysis: Analysis, folder: Path) -> Section | None:
    """The deviation by dimension, over time and beside attention; None where the stores hold no data-set actions."""
    if not has_dataset_actions(analysis.question):
        return None
    try:
        study = study_deviation(analysis.question, analysis.replans)
    except UserError as error:
        return Section("deviation", "Against the data set", [Paragraph(str(error))])
    named = [f"{row['dimension']}: {format_number(row['first'])}" for row in study.dimensions.iter_rows(named=True)]
    diagram = drawn(
        lambda where: plot_deviation(study, where),
        folder,
        f"Points with intervals: deviation of the first action by dimension: {', '.join(named)}.",
        "Deviation by dimension and over an episode's time, and its rank correlation with the ratio and with lifts "
        "over the replans of an episode.",
    )
    parts: list[Part] = [Paragraph(_DEVIATION, quiet=True), Paragraph(answer(study)), diagram]
    parts += [Paragraph(correlation_sentence(study)), PageTable(dimension_table(study))]
    return Section("deviation", "Against the data set", parts)
