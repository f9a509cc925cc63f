"""The section on data-set actions: how far the policy's are from them, and whether attention goes with that."""

from __future__ import annotations

from pathlib import Path

from vla_attention.analyze.deviation.deviation_study import MEASURES, has_dataset_actions, study_deviation
from vla_attention.analyze.deviation.plot_deviation import plot_deviation
from vla_attention.analyze.deviation.text import answer, correlation_sentence
from vla_attention.analyze.ratios.analysis import Analysis
from vla_attention.analyze.report.pictures import drawn
from vla_attention.analyze.report.section_parts import (
    Cell,
    Paragraph,
    Part,
    Section,
    Table,
    count_cell,
    interval_cell,
    number_cell,
)
from vla_attention.analyze.show.numbers import format_number, interval_name
from vla_attention.analyze.statistics.intervals import DEFAULT_LEVEL
from vla_attention.schemas.errors import UserError

_INTERVAL = interval_name(DEFAULT_LEVEL)
_MEANING = (
    "Root mean square of (policy's action - data set's), each dimension in its standard deviation in the data set's "
    "actions; 1: as far as the data set's mean action is. The chunk: all its steps that the data set has too."
)


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
    rows: list[list[Cell]] = [
        [
            count_cell(row["dimension"]),
            number_cell(row["spread"]),
            *(
                cell
                for name in MEASURES
                for cell in (number_cell(row[name]), interval_cell(row[f"{name}_low"], row[f"{name}_high"]))
            ),
            number_cell(row["bias"]),
            interval_cell(row["bias_low"], row["bias_high"]),
        ]
        for row in study.dimensions.iter_rows(named=True)
    ]
    header = ["dimension", "unit", "first", _INTERVAL, "chunk", _INTERVAL, "bias", _INTERVAL]
    caption = "Dimensions. Unit: standard deviation in the data set; bias: mean of (first action - data set's)"
    parts: list[Part] = [Paragraph(_MEANING, quiet=True), Paragraph(answer(study)), diagram]
    parts += [Paragraph(correlation_sentence(study)), Table(caption, header, rows)]
    return Section("deviation", "Against the data set", parts)
