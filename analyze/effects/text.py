"""The effects as printed tables: the answer first, then every condition, phases, tasks, rollouts and the units."""

from __future__ import annotations

from typing import Any

import numpy as np
import polars as pl

from vla_attention.analyze.effects.action_changes import MOSTLY_NOISE
from vla_attention.analyze.effects.answer import answer_lines, beyond
from vla_attention.analyze.effects.conditions import FLOORS, Condition, Kind
from vla_attention.analyze.effects.effect_study import EffectStudy
from vla_attention.analyze.effects.group_rows import GroupRow, group_rows
from vla_attention.analyze.effects.paired_replans import ALL, PHASES, stores_executed
from vla_attention.analyze.show.findings import few_families_note
from vla_attention.analyze.show.headings import heading, interval_note, note_lines, wrap
from vla_attention.analyze.show.numbers import format_number, format_percent, format_signed, of_tasks, row_interval
from vla_attention.analyze.show.plot_text import broken
from vla_attention.analyze.show.text_table import text_table
from vla_attention.analyze.statistics.intervals import DEFAULT_LEVEL

#: Conditions beside each other in the table of tasks.
_MOST_IN_TASKS = 4
_EFFECT_NOTE = (
    "Effect: root mean square change of the {which} actions, each dimension in its standard deviation in the base. "
    "x noise: times that of another noise seed; random: of equally many random keys. mass, lift: the base's."
)


def counted_actions(study: EffectStudy) -> str:
    """Which actions of a chunk effects are about, as an adjective."""
    return "executed" if stores_executed(study.given.base) else "chunk's"


def effects_text(study: EffectStudy) -> str:
    """The whole text."""
    parts = [_header(study), _groups(study), _left_out(study), _others(study), _rollouts(study), _notes(study)]
    if study.conditions:
        parts += [
            _floors(study),
            _every(study),
            _phases(study),
            _tasks(study),
            _dimensions(study),
            _attention_notes(study),
        ]
    return "\n\n".join(part for part in parts if part) + "\n"


def _header(study: EffectStudy) -> str:
    title = "EFFECTS: what the action does without what it could look at or read"
    lines = study.question.header(title, study.analysis.overall["layer"])
    if study.conditions:
        lines += wrap(f"Effects were measured in {of_tasks(*study.measured)}.")
    return "\n".join([*lines, "", *(line for text in answer_lines(study) for line in wrap(text))])


def _groups(study: EffectStudy) -> str:
    """The answer: every group knocked out, and everything but it."""
    rows = group_rows(study)
    if not rows:
        return ""
    with_norm = any(row.attention["norm"] is not None for row in rows)
    header = ["group", "keys", "mass", "lift", *(["norm"] if with_norm else [])]
    header += ["without", "interval", "x noise", "random", "only", "interval"]
    body = [_group_cells(row, with_norm) for row in rows]
    lines = [heading("WITHOUT IT, AND WITH IT ALONE  effect on the action"), text_table(header, body, left=(0,))]
    lines += wrap(_EFFECT_NOTE.format(which=counted_actions(study)))
    lines += wrap(interval_note(DEFAULT_LEVEL, study.question.units.words) + " Effects do not add up.")
    return "\n".join(lines)


def _group_cells(row: GroupRow, with_norm: bool) -> list[str]:
    known, without, only = row.attention, row.without, row.only
    cells = [broken(row.label, 24), *(format_number(known[name]) for name in ("keys", "mass", "lift"))]
    cells += [format_number(known["norm"])] if with_norm else []
    return [*cells, *_effect(without), _of(without, "over_noise"), _of(without, "random"), *_effect(only)]


def _effect(row: dict[str, Any] | None) -> list[str]:
    return ["-", "-"] if row is None else [format_number(row["effect"]), row_interval(row, "effect")]


def _of(row: dict[str, Any] | None, name: str) -> str:
    return "-" if row is None else format_number(row[name])


