"""The effects as printed tables: the answer first, then every condition, phases, tasks, rollouts and the units."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import polars as pl

from vla_attention.analyze.effects.action_changes import MOSTLY_NOISE
from vla_attention.analyze.effects.answer import answer_lines, beyond, side_lines, word_lines
from vla_attention.analyze.effects.conditions import FLOORS, READERS, Condition, Kind, Reader
from vla_attention.analyze.effects.effect_study import EffectStudy, recorded_study
from vla_attention.analyze.effects.group_rows import GroupRow, group_rows
from vla_attention.analyze.effects.item_rows import ItemRow, item_rows, ratios_by_family
from vla_attention.analyze.effects.over_time import NOISE, EffectsOverTime, early_and_late
from vla_attention.analyze.effects.paired_replans import ALL, PHASES, stores_executed
from vla_attention.analyze.effects.sums import summary_of_sums
from vla_attention.analyze.measures.question_settings import AnalysisSettings
from vla_attention.analyze.show.answer import Section
from vla_attention.analyze.show.findings import few_families_note
from vla_attention.analyze.show.headings import interval_note, note_lines, wrap
from vla_attention.analyze.show.numbers import of_tasks
from vla_attention.analyze.show.plot_text import broken
from vla_attention.analyze.show.tables import (
    INTERVAL,
    Column,
    Table,
    count,
    estimate,
    interval,
    number,
    percent,
    signed_estimate,
    texts,
    words,
)
from vla_attention.analyze.statistics.intervals import DEFAULT_LEVEL
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.stores.reader import Store

#: Conditions beside each other in the table of tasks.
_MOST_IN_TASKS = 4
_EFFECT_NOTE = (
    "Effect: root mean square change of the {which} actions, each dimension in its standard deviation in the base. "
    "x noise: times that of another noise seed; random: of equally many random keys. mass, lift: the base's."
)


_READER_NAMES: dict[Reader, str] = {"total": "all", "direct": "action", "pictures": "pictures", "text": "text"}
_ITEM_NOTE = (
    "Change of the {which} actions, in their spread. all: nobody reads it; action (queries), pictures, text: these "
    "alone do not; direct: action / all. lift: of attention. turn: of the movement, degrees; grip: steps with the "
    "gripper reversed. {about} Effects do not add up."
)


def counted_actions(study: EffectStudy) -> str:
    """Which actions of a chunk effects are about, as an adjective."""
    return "executed" if stores_executed(study.given.base) else "chunk's"


def effects_sections(study: EffectStudy) -> list[Section]:
    """The whole answer."""
    groups = _items(study) if study.is_recorded else _groups(study)
    if study.is_recorded:  # the notes stand below: the table of items is what the first screen has room for
        sections = [*_header(study), *groups, *_families(study), *_left_out(study), _notes(study), *_others(study)]
    else:
        sections = [*_header(study), *groups, *_left_out(study), *_others(study), *_rollouts(study), _notes(study)]
    if study.conditions:
        every = [] if study.is_recorded else [_every(study)]
        sections += [*_floors(study), *every, _phases(study), *_tasks(study)]
        sections += [*_sums(study), _dimensions(study), _attention_notes(study)]
    return sections


def _header(study: EffectStudy) -> list[Section]:
    title = "EFFECTS: what the action does without what it could look at or read"
    lines = study.question.header(title, study.analysis.overall["layer"])
    measured = f"Effects were measured in {of_tasks(*study.measured)}." if study.conditions else ""
    items = item_rows(study) if study.is_recorded else []
    return [Section([lines, measured]), Section(word_lines(study, items) if items else answer_lines(study))]


def group_table(study: EffectStudy, caption: str = "") -> Table:
    """Every group knocked out, and everything but it, in a text and on the page."""
    rows = group_rows(study)
    with_norm = any(row.attention["norm"] is not None for row in rows)

    def attention(name: str) -> Callable[[GroupRow], float | None]:
        return lambda row: row.attention[name]

    def without(name: str) -> Callable[[GroupRow], float | None]:
        return lambda row: (row.without or {}).get(name)

    columns = [
        texts("group", lambda row: broken(row.label, 24), left=True),
        words(None, lambda row: row.label, "group"),
        number("keys", attention("keys")),
        number("mass", attention("mass")),
        percent(None, attention("mass"), "mass"),
        number("lift", attention("lift"), "lift"),
        *([number("norm", attention("norm"))] if with_norm else []),
        number("without", without("effect"), "without"),
        interval("effect", INTERVAL, of=lambda row: row.without),
        number("x noise", without("over_noise"), "times the noise"),
        number("random", without("random"), "random keys"),
        number("only", lambda row: (row.only or {}).get("effect"), "alone"),
        interval("effect", INTERVAL, of=lambda row: row.only),
    ]
    return Table(columns, rows, caption)


def _groups(study: EffectStudy) -> list[Section]:
    """The answer: every group knocked out, and everything but it."""
    table = group_table(study)
    note = _EFFECT_NOTE.format(which=counted_actions(study))
    about = f"{interval_note(DEFAULT_LEVEL, study.question.units.words)} Effects do not add up."
    return [Section([table, note, about], "WITHOUT IT, AND WITH IT ALONE  effect on the action")] if table.rows else []


def of_task(settings: AnalysisSettings, task: int | None) -> AnalysisSettings:
    """The settings for one task; unchanged for None."""
    return settings if task is None else replace(settings, tasks=(task,))


def recorded_sections(stores: Sequence[Store], settings: AnalysisSettings, kind: str) -> list[Section]:
    """The effects of a kind of item (`word`, `object`) that a store measured beside its calls; nothing without any."""
    title = "WITHOUT IT  effect on the action, by who no longer reads it"
    try:
        study = recorded_study(stores, settings)
    except BadArgument as error:
        return [Section([str(error)], title)]
    if study is None:
        return []
    table = item_table(study, kind)
    note = f"{_item_note(study)} More: vla-attention effects {stores[0].path}"
    return [Section([table, note], title)] if table.rows else []


def item_table(study: EffectStudy, kind: str | None = None) -> Table:
    """Every item that was cut off for several readers: attention, and the effect by who no longer reads it.

    kind: only those with such a selector.
    """
    items = [item for item in item_rows(study) if kind in (None, item.kind)]
    # Words first: they are what one asks for, and a screen has room for few rows.
    items.sort(key=lambda item: item.kind != "word")
    shown = [reader for reader in READERS if any(reader in item.by_reader for item in items)]
    moves = any(item.strongest["angle"] is not None for item in items)

    def of(reader: Reader) -> Column:
        return number(_READER_NAMES[reader], lambda item: item.effect(reader))

    def strongest(name: str) -> Callable[[ItemRow], float | None]:
        return lambda item: item.strongest[name]

    columns = [
        texts("item", lambda item: broken(item.name, 24), left=True),
        number("lift", strongest("lift"), "lift"),
        of(shown[0]) if shown else number("effect", strongest("effect")),
        interval("effect", INTERVAL, of=lambda item: item.strongest),
        *map(of, shown[1:]),
        percent("direct", lambda item: item.direct_share, decimals=0),
        number("x noise", strongest("over_noise"), "times the noise"),
    ]
    if moves:
        columns += [number("turn", strongest("angle"), "turn"), percent("grip", strongest("gripper_flips"), decimals=0)]
    return Table(columns, items)


def _items(study: EffectStudy) -> list[Section]:
    table = item_table(study)
    if not table.rows:
        return _groups(study)
    return [Section([table, _item_note(study)], "WITHOUT IT  effect on the action, by who no longer reads it")]


def _item_note(study: EffectStudy) -> str:
    about = interval_note(DEFAULT_LEVEL, study.question.units.words)
    return _ITEM_NOTE.format(which=counted_actions(study), about=about)


#: Rows of the printed course of effects; the table and the picture have every bin.
_BINS = 10


def over_time_sections(effects: EffectsOverTime) -> list[Section]:
    """Effects over an episode's time, for `vla-attention time`."""
    course = effects.course
    items = course["item"].unique(maintain_order=True).to_list()
    bins = course.partition_by("position", maintain_order=True)
    stride = -(-len(bins) // _BINS)
    rows = [
        part.row(0, named=True) | {f"of {row['item']}": row["effect"] for row in part.iter_rows(named=True)}
        for part in sorted(bins, key=lambda part: float(part["position"][0]))[::stride]
    ]
    columns = [
        texts("time", lambda row: f"{row['position_low']:.2f}-{row['position_high']:.2f}", left=True),
        *(number("noise" if name == NOISE else broken(name, 12), _value(f"of {name}")) for name in items),
    ]
    note = (
        f"Change of the {counted_actions(effects.study)} actions without it, in their spread; noise: by another noise "
        f"seed. The table has intervals. More: vla-attention effects {effects.study.given.base.path}"
    )
    return [Section([early_and_late(effects.study), Table(columns, rows), note], "EFFECTS OVER THE EPISODE'S TIME")]


def _value(name: str) -> Callable[[dict[str, Any]], float | None]:
    return lambda row: row.get(name)


def _condition(width: int) -> Column:
    return texts("condition", lambda row: broken(row["condition"], width), left=True)


_ANGLE_AND_GRIPPER = (number("angle", "angle"), percent("gripper", "gripper_flips"))


def _others(study: EffectStudy) -> list[Section]:
    """Every other change: noise, prompts, pictures, scaled attention."""
    shown = [
        condition for condition in study.conditions if condition.kind not in (Kind.WITHOUT, Kind.ONLY, Kind.RANDOM)
    ]
    rows = [study.of(condition) | {"description": condition.description} for condition in shown]
    columns = [
        _condition(30),
        *estimate("effect", "effect"),
        number("x noise", "over_noise"),
        *_ANGLE_AND_GRIPPER,
        texts("what was changed", "description", running=True),
    ]
    return [Section([Table(columns, rows)], "OTHER CHANGES")] if shown else []


def _every(study: EffectStudy) -> Section:
    columns = [
        _condition(24),
        count("episodes", "num_episodes"),
        *estimate("effect", "effect"),
        *estimate("x noise", "over_noise"),
        number("chunk", "effect_chunk"),
        *_ANGLE_AND_GRIPPER,
    ]
    note = (
        "chunk: effect over the whole chunk, not only its executed steps. angle: degrees between the first actions' "
        "translations. gripper: executed steps whose gripper command has the other sign; both of runs in vla-capture's "
        "own suites only, whose actions are known."
    )
    described = [part for one in study.conditions for part in wrap(f"{one.name}: {one.description}", rest="  ")]
    return Section([Table(columns, [*map(study.of, study.conditions)]), note, described], "EVERY CONDITION")


def _told(study: EffectStudy) -> list[Condition]:
    """The conditions that the text has row by row: of recorded effects one for each item, and other changes.

    A run that records effects has some hundred; the tables have all.
    """
    if not study.is_recorded:
        return list(study.conditions)
    strongest = {item.strongest["condition"] for item in item_rows(study)}
    of_keys = (Kind.WITHOUT, Kind.ONLY, Kind.RANDOM)
    return [one for one in study.conditions if one.name in strongest or one.kind not in of_keys]


def _floors(study: EffectStudy) -> list[Section]:
    """Effects minus those of another noise seed and of random keys, in the same episodes."""
    tested = [study.of(condition) for condition in _told(study) if condition.kind not in FLOORS]
    columns = [
        _condition(24),
        *signed_estimate("- noise", "minus_noise"),
        number("q", "minus_noise_q"),
        *signed_estimate("- random", "minus_random"),
        number("q", "minus_random_q"),
    ]
    note = (
        "Effect minus that of another noise seed, and of random keys, in the same episode. q: p of no difference, "
        "adjusted for the number of conditions (Benjamini-Hochberg)."
    )
    exceeding = [
        beyond(study, "minus_noise", "an effect beyond the noise"),
        beyond(study, "minus_random", "an effect beyond that of random keys"),
    ]
    return [Section([Table(columns, tested), note, *exceeding], "ABOVE THE FLOORS")] if tested else []


def _phases(study: EffectStudy) -> Section:
    rows = study.summary.filter(scope="all").rows_by_key(["condition", "phase"], named=True, unique=True)

    def of(phase: str) -> tuple[Column, Column]:
        def row(condition: Condition) -> dict[str, Any]:
            return rows.get((condition.name, phase), {})

        effect = number(phase.removesuffix(" third"), lambda condition: row(condition).get("effect"))
        return effect, interval("effect", of=row)

    condition = texts("condition", lambda condition: broken(condition.name, 24), left=True)
    columns = [condition, *(column for phase in PHASES for column in of(phase))]
    return Section([Table(columns, _told(study))], "THIRDS OF THE EPISODE  effect")


def _tasks(study: EffectStudy) -> list[Section]:
    rows = study.summary.filter(scope="task", phase=ALL)
    tasks = rows.select("task_id", "instruction").unique("task_id", keep="first").sort("task_id")
    if tasks.height < 2:
        return []
    by_task = rows.rows_by_key(["task_id", "condition"], named=True, unique=True)
    shown = _most_telling(study)

    def of(condition: Condition) -> Column:
        def effect(task: dict[str, Any]) -> float | None:
            return by_task.get((task["task_id"], condition.name), {}).get("effect")

        return number(broken(condition.name, 14), effect)

    def episodes(task: dict[str, Any]) -> int:
        of_task = [by_task.get((task["task_id"], condition.name), {}) for condition in shown]
        return max((row["num_episodes"] for row in of_task if row), default=0)

    columns = [
        count("task", "task_id", left=True),
        count("n", episodes),
        *map(of, shown),
        texts("instruction", "instruction", running=True),
    ]
    more = len(study.conditions) - len(shown)
    title = f"PER TASK  effect{f'; {more} more conditions are in the tables' if shown and more else ''}"
    return [Section([Table(columns, tasks.to_dicts())], title)]


def _families(study: EffectStudy) -> list[Section]:
    """All pictures against all text, over everything and by family of tasks."""
    columns = [
        texts("family", lambda row: broken(row["family"] or "(none)", 40), left=True),
        count("tasks", "num_tasks"),
        count("n", "num_episodes"),
        number("visual", "visual"),
        number("text", "linguistic"),
        *estimate("ratio", "ratio"),
        number("attention", "attention"),
    ]
    note = (
        "Effect without all pictures, without all text, and their quotient. attention: the ratio visual / linguistic "
        "of the same episodes, geometric mean."
    )
    rows, items = ratios_by_family(study), item_rows(study)
    said = side_lines(study, items) if items else []
    parts: list[Table | str] = [*said, *((Table(columns, rows), note) if rows else ())]
    return [Section(parts, "PICTURES AGAINST TEXT")] if parts else []


def _most_telling(study: EffectStudy) -> list[Condition]:
    """The conditions that stand beside each other per task: noise, then groups without, then alone, then others."""
    if study.is_recorded:
        largest = [item.strongest["condition"] for item in item_rows(study)][: _MOST_IN_TASKS - 1]
        by_name = {condition.name: condition for condition in study.conditions}
        return [*study.of_kind(Kind.NOISE)[:1], *(by_name[name] for name in largest)]
    order = (Kind.NOISE, Kind.WITHOUT, Kind.ONLY)
    first = [condition for kind in order for condition in study.of_kind(kind)]
    rest = [condition for condition in study.conditions if condition.kind not in (*order, Kind.RANDOM)]
    return [*first, *rest][:_MOST_IN_TASKS]


def _rollouts(study: EffectStudy) -> list[Section]:
    columns = [
        _condition(30),
        count("pairs", "num_episodes"),
        percent("base solves", "success_base", decimals=0),
        percent("solves", "success", decimals=0),
        *signed_estimate("difference", "success_difference"),
        *signed_estimate("steps", "steps_difference"),
    ]
    note = (
        "Rollouts under an intervention, paired with the base's by initial state; steps: rollout minus base (a failure "
        "is stopped at the most steps)."
    )
    if not study.given.rollouts:
        return []
    rows = study.rollouts.filter(scope="all").to_dicts()
    return [Section([Table(columns, rows), note], "ROLLOUTS  success and number of steps")]


def _sums(study: EffectStudy) -> list[Section]:
    """Groups that were not measured together, by sums of single effects."""
    if study.sums.is_empty():
        return []
    rows = summary_of_sums(study.sums, study.question).filter(pl.col("scope") == "all").to_dicts()
    columns = [
        texts("group", lambda row: broken(row["group"], 24), left=True),
        texts("read by", lambda row: _READER_NAMES[row["reader"]], left=True),
        count("episodes", "num_episodes"),
        number("items", "num_items"),
        *estimate("size of sum", "size_of_sum"),
        number("sum of sizes", "sum_of_sizes"),
    ]
    note = (
        "Single effects do not add up: of whole instructions of a small policy the size of the summed changes was 0.99 "
        "[0.79, 1.36] times the exact effect, the sum of sizes 1.38 [1.07, 1.97]. Exact: vla-attention capture rerun "
        f"{study.given.base.path} --knockout GROUP --knockout-queries all."
    )
    return [Section([Table(columns, rows), note], "NOT MEASURED TOGETHER  sums of single effects")]


def _dimensions(study: EffectStudy) -> Section:
    spread = study.spread
    noise = [(None, "-") if spread.noise is None else spread.noise.cells(i) for i in range(len(spread.spread))]
    columns = [
        count("dimension", lambda i: i),
        number("spread", lambda i: float(spread.spread[i])),
        number("noise", lambda i: noise[i][0]),
        texts("interval", lambda i: noise[i][1]),
        texts("compared", lambda i: spread.reasons[i] or "yes", left=True),
    ]
    note = (
        "spread: standard deviation of the base's actions. noise: root mean square change by another noise seed, in "
        f"spreads, with a {DEFAULT_LEVEL:.0%} interval over episodes; without --dimensions, those whose interval lies "
        "above 1 are left out, as they are more noise than movement (all are kept where all would be)."
    )
    return Section([Table(columns, range(len(noise))), note], "UNITS  dimensions of the action")


def _left_out(study: EffectStudy) -> list[Section]:
    """Which dimensions of the action are not compared."""
    named = [f"{i} ({reason})" for i, reason in enumerate(study.spread.reasons) if reason]
    same = ""
    if any(reason == MOSTLY_NOISE for reason in study.spread.reasons):
        used = " ".join(str(i) for i in np.flatnonzero(study.spread.used))
        same = f" To compare with another policy, give both the same: --dimensions {used}."
    said = note_lines([f"not compared: dimensions {', '.join(named)} of the action.{same}"])
    return [Section([said])] if named else []


def _notes(study: EffectStudy) -> Section:
    rows = study.summary.filter(scope="all", phase=ALL)
    if study.is_recorded:
        rows = rows.filter(pl.col("condition").is_in([item.strongest["condition"] for item in item_rows(study)]))
        few = few_families_note(rows, "group", study.question.units)
    else:
        few = few_families_note(rows, "condition", study.question.units)
    return Section([note_lines([*study.notes, *([few] if few else [])])])


def _attention_notes(study: EffectStudy) -> Section:
    """Where attention is of another site, and why a group has none."""
    lines: list[str] = []
    told = [condition.group for condition in study.conditions]
    for group, attention in study.attention.items():
        if group not in told:
            continue
        if attention.site is None:
            lines += note_lines([f"no attention beside '{group.text}': {attention.note}"])
        elif attention.site != study.question.site:
            lines += note_lines([f"attention to '{group.text}' is at site '{attention.site}'."])
    return Section([lines])
