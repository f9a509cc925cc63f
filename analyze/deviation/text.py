"""The text of `vla-analyze deviation`."""

from __future__ import annotations

from typing import Any

import polars as pl

from vla_attention.analyze.deviation.deviation_study import MEASURES, RATIO, DeviationStudy
from vla_attention.analyze.effects.paired_replans import ALL
from vla_attention.analyze.show.findings import findings
from vla_attention.analyze.show.headings import heading, interval_note, wrap
from vla_attention.analyze.show.numbers import format_number, format_signed, row_interval
from vla_attention.analyze.show.plot_text import shortened
from vla_attention.analyze.show.text_table import text_table
from vla_attention.analyze.statistics.intervals import DEFAULT_LEVEL
from vla_attention.schemas.errors import listing

_MEANING = (
    "Root mean square of (policy's action - data set's) over dimensions, each in its standard deviation in the data "
    "set's actions; 1: as far as the data set's mean action is. first: the chunk's first action; chunk: all its steps "
    "that the data set has too."
)


def deviation_text(study: DeviationStudy) -> str:
    """The numbers over everything, then phases, dimensions, tasks, and what attention has to do with it."""
    parts = [
        "\n".join(
            [
                *study.question.header("DEVIATION from the data set's actions", study.layer),
                "",
                *wrap(answer(study)),
                "",
                *wrap(_MEANING),
                *wrap(interval_note(DEFAULT_LEVEL, study.question.units.words)),
            ]
        ),
        _dimensions(study),
        _attention(study),
        _phases(study),
        _tasks(study),
    ]
    return "\n\n".join(part for part in parts if part)


def answer(study: DeviationStudy) -> str:
    """How far the actions are, in a sentence or two."""
    row: dict[str, Any] = study.overall
    first, chunk = (
        f"{format_number(row[name])}{'' if row[f'{name}_low'] is None else f' {row_interval(row, name)}'}"
        for name in MEASURES
    )
    out = study.spread.left_out
    named = f"{'dimension' if len(out) == 1 else 'dimensions'} {listing(out)}"
    return (
        f"The first action is {first} standard deviations of the data set's actions away from its own, the chunk "
        f"{chunk}.{f' Not compared: {named}, without spread.' if out else ''}"
    )


def correlation_sentence(study: DeviationStudy) -> str:
    """Which attention goes with the deviation, after looking at all of it."""
    rows = study.correlations.to_dicts()
    names = [f"{_quantity(row)} and the {row['measure']}" for row in rows]
    return findings([row["correlation_q"] for row in rows], names, "pair", "a correlation")


def _quantity(row: dict[str, Any]) -> str:
    return "the ratio" if row["of"] == RATIO else f"the lift of {row['quantity']}"


def _attention(study: DeviationStudy) -> str:
    body = [
        [
            shortened(_quantity(row), 40),
            row["measure"],
            format_signed(row["correlation"]),
            row_interval(row, "correlation"),
            format_number(row["correlation_q"]),
            f"{row['correlation_episodes']} of {row['num_episodes']}",
        ]
        for row in study.correlations.iter_rows(named=True)
    ]
    note = (
        "Spearman's correlation over an episode's replans, mean over episodes; episodes: where it is defined. q: p of "
        "0, adjusted for the number of pairs (Benjamini-Hochberg). A correlation is no cause."
    )
    table = text_table(["attention", "deviation", "correlation", "interval", "q", "episodes"], body, left=(0, 1))
    return "\n".join([heading("BESIDE ATTENTION"), table, *wrap(correlation_sentence(study)), *wrap(note)])


def _dimensions(study: DeviationStudy) -> str:
    body = [
        [
            str(row["dimension"]),
            format_number(row["spread"]),
            *(cell for name in MEASURES for cell in (format_number(row[name]), row_interval(row, name))),
            format_signed(row["bias"]),
            row_interval(row, "bias"),
        ]
        for row in study.dimensions.iter_rows(named=True)
    ]
    header = ["dimension", "unit", "first", "interval", "chunk", "interval", "bias", "interval"]
    note = "unit: standard deviation in the data set. bias: mean of (first action - data set's), with its sign."
    return "\n".join([heading("DIMENSIONS"), text_table(header, body, left=(0,)), *wrap(note)])


def _phases(study: DeviationStudy) -> str:
    rows = study.phases.filter(pl.col("scope") == "all", pl.col("phase") != ALL)
    return "\n".join([heading("PHASES"), _table("phase", [(row["phase"], row) for row in rows.iter_rows(named=True)])])


def _tasks(study: DeviationStudy) -> str:
    rows = study.phases.filter(pl.col("scope") == "task", pl.col("phase") == ALL)
    named = [(f"{row['task_id']}  {shortened(row['instruction'], 44)}", row) for row in rows.iter_rows(named=True)]
    return "\n".join([heading("TASKS"), _table("task", named)])


def _table(name: str, rows: list[tuple[str, dict[str, Any]]]) -> str:
    body = [
        [label, str(row["num_episodes"])]
        + [cell for measure in MEASURES for cell in (format_number(row[measure]), row_interval(row, measure))]
        for label, row in rows
    ]
    return text_table([name, "n", "first", "interval", "chunk", "interval"], body, left=(0,))
