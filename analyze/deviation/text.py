"""The text of `vla-attention deviation`."""

from __future__ import annotations

from typing import Any

import polars as pl

from vla_attention.analyze.deviation.deviation_study import MEASURES, RATIO, DeviationStudy
from vla_attention.analyze.effects.paired_replans import ALL
from vla_attention.analyze.show.answer import Section
from vla_attention.analyze.show.findings import findings
from vla_attention.analyze.show.headings import interval_note
from vla_attention.analyze.show.numbers import format_number, row_interval
from vla_attention.analyze.show.plot_text import shortened
from vla_attention.analyze.show.tables import (
    INTERVAL,
    Table,
    count,
    estimate,
    interval,
    number,
    signed,
    signed_estimate,
    texts,
)
from vla_attention.analyze.statistics.intervals import DEFAULT_LEVEL
from vla_attention.schemas.errors import listing

_MEANING = (
    "Root mean square of (policy's action - data set's) over dimensions, each in its standard deviation in the data "
    "set's actions; 1: as far as the data set's mean action is. first: the chunk's first action; chunk: all its steps "
    "that the data set has too."
)
_OVER_EPISODES = [count("n", "num_episodes"), *(column for name in MEASURES for column in estimate(name, name))]


def _quantity(row: dict[str, Any]) -> str:
    return "the ratio" if row["of"] == RATIO else f"the lift of {row['quantity']}"


_CORRELATIONS = [
    texts("attention", lambda row: shortened(_quantity(row), 40), left=True),
    texts("deviation", "measure", left=True),
    *signed_estimate("correlation", "correlation"),
    number("q", "correlation_q"),
    texts("episodes", lambda row: f"{row['correlation_episodes']} of {row['num_episodes']}"),
]


def deviation_sections(study: DeviationStudy) -> list[Section]:
    """The numbers over everything, then phases, dimensions, tasks, and what attention has to do with it."""
    phases = study.phases.filter(pl.col("phase") != ALL, scope="all")
    tasks = study.phases.filter(scope="task", phase=ALL)

    def task(row: dict[str, Any]) -> str:
        return f"{row['task_id']}  {shortened(row['instruction'], 44)}"

    return [
        Section([study.question.header("DEVIATION from the data set's actions", study.layer)]),
        Section([answer(study)]),
        Section([_MEANING, interval_note(DEFAULT_LEVEL, study.question.units.words)]),
        Section(
            [
                dimension_table(study),
                "unit: standard deviation in the data set. bias: mean of (first action - data set's), with its sign.",
            ],
            "DIMENSIONS",
        ),
        Section(
            [
                Table(_CORRELATIONS, study.correlations.to_dicts()),
                correlation_sentence(study),
                "Spearman's correlation over an episode's replans, mean over episodes; episodes: where it is defined. "
                "q: p of 0, adjusted for the number of pairs (Benjamini-Hochberg). A correlation is no cause.",
            ],
            "BESIDE ATTENTION",
        ),
        Section([Table([texts("phase", "phase", left=True), *_OVER_EPISODES], phases.to_dicts())], "PHASES"),
        Section([Table([texts("task", task, left=True), *_OVER_EPISODES], tasks.to_dicts())], "TASKS"),
    ]


def dimension_table(study: DeviationStudy) -> Table:
    """The dimensions of the action, in a text and on the page."""
    columns = [
        count("dimension", "dimension", "dimension", left=True),
        number("unit", "spread", "unit"),
        *(column for name in MEASURES for column in estimate(name, name, name)),
        signed("bias", "bias"),
        number(None, "bias", "bias"),
        interval("bias", INTERVAL),
    ]
    caption = "Dimensions. Unit: standard deviation in the data set; bias: mean of (first action - data set's)"
    return Table(columns, study.dimensions.to_dicts(), caption)


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
