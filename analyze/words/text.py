"""The words of the instructions as a printed table."""

from __future__ import annotations

from typing import Any

import polars as pl

from vla_attention.analyze.show.headings import interval_note, wrap
from vla_attention.analyze.show.numbers import format_interval, format_number
from vla_attention.analyze.show.text_table import episode_counts, text_table
from vla_attention.analyze.statistics.bootstrap import DEFAULT_LEVEL
from vla_attention.analyze.words.word_study import WordStudy

_NOTE = (
    "lift: mean over replans of mass per piece / mass per valid key (1: uniform attention). share: of all "
    f"linguistic mass (bos, template, instruction). {interval_note(DEFAULT_LEVEL)}"
)


def words_text(study: WordStudy) -> str:
    """The words with their numbers, what stands beside them for scale, and who reads most."""
    several = study.question.num_tasks > 1
    lines = [
        *study.question.header("WORDS: which words of the instruction are read", study.layer),
        *([f"Instruction: {study.instruction}"] if study.instruction else []),
        "",
        _table(study.summary.filter(pl.col("kind") == "word"), several),
        "",
        "for scale",
        _table(study.summary.filter(pl.col("kind") == "scale"), several),
        "",
        *wrap(_NOTE),
    ]
    readers = study.readers
    if readers.height:
        found = "; ".join(_reader(row) for row in readers.iter_rows(named=True))
        lines += ["", *wrap(f"Read most, by layer: {found}.")]
    return "\n".join(lines)


def _table(summary: pl.DataFrame, several_tasks: bool) -> str:
    rows = summary.to_dicts()
    heading, counts = episode_counts(rows, several_tasks)
    header = ["word", "class", "pieces", heading, "mass", "lift", "interval", "share", "interval"]
    body = [
        [
            row["item"],
            row["word_class"] or "",
            format_number(row["pieces"]),
            count,
            format_number(row["mass"]),
            format_number(row["lift"]),
            format_interval(row["lift_low"], row["lift_high"]),
            format_number(row["share"]),
            format_interval(row["share_low"], row["share_high"]),
        ]
        for row, count in zip(rows, counts, strict=True)
    ]
    return text_table(header, body, left=(0, 1))


def _reader(row: dict[str, Any]) -> str:
    head = f" head {row['head']}" if row["head"] is not None else ""
    return f"'{row['item']}' in layer {row['layer']}{head} (lift {format_number(row['lift'])})"
