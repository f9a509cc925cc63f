"""The words of the instructions as a printed table."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from vla_attention.analyze.show.answer import Section
from vla_attention.analyze.show.findings import apart_note, few_families_note
from vla_attention.analyze.show.headings import interval_note
from vla_attention.analyze.show.numbers import format_number
from vla_attention.analyze.show.tables import (
    INTERVAL,
    Table,
    count,
    episode_count,
    interval,
    number,
    percent,
    texts,
    words,
)
from vla_attention.analyze.statistics.intervals import DEFAULT_LEVEL
from vla_attention.analyze.statistics.many_looks import NAMED_AT, fewest_clusters
from vla_attention.analyze.words.word_study import WordStudy

_NOTE = (
    "lift: mean over replans of mass / what uniform attention gives (1: uniform attention). share: of all linguistic "
    "mass (bos, template, instruction). q: p of lift 1, adjusted for the number of words (Benjamini-Hochberg)."
)


def words_sections(study: WordStudy) -> list[Section]:
    """The words with their numbers, what stands beside them for scale, and who reads most."""
    scale = replace(summary_table(study), rows=study.summary.filter(kind="scale").to_dicts())
    header = study.question.header("WORDS: which words of the instruction are read", study.layer)
    units = study.question.units
    return [
        Section([header, *([[f"Instruction: {study.instruction}"]] if study.instruction else [])]),
        Section([leading_sentence(study)]),
        Section([summary_table(study)]),
        Section([["for scale"], scale]),
        Section([_NOTE, interval_note(DEFAULT_LEVEL, units.words), few_families_note(study.summary, "item", units)]),
    ]


def summary_table(study: WordStudy) -> Table:
    """The words, in a text and on the page."""
    columns = [
        words("word", "item", "word"),
        texts("class", "word_class", left=True),
        words(None, lambda row: row["word_class"] or "-", "class"),
        number("pieces", "pieces"),
        episode_count(study.question.num_tasks > 1),
        count(None, "num_episodes", "episodes"),
        number("mass", "mass"),
        number("lift", "lift", "lift"),
        interval("lift", INTERVAL),
        number("q", "lift_q", "q"),
        percent(None, "mass", "mass"),
        number("share", "share"),
        percent(None, "share", "of the text"),
    ]
    caption = "Words of the instructions. q: p of lift 1, adjusted for the number of words (Benjamini-Hochberg)"
    return Table(columns, study.summary.filter(kind="word").to_dicts(), caption)


def leading_sentence(study: WordStudy) -> str:
    """Which word, and which layer of a word, is surely above all the others."""
    leaders = study.leaders
    units = leaders[0].units if leaders else study.question.units
    about, fewest = units.words, fewest_clusters(units)
    which = "of at least {} tasks" if units.families is None else "in tasks of at least {} families"
    some = f" {which.format(fewest)}" if fewest > 1 else ""
    named = [leading for leading in leaders if leading.found.is_named(len(leaders))]
    said = [
        f"{_cell(one.name)} has a higher lift ({format_number(one.found.value)}) than each of the other "
        f"{one.found.num_items - 1} {'words' if 'layer' not in one.name else 'pairs of word and layer'}{some}"
        for one in named
    ]
    if said:
        level = f"{NAMED_AT:g} / {len(leaders)}"
        apart = apart_note(named, "item")
        return f"{'; '.join(said)} (each difference tested at {level}, about {about}). {apart}".rstrip()
    if not leaders:
        return f"There are no two words{some} to compare."
    return (
        f"No word, and no layer of a word, is shown to be read more than all the others{some} (about {about}"
        f"{'; --intervals these-tasks compares all' if some else ''})."
    )


def _cell(row: dict[str, Any]) -> str:
    head = f" head {row['head']}" if row.get("head") is not None else ""
    return f"'{row['item']}'" + (f" in layer {row['layer']}{head}" if "layer" in row else "")
