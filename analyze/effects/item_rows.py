"""What each item does to the action, by who no longer reads it: rows of the answer to recorded effects."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import polars as pl

from vla_attention.analyze.effects.conditions import Condition, Kind, Reader, item_name, reader_of, selector_kind
from vla_attention.analyze.effects.effect_study import EffectStudy
from vla_attention.analyze.effects.paired_replans import ALL
from vla_attention.analyze.measures.frames import EPISODE_ID
from vla_attention.analyze.statistics.episode_intervals import means_of_all_and_of_tasks
from vla_attention.analyze.statistics.intervals import POSITIVE

#: All pictures, and all text.
MODALITIES = ("visual", "linguistic")


@dataclass(frozen=True)
class ItemRow:
    """One item: its name, the kind of its selector, and its row of `EffectStudy.summary` for each reader."""

    name: str
    kind: str
    by_reader: Mapping[Reader, dict[str, Any]]

    @property
    def strongest(self) -> dict[str, Any]:
        """The total effect; where it was not measured, the direct one."""
        return self.by_reader.get("total") or self.by_reader["direct"]

    def effect(self, reader: Reader) -> float | None:
        """The effect for a reader; None where it was not measured."""
        row = self.by_reader.get(reader)
        return None if row is None else row["effect"]

    @property
    def direct_share(self) -> float | None:
        """The direct effect as a share of the total one."""
        total, direct = self.effect("total"), self.effect("direct")
        return direct / total if total and direct is not None else None


def item_rows(study: EffectStudy) -> list[ItemRow]:
    """A row for every group of keys that was cut off, the largest effect first; of reruns, for two readers or more."""
    by_name: dict[str, dict[Reader, dict[str, Any]]] = {}
    named: dict[str, Condition] = {}
    for condition in study.of_kind(Kind.WITHOUT):
        reader = reader_of(condition)
        if reader is not None:
            by_name.setdefault(condition.group_name, {})[reader] = study.of(condition)
            named[condition.group_name] = condition
    rows = [
        ItemRow(item_name(named[name]), selector_kind(named[name]), rows)
        for name, rows in by_name.items()
        if len(rows) > 1 or study.is_recorded
    ]
    rows = [row for row in rows if {"total", "direct"} & set(row.by_reader)]
    return sorted(rows, key=lambda row: -(row.strongest["effect"] or 0.0))


def ratio_of_effects(study: EffectStudy) -> dict[str, Any] | None:
    """The total effect of all pictures divided by that of all text, with its interval; None where one is missing.

    Returns:
        ratio, ratio_low, ratio_high, num_episodes of the quotient of mean effects over the same episodes.
    """
    sides: dict[str, str] = {}
    for condition in study.of_kind(Kind.WITHOUT):
        if reader_of(condition) == "total" and condition.group_name in MODALITIES:
            sides[condition.group_name] = condition.name
    if len(sides) < 2:
        return None
    whole = study.episodes.filter(pl.col("phase") == ALL)
    place = [*EPISODE_ID, "instruction"]
    visual, linguistic = (
        whole.filter(pl.col("condition") == sides[name]).select(*place, pl.col("effect").alias(name))
        for name in MODALITIES
    )
    pairs = visual.join(linguistic, on=place, how="inner").with_columns(question=pl.lit("effects"))
    if not pairs.height:
        return None
    table = means_of_all_and_of_tasks(
        pairs,
        ["question"],
        {"visual": POSITIVE, "linguistic": POSITIVE},
        study.question.sampling,
        quotients={"ratio": ("visual", "linguistic")},
    )
    return table.row(by_predicate=pl.col("scope") == "all", named=True)
