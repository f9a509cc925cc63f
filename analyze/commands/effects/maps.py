"""What in the picture moves the action: the answers, and their tables."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

import polars as pl

from vla_attention.analyze.commands.naming_tables import times
from vla_attention.analyze.core.about import enough
from vla_attention.analyze.core.action_changes import ActionUnits
from vla_attention.analyze.core.axes import columns_of
from vla_attention.analyze.core.naming import Naming
from vla_attention.analyze.core.patch_maps import (
    TRUSTED,
    any_map,
    calls_of_maps,
    episodes_of_maps,
    named_in_maps,
    patch_maps,
    summary_of_maps,
)
from vla_attention.analyze.core.recorded_effects import recorded_effects
from vla_attention.analyze.core.result import Column, Finding, Table
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.statistics.many_looks import NAMED_AT
from vla_attention.schemas.errors import BadArgument

ASKS, ASKS_NAMED = "What in the picture moves the action?", "Does what is named move it more?"
_PARTS = ("named", "robot", "other")
#: What is taken away, by the way of the map.
_TAKEN = {
    "first order": "Take away one patch at a time: of how far the strongest tenth of the patches",
    "hidden": "Hide one block of patches at a time: of how far all of them",
    "picture": "Fill one block of the picture at a time from its surroundings: of how far all of them",
}
_LIMITS = {
    "first order": "One patch at a time: what several of them say, none of them moves.",
    "hidden": "One block at a time: what several of them say, none of them moves.",
    "picture": "A filled picture is one that the policy never saw.",
}


def maps_where_recorded(question: Question) -> tuple[list[Finding], list[Table]]:
    """`of_maps` of a question that may have no effects at all."""
    if not any_map(question):
        return [], []
    try:
        found = recorded_effects(question, attention=False)
    except BadArgument as error:
        return [Finding(f"Not shown: {error}", ASKS)], []
    return ([], []) if found is None else of_maps(question, found.units)


def of_maps(question: Question, units: ActionUnits, by: Collection[str] = ()) -> tuple[list[Finding], list[Table]]:
    """The findings and the tables of the maps of patches; nothing where none was recorded.

    by: axes that the table of parts keeps apart.
    """
    if not any_map(question):
        return [], []
    patches = patch_maps(question, units)
    if patches.is_empty():
        return [
            Finding(f"The maps of patches are of another site than '{question.site}'; choose with --site.", ASKS)
        ], []
    calls = calls_of_maps(patches, question)
    episodes = episodes_of_maps(calls)
    summary, named = summary_of_maps(episodes, question), named_in_maps(question, patches)
    which = "all" if summary["all_named"].count() else "top"
    title = "All blocks" if which == "all" else "The strongest tenth of the patches"
    kept = [column for column in columns_of(by) if column.name in (*calls.columns,)]
    tables = [Table("maps_episodes", episodes, _columns(_OF_EPISODE, which, calls), title, rows=8)]
    if kept:
        divided = summary_of_maps(episodes_of_maps(calls, by), question, by)
        tables = [Table("maps_by", divided, _columns(kept, which, calls), title), tables[0]]
    outcomes = episodes.drop_nulls("success")
    if outcomes["success"].n_unique() > 1:
        divided = summary_of_maps(outcomes, question, ["outcome"])
        tables.append(Table("maps_outcomes", divided, _columns(columns_of(["outcome"]), which, calls), title))
    tables += [Table("maps_summary", summary), Table("maps", patches)]
    findings = [_parts(row, patches.filter(way=row["way"]), units, question) for row in summary.to_dicts()]
    if named.form is not None:
        findings.append(_named(named, units, question))
        tables.append(Table("maps_naming", named.rows))
    return findings, tables


_OF_EPISODE = [
    Column("task_id", "count", "task"),
    Column("episode_index", "count", "episode"),
    Column("num_calls", "count", "calls"),
]


def _columns(before: Collection[Column], which: str, calls: pl.DataFrame) -> list[Column]:
    of = "all blocks" if which == "all" else "the strongest tenth"
    found = [
        *before,
        Column(f"{which}_named", "percent", "named", f"part of what {of} do that lies on what the sentence names"),
        Column(f"{which}_robot", "percent", "robot", "that lies on the robot"),
        Column(f"{which}_other", "percent", "neither", "that lies on neither"),
        Column(f"attention_{which}_named", "percent", "attention: named", "the same of the attention"),
    ]
    if which == "all":
        found.append(Column("top_other", "percent", "NMR@10", "of the strongest tenth, what lies on neither"))
    if calls["rank"].count():
        found.append(
            Column("rank", "number", "order", "rank correlation with exact changes, of patches drawn at random")
        )
    return found


def _does(units: ActionUnits) -> str:
    return "move the hand" if units.centimetres is not None else "change the action"


def _parts(row: Mapping[str, Any], patches: pl.DataFrame, units: ActionUnits, question: Question) -> Finding:
    """What lies on what is named, on the robot, and on neither."""
    way = row["way"]
    which = "top" if way == "first order" else "all"
    names = [f"{which}_{part}" for part in _PARTS]
    numbers = {"way": way, **{part: row[name] for part, name in zip(_PARTS, names, strict=True)},
               "nmr10": row["top_other"], "rank": row["rank"], "rank_low": row["rank_low"]}  # fmt: skip
    limits = [_order(row) if way == "first order" else "", _LIMITS[way], enough(question)]
    if row[names[0]] is None:
        said = f"No single patch is found to {_does(units)}."
        if patches["named"].null_count():
            said = (
                "Not known of every patch whether it shows what the sentence names: no coverage of objects, or no goal."
            )
        return Finding(said, ASKS, numbers, " ".join(filter(None, limits)))

    def part(name: str) -> str:
        low, high = row[f"{name}_low"], row[f"{name}_high"]
        return f"{100 * row[name]:.0f}%" + ("" if low is None else f" [{100 * low:.0f}, {100 * high:.0f}]")

    attention = ", ".join(f"{100 * row[f'attention_{name}']:.0f}%" for name in names)
    said = (
        f"{_TAKEN[way]} {_does(units)}, {part(names[0])} lies on what the sentence names, {part(names[1])} on the "
        f"robot, {part(names[2])} on neither (attention: {attention}). What is named covers "
        f"{100 * row['area_named']:.1f}% of the pictures, the robot {100 * row['area_robot']:.0f}%."
    )
    if which == "all":
        said += f" Of the strongest tenth, {part('top_other')} is on neither."
    return Finding(said, ASKS, numbers, " ".join(filter(None, limits)))


def _named(named: Naming, units: ActionUnits, question: Question) -> Finding:
    """Whether the same thing moves the action more when it is named."""
    row = named.answer
    shown = row["ratio_q"] is not None and row["ratio_q"] <= NAMED_AT
    verdict = ("Yes" if row["ratio"] > 1 else "No, less") if shown else "Not shown"
    moved = "hand" if units.centimetres is not None else "action"
    said = (
        f"{verdict}: at the first policy call, in the same pictures, an object has {times(row, 'ratio')} as large a "
        f"part of what blocks do to the {moved} when it is named as when another is."
    )
    numbers = {"shown": int(shown), **{key: value for key, value in row.items() if key != "camera"}}
    return Finding(said, ASKS_NAMED, numbers, enough(question))


def _order(row: Mapping[str, Any]) -> str:
    """How far the order of all patches can be trusted."""
    if row["rank"] is None:
        return "The order of all patches could not be tested: exact changes of others than the strongest are rounding."
    size, ends = f"{row['rank']:.2f}", ""
    if row["rank_low"] is None:
        trust = "There are too few episodes to say whether the order of all patches holds"
    else:
        ends = f" [{row['rank_low']:.2f}, {row['rank_high']:.2f}]"
        trust = f"The order of all patches is {'' if row['rank_low'] >= TRUSTED else 'not '}shown to hold"
    return f"{trust}: rank correlation with exact changes, of patches drawn at random, {size}{ends}."
