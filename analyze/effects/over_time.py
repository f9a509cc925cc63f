"""Recorded effects replan by replan, and over an episode's time: when a word decides, and when it no longer does."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.effects.action_changes import counted
from vla_attention.analyze.effects.conditions import Condition, Kind, reader_of
from vla_attention.analyze.effects.effect_study import EffectStudy, recorded_study
from vla_attention.analyze.effects.item_rows import MODALITIES, item_rows
from vla_attention.analyze.effects.paired_replans import (
    CHANGES,
    PHASES,
    BaseEpisode,
    actions_of,
    changes_of,
    changes_recorded,
)
from vla_attention.analyze.measures.alignment import episode_timing, on_episode_time
from vla_attention.analyze.measures.question_settings import AnalysisSettings
from vla_attention.analyze.show.numbers import format_number
from vla_attention.analyze.statistics.episode_intervals import means_with_intervals
from vla_attention.analyze.statistics.intervals import POSITIVE
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.safe_text import visible
from vla_attention.schemas.stores.reader import Store

Array = NDArray[np.float64]

#: Items beside each other over time, besides pictures, text and the noise.
MOST_ITEMS = 4
NOISE = "another noise seed"
_IDENTITY: dict[str, Any] = {
    "suite": pl.String,
    "task_id": pl.Int64,
    "instruction": pl.String,
    "episode_index": pl.Int64,
}


def effects_by_replan(study: EffectStudy) -> pl.DataFrame:
    """One row per (episode, replan, condition) that was measured beside the base's calls.

    Returns:
        suite, task_id, instruction, episode_index, replan, env_step, condition, kind, group, reader (null where no key
        was cut), and `paired_replans.CHANGES`.
    """
    kinds: dict[str, Any] = {"replan": pl.Int64, "env_step": pl.Int64}
    named = ("condition", "kind", "group", "reader")
    schema = _IDENTITY | kinds | dict.fromkeys(named, pl.String) | dict.fromkeys(CHANGES, pl.Float64)
    parts = [pl.DataFrame(schema=schema)]
    for base, condition, changes in _changes(study):
        group = None if condition.group is None else condition.group_name
        names = dict(zip(named, (condition.name, condition.kind.value, group, reader_of(condition)), strict=True))
        replans = np.flatnonzero(np.isfinite(changes[:, 0]))
        values = {"replan": replans, "env_step": base.env_step[replans]}
        values |= {name: changes[replans, i] for i, name in enumerate(CHANGES)}
        constant = [pl.lit(value, schema[name]).alias(name) for name, value in (_identity(base) | names).items()]
        table = pl.DataFrame(values).with_columns(constant).select(*schema)
        parts.append(table.with_columns(pl.col(CHANGES).fill_nan(None)))
    return pl.concat(parts)


@dataclass(frozen=True)
class EffectsOverTime:
    """Recorded effects over an episode's time: the study, and the table of `effects_over_time`."""

    study: EffectStudy
    course: pl.DataFrame


def over_time_of_stores(stores: Sequence[Store], settings: AnalysisSettings, num_bins: int) -> EffectsOverTime | None:
    """The effects over time that a store measured beside its calls; None where there are none that can be shown."""
    try:
        study = recorded_study(stores, settings)
    except BadArgument:  # `vla-attention effects` says why
        return None
    course = None if study is None else effects_over_time(study, num_bins)
    return None if study is None or course is None or course.is_empty() else EffectsOverTime(study, course)


def effects_over_time(study: EffectStudy, num_bins: int) -> pl.DataFrame:
    """Mean effects in equal parts of an episode's time, of the items with the largest ones; nothing without an item.

    Returns:
        One row per (item, bin): `item` (with `NOISE`), `reader`, `position_low`, `position`, `position_high` (0 to 1),
        and the columns of `means_with_intervals` of `effect`, with pointwise intervals.
    """
    shown = _shown(study)
    edges = np.linspace(0.0, 1.0, num_bins + 1)
    places = {"position_low": edges[:-1], "position": (edges[:-1] + edges[1:]) / 2, "position_high": edges[1:]}
    columns = ["item", "reader", *places]
    parts = []
    for base, condition, changes in _changes(study, shown):
        num_steps = episode_timing(base.item.store.attributes, base.item.episode, base.env_step)[1]
        effect = on_episode_time(changes[:, :1], base.starts, num_steps, num_bins)[:, 0]
        constant = _identity(base) | {"item": shown[condition.name], "reader": reader_of(condition)}
        named = [pl.lit(value, _IDENTITY.get(name, pl.String)).alias(name) for name, value in constant.items()]
        parts.append(pl.DataFrame(places | {"effect": effect}).with_columns(named))
    if not parts:
        return pl.DataFrame(schema=dict.fromkeys(columns, pl.Float64))
    order = {name: number for number, name in enumerate(dict.fromkeys(shown.values()))}
    table = pl.concat(parts).filter(pl.col("effect").is_finite())
    means = means_with_intervals(table, columns, {"effect": POSITIVE}, study.question.sampling)
    return means.sort(pl.col("item").replace_strict(order, return_dtype=pl.Int64), "position")


