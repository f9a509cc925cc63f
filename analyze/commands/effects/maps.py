"""What in the picture moves the action: the answer, and its tables."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import polars as pl

from vla_attention.analyze.core.about import enough
from vla_attention.analyze.core.action_changes import ActionUnits
from vla_attention.analyze.core.patch_maps import TRUSTED, episodes_of_maps, patch_maps, summary_of_maps
from vla_attention.analyze.core.result import Column, Finding, Table
from vla_attention.analyze.measures.question import Question

_ASKS = "What in the picture moves the action?"
_COLUMNS = [
    Column("task_id", "count", "task"),
    Column("episode_index", "count", "episode"),
    Column("num_calls", "count", "calls"),
    Column("named", "percent", "named", "part of what the strongest tenth does that lies on what the sentence names"),
    Column("robot", "percent", "robot", "that lies on the robot"),
    Column("other", "percent", "neither", "that lies on neither (NMR@10)"),
    Column("rank", "number", "order", "rank correlation with exact changes, of patches drawn at random"),
]


def of_maps(question: Question, units: ActionUnits) -> tuple[list[Finding], list[Table]]:
    """The finding and the tables of the maps of patches; nothing where none was recorded."""
    patches = patch_maps(question, units)
    if patches.is_empty():
        return [], []
    episodes = episodes_of_maps(patches, question)
    summary = summary_of_maps(episodes, question)
    tables = [
        Table("maps_episodes", episodes, _COLUMNS, "The strongest tenth of the patches", rows=8),
        Table("maps_summary", summary),
        Table("maps", patches),
    ]
    row = summary.row(0, named=True)
    numbers = {name: row[name] for name in ("named", "robot", "other", "rank", "rank_low")}
    limits = [_order(row), "One patch at a time: what several of them say, none of them moves.", enough(question)]
    return [Finding(_said(row, patches, units), _ASKS, numbers, " ".join(filter(None, limits)))], tables


def _said(row: Mapping[str, Any], patches: pl.DataFrame, units: ActionUnits) -> str:
    does = "move the hand" if units.centimetres is not None else "change the action"
    if row["named"] is None:
        if patches["named"].null_count():
            return (
                "Not known of every patch whether it shows what the sentence names: no coverage of objects, or no goal."
            )
        return f"No single patch is found to {does}."

    def part(name: str) -> str:
        low, high = row[f"{name}_low"], row[f"{name}_high"]
        return f"{100 * row[name]:.0f}%" + ("" if low is None else f" [{100 * low:.0f}, {100 * high:.0f}]")

    return (
        f"Take away one patch at a time: of how far the strongest tenth of the patches {does}, {part('named')} lies on "
        f"what the sentence names, {part('robot')} on the robot, {part('other')} on neither. What is named covers "
        f"{100 * row['area_named']:.1f}% of the pictures, the robot {100 * row['area_robot']:.0f}%."
    )


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
