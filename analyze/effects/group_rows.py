"""Groups of keys with what knocking them out, and keeping nothing else, does to the action: rows of the answer."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from vla_attention.analyze.effects.conditions import Condition, Kind
from vla_attention.analyze.effects.effect_study import EffectStudy
from vla_attention.analyze.effects.group_attention import MEASURES


@dataclass(frozen=True)
class GroupRow:
    """One group in one place of the model.

    Attributes:
        name: the group's.
        condition: the run without the group, or where there is none the run with the group alone.
        without: the row of `EffectStudy.summary` without the group; None where there is no such rerun.
        only: the same with the group alone.
        attention: `MEASURES` of the base's attention to the group, means over episodes; None where there is none.
    """

    name: str
    condition: Condition
    without: dict[str, Any] | None
    only: dict[str, Any] | None
    attention: dict[str, float | None]


def group_rows(study: EffectStudy) -> list[GroupRow]:
    """One row per group that was knocked out or kept: those of the grouping in its order, then the others by effect."""
    rows = []
    alone = study.of_kind(Kind.ONLY)
    for condition in study.of_kind(Kind.WITHOUT):
        reverse = next((other for other in alone if other.is_reverse_of(condition)), None)
        rows.append(_row(study, condition, condition, reverse))
        alone = [other for other in alone if other is not reverse]
    rows += [_row(study, condition, None, condition) for condition in alone]
    order = {name: i for i, name in enumerate(study.analysis.grouping.names)}
    return sorted(rows, key=lambda row: (order.get(row.name, len(order)), -_effect(row)))


def _effect(row: GroupRow) -> float:
    """The effect without the group, by which rows are sorted; 0 where there is none."""
    return (row.without or {}).get("effect") or 0.0


def _row(study: EffectStudy, condition: Condition, without: Condition | None, only: Condition | None) -> GroupRow:
    rows = [None if one is None else study.of(one) for one in (without, only)]
    known = next(row for row in rows if row is not None)
    return GroupRow(condition.group_name, condition, rows[0], rows[1], {name: known[name] for name in MEASURES})
