"""The section on interventions: what the action does without what it could look at or read."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from vla_attention.analyze.effects.answer import answer_lines
from vla_attention.analyze.effects.effect_study import study_of
from vla_attention.analyze.effects.group_rows import GroupRow, group_rows
from vla_attention.analyze.effects.plot_attention_and_effect import plot_attention_and_effect
from vla_attention.analyze.effects.plot_effects import plot_effects
from vla_attention.analyze.effects.reruns import open_reruns
from vla_attention.analyze.effects.text import counted_actions
from vla_attention.analyze.ratios.analysis import Analysis
from vla_attention.analyze.report.pictures import drawn
from vla_attention.analyze.report.section_parts import (
    Cell,
    Paragraph,
    Part,
    Section,
    Table,
    interval_cell,
    number_cell,
    percent_cell,
    text_cell,
)
from vla_attention.analyze.show.numbers import format_number, interval_name
from vla_attention.analyze.statistics.intervals import DEFAULT_LEVEL
from vla_attention.schemas.errors import BadArgument

_INTERVAL = interval_name(DEFAULT_LEVEL)
_MEANING = (
    "A group of keys was knocked out, or everything but it, and the same policy calls were run again. The effect is "
    "the root mean square change of the {which} actions, each dimension in its standard deviation in the base; "
    "effects do not add up. An effect is held against that of another noise seed on the same inputs, and of as many "
    "random keys."
)


def effect_section(analysis: Analysis, given: Sequence[Path], folder: Path) -> Section | None:
    """Effects of the reruns that were given; None without any.

    Raises:
        BadArgument: the page is about several stores, or `effects.reruns.open_reruns` refuses a rerun.
    """
    if not given:
        return None
    stores = analysis.question.stores
    if len(stores) > 1:
        raise BadArgument(
            f"--effects goes with one store, and the report is about {len(stores)}; make a report for each."
        )
    study = study_of(analysis, open_reruns(stores[0], given))
    parts: list[Part] = [
        Paragraph(_MEANING.format(which=counted_actions(study)), quiet=True),
        *(Paragraph(line) for line in answer_lines(study) if line),
    ]
    rows = group_rows(study)
    if study.conditions:
        told = [f"{row.label} {format_number(row.without['effect'])}" for row in rows if row.without is not None]
        alternative = f"Points with intervals: effects without each group: {', '.join(told[:12]) or 'none'}."
        parts.append(drawn(lambda where: plot_effects(study, where), folder, alternative, "Effects on the action."))
    if rows:
        alternative = "Points: groups by the base's attention to them and by the effect of knocking them out."
        caption = "Attention and effect: were attention a measure of use, points would rise to the right."
        parts.append(drawn(lambda where: plot_attention_and_effect(study, where), folder, alternative, caption))
        header = ["group", "mass %", "lift", "without", _INTERVAL, "times the noise", "random keys", "alone", _INTERVAL]
        parts.append(Table("Groups without which, and with which alone", header, [_cells(row) for row in rows]))
    parts += [Paragraph(note, quiet=True) for note in study.notes]
    return Section("effects", "Interventions", parts)


def _cells(row: GroupRow) -> list[Cell]:
    cells = [text_cell(row.label), percent_cell(row.attention["mass"]), number_cell(row.attention["lift"])]
    cells += [*_effect(row.without), *(number_cell(_of(row.without, name)) for name in ("over_noise", "random"))]
    return [*cells, *_effect(row.only)]


def _effect(row: dict[str, Any] | None) -> list[Cell]:
    return [number_cell(_of(row, "effect")), interval_cell(_of(row, "effect_low"), _of(row, "effect_high"))]


def _of(row: dict[str, Any] | None, name: str) -> float | None:
    return None if row is None else row[name]