def early_and_late(study: EffectStudy) -> str:
    """What the words with the largest effects do in the first and in the last third; empty without a word."""
    words = [item for item in item_rows(study) if item.kind == "word"][:MOST_ITEMS]
    rows = study.summary.filter(scope="all").rows_by_key(["condition", "phase"], named=True, unique=True)
    parts = []
    for word in words:
        ends = [rows.get((word.strongest["condition"], phase), {}).get("effect") for phase in (PHASES[0], PHASES[-1])]
        if None not in ends:
            parts.append(f"{word.name} {' and '.join(map(format_number, ends))}")
    return f"Without it the action changes in the first and in the last third by: {', '.join(parts)}." if parts else ""


def shares_of_dimensions(study: EffectStudy, name: str) -> Array:
    """How the squared effect of a recorded condition is shared by the dimensions of the action, (dimension,).

    name: of the condition. 0 for dimensions that are not compared, and everywhere where nothing changed.
    """
    used, squares = study.spread.used, np.zeros(len(study.spread.spread))
    for base, _, actions in _recorded_actions(study, [name]):
        change = np.where(np.isfinite(actions), actions - base.actions, 0.0)
        change *= counted(base.executed, change.shape[1])[..., None]
        squares[used] += ((change[..., used] / study.spread.spread[used]) ** 2).sum(axis=(0, 1))
    total = squares.sum()
    return squares / total if total > 0 else squares


def _changes(
    study: EffectStudy, names: Collection[str] | None = None
) -> Iterator[tuple[BaseEpisode, Condition, Array]]:
    """(replan, change) of `CHANGES` for every episode and condition of `_recorded_actions`; NaN where not measured."""
    for base, condition, actions in _recorded_actions(study, names):
        changes = changes_of(base, actions, study.spread)
        changes[~np.isfinite(actions).all(axis=(1, 2))] = np.nan
        yield base, condition, changes


def _recorded_actions(
    study: EffectStudy, names: Collection[str] | None
) -> Iterator[tuple[BaseEpisode, Condition, Array]]:
    """Actions (replan, step, dimension) of every selected episode under recorded conditions that it was measured under.

    names: of the conditions; None for all. NaN at replans without a measurement.
    """
    recorded = [one for one in study.conditions if one.recorded and (names is None or one.name in names)]
    for item in study.question.selected:
        if item.episode.attributes.effects is None or not recorded:
            continue
        base = BaseEpisode.of(item)
        entries = changes_recorded(base)
        for condition in recorded:
            actions = actions_of(base, item.episode, condition, entries)
            if np.isfinite(actions).all(axis=(1, 2)).any():
                yield base, condition, actions


def _shown(study: EffectStudy) -> dict[str, str]:
    """The items over time by the names of their conditions: pictures, text, the largest words (or others), noise."""
    items = item_rows(study)
    sides = [item for item in items if item.name in MODALITIES]
    words = [item for item in items if item.kind == "word"]
    others = (words or [item for item in items if item.name not in MODALITIES])[:MOST_ITEMS]
    shown = {item.strongest["condition"]: item.name for item in (*sides, *others)}
    return shown | {condition.name: NOISE for condition in study.of_kind(Kind.NOISE)}


def _identity(base: BaseEpisode) -> dict[str, Any]:
    attributes = base.item.episode.attributes
    known = (base.item.store.suite, attributes.task_id, visible(attributes.instruction), attributes.episode_index)
    return dict(zip(_IDENTITY, known, strict=True))
