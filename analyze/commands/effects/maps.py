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
    map_of,
    named_in_maps,
    patch_maps,
    summary_of_maps,
)
from vla_attention.analyze.core.recorded_effects import recorded_effects
from vla_attention.analyze.core.result import Column, Finding, Table
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.statistics.many_looks import NAMED_AT
from vla_attention.schemas.errors import BadArgument, plural

ASKS, ASKS_NAMED = "What in the picture moves the action?", "Does what is named move it more?"
_PARTS = ("named", "robot", "other")
_LIMITS = {
    "first order": "One patch at a time: what several of them say, none of them moves.",
    "hidden": "One block at a time: what several of them say, none of them moves.",
    "picture": "A filled picture is one that the policy never saw.",
}


def maps_where_recorded(question: Question, only_named: bool = False) -> tuple[list[Finding], list[Table]]:
    """`of_maps` of a question that may have no effects at all; only_named: whether what is named moves it more."""
    if not any_map(question):
        return [], []
    try:
        found = recorded_effects(question, attention=False)
    except BadArgument as error:
        return [Finding(f"Not shown: {error}", ASKS)], []
    if found is None or not only_named:
        return ([], []) if found is None else of_maps(question, found.units)
    named = named_in_maps(question, found.units)
    return ([] if named.form is None else [_named(named, found.units, question)]), []


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
    summary, named = summary_of_maps(episodes, question), named_in_maps(question, units)
    which = "all" if summary["all_named"].count() else "top"
    title = "All blocks" if which == "all" else "The strongest tenth of the patches"
    kept = [column for column in columns_of(by) if column.name in calls.columns]
    known = calls[f"{which}_named"].count() > 0
    shown = _columns(_OF_EPISODE, which, calls) if known and not kept else []
    tables = [Table("maps_episodes", episodes, shown, title, rows=8)]
    if kept:
        divided = summary_of_maps(episodes_of_maps(calls, by), question, by)
        kept = [*kept, Column("num_episodes", "count", "episodes")]
        tables = [Table("maps_by", divided, _columns(kept, which, calls) if known else [], title), tables[0]]
    outcomes = episodes.drop_nulls("success")
    if known and outcomes["success"].n_unique() > 1:
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
        Column(f"{which}_other", "percent", "the rest", "that lies on neither"),
        Column(f"attention_{which}_named", "percent", "attention: named", "the same of the attention"),
    ]
    if which == "all" and calls["top_other"].count():
        found.append(Column("top_other", "percent", "NMR@10", "of the strongest tenth, what lies on neither"))
    if calls["rank"].count():
        found.append(
            Column("rank", "number", "order", "rank correlation with exact changes, of patches drawn at random")
        )
    return found


def _moved(units: ActionUnits) -> str:
    return "how far the hand moves" if units.centimetres is not None else "how much the action changes"


def _taken(question: Question, way: str) -> str:
    """What is done to the pictures, of a map made in this way."""
    if way == "first order":
        return "Take the strongest tenth of the patches away, one at a time"
    one = next(found for item in question.selected if (found := map_of(item)) is not None and found.way == way)
    blocks = f"each block of the pictures{f' ({one.grid[0]} x {one.grid[1]} each)' if one.grid else ''} in turn from"
    if way == "picture":
        return f"Fill {blocks} its surroundings"
    return f"Hide {blocks} {'all' if one.reader == 'all' else 'the action'} tokens"


def _parts(row: Mapping[str, Any], patches: pl.DataFrame, units: ActionUnits, question: Question) -> Finding:
    """What lies on what is named, on the robot, and on neither."""
    way = row["way"]
    which = "top" if way == "first order" else "all"
    names = [f"{which}_{part}" for part in _PARTS]
    numbers = {"way": way, **{part: row[name] for part, name in zip(_PARTS, names, strict=True)},
               "most_named": row["most_named"], "nmr10": row["top_other"], "median": row["median"],
               "noise": row["noise"], "rank": row["rank"], "rank_low": row["rank_low"]}  # fmt: skip
    yardsticks = {"median": "the median block does", "noise": "another noise seed does"}
    done = ", ".join(f"{what} {units.short(row[name])}" for name, what in yardsticks.items() if row[name] is not None)
    sizes = f"{done[0].upper()}{done[1:]}." if done else ""
    limits = [_order(row) if way == "first order" else "", sizes, _LIMITS[way], enough(question)]
    if row[names[0]] is None:
        said = "No single patch is found to move the action."
        if patches["named"].null_count():
            said = (
                "Not known of every patch whether it shows what the sentence names: no coverage of objects, or no goal."
            )
        return Finding(said, ASKS, numbers, " ".join(filter(None, limits)))
    areas = [row["area_named"], row["area_robot"], 1.0 - row["area_named"] - row["area_robot"]]
    units_of_shares = (
        (" of the attention", " of the area") if which == "all" else (" of attention's own tenth", " of the area")
    )
    parts: list[str] = []
    for name, what, area in zip(names, _FROM, areas, strict=True):
        attention = f"{100 * row[f'attention_{name}']:.0f}%"
        joint = units_of_shares if not parts else ("", "")
        beside = f"({attention}{joint[0]}, {_area(area)}{joint[1]})"
        parts.append(f"{_share(row, name)} {'from' if parts else 'comes from'} {what} {beside}")
    said = f"{_taken(question, way)}, and add up {_moved(units)}: {', '.join(parts)}."
    if which == "all" and row["most_named"] is not None:
        said += f" If only what is named moved it, blocks of this size would say {100 * row['most_named']:.0f}%."
    if which == "all" and row["top_other"] is not None:
        said += f" Of the strongest tenth, {_share(row, 'top_other')} is from the rest."
    missing = len(question.selected) - row["num_episodes"]
    limits += [f"Not known of {plural(missing, 'episode')}: no map, no coverage of objects or no goal."] * (missing > 0)
    return Finding(said, ASKS, numbers, " ".join(filter(None, limits)))


_FROM = ("what the sentence names", "the robot", "the rest")


def _share(row: Mapping[str, Any], name: str) -> str:
    low, high = row[f"{name}_low"], row[f"{name}_high"]
    return f"{100 * row[name]:.0f}%" + ("" if low is None else f" [{100 * low:.0f}, {100 * high:.0f}]")


def _area(area: float) -> str:
    return f"{100 * area:.1f}%" if area < 0.1 else f"{100 * area:.0f}%"


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