def _others(study: EffectStudy) -> str:
    """Every other change: noise, prompts, pictures, scaled attention."""
    shown = [
        condition for condition in study.conditions if condition.kind not in (Kind.WITHOUT, Kind.ONLY, Kind.RANDOM)
    ]
    if not shown:
        return ""
    header = ["condition", "effect", "interval", "x noise", "angle", "gripper"]
    rows = [study.of(condition) for condition in shown]
    body = [
        [
            broken(row["condition"], 30),
            *_effect(row),
            _of(row, "over_noise"),
            format_number(row["angle"]),
            format_percent(row["gripper_flips"]),
        ]
        for row in rows
    ]
    texts = [condition.description for condition in shown]
    return "\n".join(
        [heading("OTHER CHANGES"), text_table(header, body, left=(0,), last="what was changed", texts=texts)]
    )


def _every(study: EffectStudy) -> str:
    header = ["condition", "episodes", "effect", "interval", "x noise", "interval", "chunk", "angle", "gripper"]
    body = []
    for condition in study.conditions:
        row = study.of(condition)
        cells = [broken(condition.name, 24), str(row["num_episodes"]), *_effect(row)]
        cells += [_of(row, "over_noise"), row_interval(row, "over_noise"), format_number(row["effect_chunk"])]
        body.append([*cells, format_number(row["angle"]), format_percent(row["gripper_flips"])])
    note = (
        "chunk: effect over the whole chunk, not only its executed steps. angle: degrees between the first actions' "
        "translations. gripper: executed steps whose gripper command has the other sign; both of runs in vla-capture's "
        "own suites only, whose actions are known."
    )
    lines = [heading("EVERY CONDITION"), text_table(header, body, left=(0,)), *wrap(note)]
    lines += [part for one in study.conditions for part in wrap(f"{one.name}: {one.description}", rest="  ")]
    return "\n".join(lines)


def _floors(study: EffectStudy) -> str:
    """Effects minus those of another noise seed and of random keys, in the same episodes."""
    tested = [condition for condition in study.conditions if condition.kind not in FLOORS]
    if not tested:
        return ""
    header = ["condition", "- noise", "interval", "q", "- random", "interval", "q"]
    body = []
    for condition in tested:
        row = study.of(condition)
        cells = [broken(condition.name, 24)]
        for name in ("minus_noise", "minus_random"):
            cells += [format_signed(row[name]), row_interval(row, name), format_number(row[f"{name}_q"])]
        body.append(cells)
    note = (
        "Effect minus that of another noise seed, and of random keys, in the same episode. q: p of no difference, "
        "adjusted for the number of conditions (Benjamini-Hochberg)."
    )
    lines = [heading("ABOVE THE FLOORS"), text_table(header, body, left=(0,)), *wrap(note)]
    lines += wrap(beyond(study, "minus_noise", "an effect beyond the noise"))
    lines += wrap(beyond(study, "minus_random", "an effect beyond that of random keys"))
    return "\n".join(lines)


def _phases(study: EffectStudy) -> str:
    of_phase = {
        (row["condition"], row["phase"]): row
        for row in study.summary.filter(pl.col("scope") == "all").iter_rows(named=True)
    }
    header = ["condition", *(text for phase in PHASES for text in (phase.removesuffix(" third"), "interval"))]
    body = [
        [broken(one.name, 24), *(cell for phase in PHASES for cell in _effect(of_phase.get((one.name, phase))))]
        for one in study.conditions
    ]
    return "\n".join([heading("THIRDS OF THE EPISODE  effect"), text_table(header, body, left=(0,))])


def _tasks(study: EffectStudy) -> str:
    rows = study.summary.filter(pl.col("scope") == "task", pl.col("phase") == ALL)
    tasks = rows.select("task_id", "instruction").unique("task_id", keep="first").sort("task_id")
    if tasks.height < 2:
        return ""
    effect = {(row["task_id"], row["condition"]): row for row in rows.iter_rows(named=True)}
    shown = _most_telling(study)
    header = ["task", "n", *(broken(one.name, 14) for one in shown)]
    body = []
    for task in tasks["task_id"]:
        found = [effect.get((task, one.name)) for one in shown]
        n = max(row["num_episodes"] for row in found if row is not None) if any(found) else 0
        body.append([str(task), str(n), *(_of(row, "effect") for row in found)])
    more = f"; {len(study.conditions) - len(shown)} more conditions are in the tables" if shown else ""
    title = heading(f"PER TASK  effect{more if len(shown) < len(study.conditions) else ''}")
    return "\n".join([title, text_table(header, body, left=(0,), last="instruction", texts=list(tasks["instruction"]))])


