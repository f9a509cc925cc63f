"""What each item does to the action, by who no longer reads it: rows of the answer to recorded effects."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import polars as pl

from vla_attention.analyze.effects.conditions import Condition, Kind, Reader, item_name, reader_of, selector_kind
from vla_attention.analyze.effects.effect_study import EffectStudy
from vla_attention.analyze.effects.paired_replans import ALL
from vla_attention.analyze.measures.frames import EPISODE_ID, LAYERS_AVG
from vla_attention.analyze.statistics.episode_intervals import means_with_intervals
from vla_attention.analyze.statistics.intervals import NO_LIMITS, POSITIVE
from vla_attention.schemas.safe_text import visible

#: All pictures, and all text.
MODALITIES: tuple[str, str] = ("visual", "linguistic")


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
    table = _both_sides(study)
    if table is None:
        return None
    return means_with_intervals(table, ["question"], _SIDES, study.question.sampling, quotients=_RATIO).row(
        0, named=True
    )


def ratios_by_family(study: EffectStudy) -> list[dict[str, Any]]:
    """The same for each family of tasks, with the ratio of the base's attention beside it; nothing with one family.

    Returns:
        For each family: family, num_episodes, num_tasks, visual, linguistic, ratio with its bounds, and `attention`,
        the geometric mean over the family's tasks of the ratio visual / linguistic (null without one).
    """
    table, sampling = _both_sides(study), study.question.sampling
    if table is None or len({*sampling.families.values()}) < 2:
        return []
    families = [sampling.families.get((row["suite"], row["task_id"]), "") for row in table.iter_rows(named=True)]
    named = table.with_columns(family=pl.Series([visible(name) for name in families], dtype=pl.String))
    episodes = study.analysis.episodes
    layer = LAYERS_AVG
    if study.analysis.grouping.ratio is not None:
        of_layer = episodes.filter(layer=layer).select(*EPISODE_ID, pl.col("log_ratio_mean").alias("attention"))
        named = named.join(of_layer, on=EPISODE_ID, how="left", maintain_order="left")
    else:
        named = named.with_columns(attention=pl.lit(None, pl.Float64))
    values = {**_SIDES, "attention": NO_LIMITS}
    rows = means_with_intervals(named, ["family"], values, sampling, quotients=_RATIO)
    return rows.with_columns(pl.col("attention").exp()).to_dicts()


_SIDES = dict.fromkeys(MODALITIES, POSITIVE)
_RATIO = {"ratio": MODALITIES}


def _both_sides(study: EffectStudy) -> pl.DataFrame | None:
    """One row per episode with the total effects `visual` and `linguistic`; None where one was not measured."""
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
    return pairs if pairs.height else None
