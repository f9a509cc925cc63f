"""What in the picture moves the action: the answer, and its tables."""

from __future__ import annotations

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
    return [_finding(question, summary)], tables


def _finding(question: Question, summary: pl.DataFrame) -> Finding:
    row = summary.row(0, named=True)
    limits = [
        "One patch at a time: what several of them say, none of them moves.",
        enough(question),
    ]
    numbers = {name: row[name] for name in ("named", "robot", "other", "rank", "rank_low")}
    if row["named"] is None:
        said = "Not known which patches lie on what the sentence names: the store has no coverage of objects."
        return Finding(said, _ASKS, numbers, " ".join(limits))

    def part(name: str) -> str:
        ends = (
            "" if row[f"{name}_low"] is None else f" [{100 * row[f'{name}_low']:.0f}, {100 * row[f'{name}_high']:.0f}]"
        )
        return f"{100 * row[name]:.0f}%{ends}"

    said = (
        f"Take away one patch at a time: of what the strongest tenth of the patches do to the action, {part('named')} "
        f"lies on what the sentence names, {part('robot')} on the robot, {part('other')} on neither. What is named "
        f"covers {100 * row['area_named']:.1f}% of the pictures, the robot {100 * row['area_robot']:.0f}%."
    )
    if row["rank"] is not None:
        low = row["rank_low"] if row["rank_low"] is not None else row["rank"]
        trust = "holds" if low >= TRUSTED else "does not hold"
        ends = "" if row["rank_low"] is None else f" [{row['rank_low']:.2f}, {row['rank_high']:.2f}]"
        limits.insert(
            0,
            f"The order of the map {trust} for patches that were drawn at random: rank correlation with their exact "
            f"change {row['rank']:.2f}{ends}.",
        )
    return Finding(said, _ASKS, numbers, " ".join(filter(None, limits)))
