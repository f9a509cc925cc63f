"""The words of the instructions as a printed table."""

from __future__ import annotations

from typing import Any

import polars as pl

from vla_attention.analyze.show.findings import apart_note, few_families_note
from vla_attention.analyze.show.headings import interval_note, wrap
from vla_attention.analyze.show.numbers import format_interval, format_number
from vla_attention.analyze.show.text_table import episode_counts, text_table
from vla_attention.analyze.statistics.intervals import DEFAULT_LEVEL
from vla_attention.analyze.statistics.many_looks import NAMED_AT, fewest_clusters
from vla_attention.analyze.words.word_study import WordStudy

_NOTE = (
    "lift: mean over replans of mass / what uniform attention gives (1: uniform attention). share: of all linguistic "
    "mass (bos, template, instruction). q: p of lift 1, adjusted for the number of words (Benjamini-Hochberg)."
)


def words_text(study: WordStudy) -> str:
    """The words with their numbers, what stands beside them for scale, and who reads most."""
    several = study.question.num_tasks > 1
    lines = [
        *study.question.header("WORDS: which words of the instruction are read", study.layer),
        *([f"Instruction: {study.instruction}"] if study.instruction else []),
        "",
        *wrap(leading_sentence(study)),
        "",
        _table(study.summary.filter(pl.col("kind") == "word"), several),
        "",
        "for scale",
        _table(study.summary.filter(pl.col("kind") == "scale"), several),
        "",
        *wrap(_NOTE),
    ]
    lines += wrap(interval_note(DEFAULT_LEVEL, study.question.units.words))
    lines += wrap(few_families_note(study.summary, "item", study.question.units))
    return "\n".join(lines)


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


def _table(summary: pl.DataFrame, several_tasks: bool) -> str:
    rows = summary.to_dicts()
    heading, counts = episode_counts(rows, several_tasks)
    header = ["word", "class", "pieces", heading, "mass", "lift", "interval", "q", "share"]
    body = [
        [
            row["item"],
            row["word_class"] or "",
            format_number(row["pieces"]),
            count,
            format_number(row["mass"]),
            format_number(row["lift"]),
            format_interval(row["lift_low"], row["lift_high"]),
            format_number(row["lift_q"]),
            format_number(row["share"]),
        ]
        for row, count in zip(rows, counts, strict=True)
    ]
    return text_table(header, body, left=(0, 1))


def _cell(row: dict[str, Any]) -> str:
    head = f" head {row['head']}" if row.get("head") is not None else ""
    return f"'{row['item']}'" + (f" in layer {row['layer']}{head}" if "layer" in row else "")
