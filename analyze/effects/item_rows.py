"""What each item does to the action, by who no longer reads it: rows of the answer to recorded effects."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import polars as pl

from vla_attention.analyze.effects.conditions import Condition, Kind
from vla_attention.analyze.effects.effect_study import EffectStudy
from vla_attention.analyze.effects.paired_replans import ALL
from vla_attention.analyze.measures.frames import EPISODE_ID
from vla_attention.analyze.statistics.episode_intervals import means_of_all_and_of_tasks
from vla_attention.analyze.statistics.intervals import POSITIVE
from vla_attention.schemas.errors import UserError
from vla_attention.schemas.groupings.selector_parser import atoms_of, parse_selector
from vla_attention.schemas.safe_text import visible

#: Who no longer reads an item. `total`: nobody reads it. `direct`: the action queries alone do not.
Reader = Literal["total", "direct", "pictures", "text"]
READERS: tuple[Reader, ...] = ("total", "direct", "pictures", "text")


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


def reader_of(condition: Condition) -> Reader | None:
    """Who no longer reads the keys of a condition; None where it is nobody, or somebody else."""
    if len(condition.interventions.keys) != 1:
        return None
    knockout = condition.interventions.keys[0]
    if knockout.queries == "prefix":
        return "pictures" if knockout.query_selector == "role:image" else "text" if knockout.query_selector else None
    return "total" if knockout.queries == "all" else "direct"


def item_rows(study: EffectStudy) -> list[ItemRow]:
    """A row for every group of keys that was cut off for two readers or more, the largest effect first."""
    by_name: dict[str, dict[Reader, dict[str, Any]]] = {}
    named: dict[str, Condition] = {}
    for condition in study.of_kind(Kind.WITHOUT):
        reader = reader_of(condition)
        if reader is not None:
            by_name.setdefault(condition.group_name, {})[reader] = study.of(condition)
            named[condition.group_name] = condition
    rows = [
        ItemRow(item_name(named[name]), _kind(named[name]), rows) for name, rows in by_name.items() if len(rows) > 1
    ]
    rows = [row for row in rows if {"total", "direct"} & set(row.by_reader)]
    return sorted(rows, key=lambda row: -(row.strongest["effect"] or 0.0))


def _kind(condition: Condition) -> str:
    """The kind of the one selector that a condition's group is made of: `word`, `camera`; empty for a composed one."""
    if condition.group is None:
        return ""
    try:
        atoms = [atom for text in condition.group.selectors for atom in atoms_of(parse_selector(text))]
    except UserError:
        return ""
    return atoms[0].kind if len(atoms) == 1 else ""


def item_name(condition: Condition) -> str:
    """`'red'` for a word's group, `agentview` for a camera's: the name without the kind that stands before it."""
    kind, name = _kind(condition), condition.group_name
    bare = name.removeprefix(f"{kind}_") if kind else name
    return f"'{bare}'" if kind == "word" else bare


def change_name(condition: Condition) -> str:
    """A short name of a change of words or pictures that was recorded; that of the condition for everything else."""
    given = condition.interventions
    if not condition.recorded:
        return condition.name
    if given.prompt is not None and given.prompt.kind == "synonyms":
        return visible(", ".join(f"'{word}' as '{other}'" for word, other in given.prompt.synonyms.items()))
    blank = [change.camera for change in given.images if change.kind == "blank"]
    return visible(f"{blank[0]} grey") if len(blank) == len(given.images) == 1 else condition.name


def ratio_of_effects(study: EffectStudy) -> dict[str, Any] | None:
    """The total effect of all pictures divided by that of all text, with its interval; None where one is missing.

    Returns:
        ratio, ratio_low, ratio_high, num_episodes of the quotient of mean effects over the same episodes.
    """
    sides: dict[str, str] = {}
    for condition in study.of_kind(Kind.WITHOUT):
        if reader_of(condition) == "total" and condition.group_name in ("visual", "linguistic"):
            sides[condition.group_name] = condition.name
    if len(sides) < 2:
        return None
    whole = study.episodes.filter(pl.col("phase") == ALL)
    place = [*EPISODE_ID, "instruction"]
    visual, linguistic = (
        whole.filter(pl.col("condition") == sides[name]).select(*place, pl.col("effect").alias(name))
        for name in ("visual", "linguistic")
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
