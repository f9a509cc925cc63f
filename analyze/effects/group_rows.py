"""Groups of keys with what knocking them out, and keeping nothing else, does to the action: rows of the answer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from vla_attention.analyze.effects.conditions import Condition, Kind, Reader, item_name, reader_of
from vla_attention.analyze.effects.effect_study import EffectStudy
from vla_attention.analyze.effects.group_attention import MEASURES


@dataclass(frozen=True)
class GroupRow:
    """One group in one place of the model.

    Attributes:
        name: the group's.
        label: the name, with for whom its keys were cut where rows differ in it; no two rows have the same.
        condition: the run without the group, or where there is none the run with the group alone.
        without: the row of `EffectStudy.summary` without the group; None where there is no such rerun.
        only: the same with the group alone.
        attention: `MEASURES` of the base's attention to the group, means over episodes; None where there is none.
    """

    name: str
    label: str
    condition: Condition
    without: dict[str, Any] | None
    only: dict[str, Any] | None
    attention: dict[str, float | None]


def group_rows(study: EffectStudy) -> list[GroupRow]:
    """One row per group that was knocked out or kept: those of the grouping in its order, then the others by effect.

    Of recorded effects, only those of the widest reader: nobody reads the group, or the action queries do not.
    """
    rows = []
    alone, without = study.of_kind(Kind.ONLY), study.of_kind(Kind.WITHOUT)
    if study.is_recorded:  # of several readers, the widest: `item_rows` has the others
        widest: Reader = "total" if any(reader_of(one) == "total" for one in without) else "direct"
        alone, without = ([one for one in some if reader_of(one) == widest] for some in (alone, without))
    for condition in without:
        reverse = next((other for other in alone if other.is_reverse_of(condition)), None)
        rows.append(_row(study, condition, condition, reverse))
        alone = [other for other in alone if other is not reverse]
    rows += [_row(study, condition, None, condition) for condition in alone]
    order = {name: i for i, name in enumerate(study.analysis.grouping.names)}
    ordered = sorted(rows, key=lambda row: (order.get(row.name, len(order)), -_effect(row)))
    return [replace(row, label=label) for row, label in zip(ordered, _labels(ordered), strict=True)]


def readers_of(rows: Sequence[GroupRow]) -> list[str]:
    """For whom the keys of rows were cut, in words, each once."""
    return list(dict.fromkeys(row.condition.readers for row in rows))


def _labels(rows: Sequence[GroupRow]) -> list[str]:
    alike = len(readers_of(rows)) < 2
    labels = [row.label if alike else f"{row.label} (for {row.condition.readers})" for row in rows]
    return [
        label if labels.count(label) == 1 else f"{label} ({row.condition.name})"
        for label, row in zip(labels, rows, strict=True)
    ]


def _effect(row: GroupRow) -> float:
    """The effect without the group, by which rows are sorted; 0 where there is none."""
    return (row.without or {}).get("effect") or 0.0


def _row(study: EffectStudy, condition: Condition, without: Condition | None, only: Condition | None) -> GroupRow:
    rows = [None if one is None else study.of(one) for one in (without, only)]
    known = next(row for row in rows if row is not None)
    attention = {name: known[name] for name in MEASURES}
    label = item_name(condition) if condition.recorded else condition.group_name
    return GroupRow(condition.group_name, label, condition, rows[0], rows[1], attention)