def _most_telling(study: EffectStudy) -> list[Condition]:
    """The conditions that stand beside each other per task: noise, then groups without, then alone, then others."""
    order = (Kind.NOISE, Kind.WITHOUT, Kind.ONLY)
    first = [condition for kind in order for condition in study.of_kind(kind)]
    rest = [condition for condition in study.conditions if condition.kind not in (*order, Kind.RANDOM)]
    return [*first, *rest][:_MOST_IN_TASKS]


def _rollouts(study: EffectStudy) -> str:
    if not study.given.rollouts:
        return ""
    header = ["condition", "pairs", "base solves", "solves", "difference", "interval", "steps", "interval"]
    body = [
        [
            broken(row["condition"], 30),
            str(row["num_episodes"]),
            format_percent(row["success_base"], 0),
            format_percent(row["success"], 0),
            format_signed(row["success_difference"]),
            row_interval(row, "success_difference"),
            format_signed(row["steps_difference"]),
            row_interval(row, "steps_difference"),
        ]
        for row in study.rollouts.filter(pl.col("scope") == "all").iter_rows(named=True)
    ]
    note = (
        "Rollouts under an intervention, paired with the base's by initial state; steps: rollout minus base (a failure "
        "is stopped at the most steps)."
    )
    return "\n".join(
        [heading("ROLLOUTS  success and number of steps"), text_table(header, body, left=(0,)), *wrap(note)]
    )


def _dimensions(study: EffectStudy) -> str:
    spread = study.spread
    number = len(spread.spread)
    noise = [(None, "-")] * number if spread.noise is None else [spread.noise.cells(i) for i in range(number)]
    body = [
        [str(i), format_number(float(spread.spread[i])), format_number(value), interval, spread.reasons[i] or "yes"]
        for i, (value, interval) in enumerate(noise)
    ]
    table = text_table(["dimension", "spread", "noise", "interval", "compared"], body, left=(4,))
    note = (
        "spread: standard deviation of the base's actions. noise: root mean square change by another noise seed, in "
        f"spreads, with a {DEFAULT_LEVEL:.0%} interval over episodes; without --dimensions, those whose interval lies "
        "above 1 are left out, as they are more noise than movement (all are kept where all would be)."
    )
    return "\n".join([heading("UNITS  dimensions of the action"), table, *wrap(note)])


def _left_out(study: EffectStudy) -> str:
    """Which dimensions of the action are not compared."""
    named = [f"{i} ({reason})" for i, reason in enumerate(study.spread.reasons) if reason]
    if not named:
        return ""
    same = ""
    if any(reason == MOSTLY_NOISE for reason in study.spread.reasons):
        used = " ".join(str(i) for i in np.flatnonzero(study.spread.used))
        same = f" To compare with another policy, give both the same: --dimensions {used}."
    return "\n".join(note_lines([f"not compared: dimensions {', '.join(named)} of the action.{same}"]))


def _notes(study: EffectStudy) -> str:
    whole = study.summary.filter(pl.col("scope") == "all", pl.col("phase") == ALL)
    few = few_families_note(whole, "condition", study.question.units)
    return "\n".join(note_lines([*study.notes, *([few] if few else [])]))


def _attention_notes(study: EffectStudy) -> str:
    """Where attention is of another site, and why a group has none."""
    lines: list[str] = []
    told = [condition.group for condition in study.conditions]
    for group, found in study.attention.items():
        if group not in told:
            continue
        if found.site is None:
            lines += note_lines([f"no attention beside '{group.text}': {found.note}"])
        elif found.site != study.question.site:
            lines += note_lines([f"attention to '{group.text}' is at site '{found.site}'."])
    return "\n".join(lines)
