"""The words of the instructions as a printed table."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence

import polars as pl

from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.show.headings import WIDTH
from vla_attention.analyze.show.numbers import format_interval, format_number
from vla_attention.analyze.show.text_table import text_table

_NOTE = (
    "lift: mass per piece over that of the average valid key (1: uniform attention). share: of all linguistic mass (bos, template, "
    "instruction). Intervals: 95 %, two-level bootstrap over tasks and episodes; - where fewer than two episodes."
)


def words_text(
    question: Question, summary: pl.DataFrame, readers: pl.DataFrame, layer: str, instruction: str | None
) -> str:
    """What `words_summary` and `strongest_readers` hold, in lines of at most `WIDTH` characters (but for long instructions)."""
    tasks = {(item.store.suite, item.episode.attributes.task_id) for item in question.selected}
    lines = [
        *question.header("WORDS: which words of the instruction are read", layer),
        *([f"Instruction: {instruction}"] if instruction else []),
        "",
        _table(summary.filter(pl.col("kind") == "word"), len(tasks) > 1),
        "",
        "for scale",
        _table(summary.filter(pl.col("kind") == "scale"), len(tasks) > 1),
        "",
        *textwrap.wrap(_NOTE, WIDTH),
    ]
    if readers.height:
        found = "Read most, by layer: " + "; ".join(_reader(row) for row in readers.iter_rows(named=True)) + "."
        lines += ["", *textwrap.wrap(found, WIDTH)]
    return "\n".join(lines)


def _table(summary: pl.DataFrame, several_tasks: bool) -> str:
    header = ["word", "class", "pieces", "episodes", "mass", "lift", "interval", "share", "interval"]
    rows: list[Sequence[str]] = []
    for row in summary.iter_rows(named=True):
        count = f"{row['num_episodes']} ({row['num_tasks']})" if several_tasks else str(row["num_episodes"])
        rows.append(
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
        )
    header[3] = "episodes (tasks)" if several_tasks else "episodes"
    return text_table(header, rows, left=(0, 1))


def _reader(row: dict) -> str:
    head = f" head {row['head']}" if row["head"] is not None else ""
    return f"'{row['item']}' in layer {row['layer']}{head} (lift {format_number(row['lift'])})"
