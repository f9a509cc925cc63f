"""`analyze --by`: the groups and the ratio of a grouping, kept apart by layers, heads, time, tasks and more."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any

import polars as pl

from vla_attention.analyze.core.about import (
    GROUP_COLUMNS,
    RATIO_COLUMNS,
    about,
    enough,
    notes,
    only,
    out_of,
    sides,
    with_interval,
)
from vla_attention.analyze.core.axes import columns_of, with_families
from vla_attention.analyze.core.between_parts import of_outcome, of_time
from vla_attention.analyze.core.estimate import Scale, estimate
from vla_attention.analyze.core.levels import Levels, groups_by, ratios_by
from vla_attention.analyze.core.result import Column, Figure, Finding, Result, Table
from vla_attention.analyze.measures.question import Question
from vla_attention.schemas.errors import plural

_RATIOS: dict[str, Scale] = {"ratio": "geometric", "uniform_ratio": "geometric", "ratio_lift": "geometric",
                             "numerator_fraction": "share", "denominator_fraction": "share"}  # fmt: skip
_GROUPS: dict[str, Scale] = {"fraction": "share", "lift": "positive", "keys": "plain"}
#: Axes that stand alone and whose rows are compared.
_COMPARED = {"outcome": of_outcome, "time": of_time}
#: How an axis is drawn along x: its column, and its name.
_ALONG = {
    "time": ("phase", "time (0: first policy call, 1: end)"),
    "layer": ("layer_number", "layer"),
    "head": ("head", "head"),
    "denoise": ("denoise_step", "denoise step"),
    "replan": ("replan", "replan"),
}


def kept_apart(levels: Levels, by: Collection[str], more: Sequence[Table] = ()) -> Result:
    """A row for each cell of the axes: the ratio (table "by"), and each group ("by_groups").

    Args:
        levels: the grouping, measured.
        by: axes of `core.axes.COLUMNS`; "camera" stands for a grouping of cameras.
        more: further tables.
    """
    question, sampling = levels.question, levels.question.sampling
    axes = [axis for axis in by if axis != "camera"]
    columns = columns_of(axes)
    order = [*(["layer_number", "block"] if "layer" in axes else []), *(column.name for column in columns)]
    title, tables, part = f"By {' and '.join(by)}", [], question
    if levels.grouping.ratio is not None:
        rows = with_families(ratios_by(levels, axes), sampling)
        quotients = {"ratio_of_means": ("numerator_mass", "denominator_mass")}
        ratios = estimate(rows, order, _RATIOS, sampling, {"ratio_lift": 1.0}, quotients=quotients)
        counts = rows.group_by(order).agg(pl.col("num_nonfinite").sum(), episodes_with_ratio=pl.col("ratio").count())
        part = only(question, rows.drop_nulls("ratio"))
        ratios = ratios.join(counts, on=order, how="left", nulls_equal=True, maintain_order="left")
        shown = (
            *columns,
            Column("ratio", "factor", "ratio", RATIO_COLUMNS[0].meaning),
            *RATIO_COLUMNS[1:],
            Column("ratio_lift_q", "p", "q of even", "p of even attention per token, adjusted for the number of rows"),
            Column("episodes_with_ratio", "count", "episodes"),
        )
        tables.append(Table("by", ratios.sort(order, nulls_last=True), shown, title, rows=24))
    rows = with_families(groups_by(levels, axes), sampling)
    groups = estimate(rows, [*order, "group"], _GROUPS, sampling, {"lift": 1.0}).drop("keys_low", "keys_high")
    groups = groups.sort(order, nulls_last=True, maintain_order=True) if order else groups
    having = groups.filter(pl.col("fraction") > 0)["group"].unique().to_list()
    of_groups = Table(
        "by_groups", groups, (*columns, *GROUP_COLUMNS), f"{title}: groups", pl.col("group").is_in(having), 24
    )
    tables.append(of_groups)
    drawn, alone = tables, next(iter(by)) if len(by) == 1 else ""
    if alone in _COMPARED:
        finding, first = _COMPARED[alone](levels)
        finding = replace(finding, limit=f"{finding.limit} {enough(part)}".strip())
    else:
        finding, first = _finding(levels, part, tables, columns, by), []
    if alone == "time":  # a picture shows twenty moments better than twenty rows
        tables = [replace(table, columns=()) for table in tables]
    return Result(
        f"Where attention goes, by {' and '.join(by)}",
        about(question),
        [finding],
        [*first, *tables, *_steps(levels), *_replans(levels, by), *more],
        _figures(levels, drawn, axes),
        notes(part),
    )


def _steps(levels: Levels) -> list[Table]:
    """Every step with its heads apart, where they are."""
    if not levels.heads:
        return []
    return [Table("steps", levels.steps()), Table("steps_groups", levels.steps_groups())]


def _replans(levels: Levels, by: Collection[str]) -> list[Table]:
    """Every replan and layer, with means over the layers as the published scripts take them."""
    if "replan" not in by:
        return []
    return [Table("replans", levels.replans()), Table("replans_groups", levels.groups("replan", "layer"))]


def _finding(
    levels: Levels, part: Question, tables: Sequence[Table], columns: Sequence[Column], by: Collection[str]
) -> Finding:
    """From which cell to which the ratio runs, or the group of each cell with the highest lift.

    part: the episodes that have a ratio in a cell.
    """
    limit, first, some = enough(part), tables[0].shown, out_of(part, levels.question)
    if tables[0].name == "by":
        known = first.filter(pl.col("ratio").is_not_null()).sort("ratio")
        if known.height < 2:
            return Finding("There are no two ratios to compare.", "Where does it look, where read?", limit=limit)
        ends = [known.row(i, named=True) for i in (0, -1)]
        low, high = (f"{with_interval(row, 'ratio')} ({_cell(row, columns)})" for row in ends)
        side = " / ".join("+".join(part) for part in sides(levels.grouping))
        numbers = {"lowest": ends[0]["ratio"], "highest": ends[1]["ratio"], "rows": known.height}
        where = f" in {some}, the others have none," if some else ""
        return Finding(
            f"The ratio {side}{where} runs from {low} to {high}.", "Where does it look, where read?", numbers, limit
        )
    top = first.sort("lift", descending=True, nulls_last=True).row(0, named=True)
    where = f" ({_cell(top, columns)})" if columns else ""
    said = f"Most attention per token goes to {top['group']}{where}: {with_interval(top, 'lift')} times an even share."
    return Finding(said, f"Where does attention go, by {' and '.join(by)}?", {"lift": top["lift"]}, limit)


def _cell(row: Mapping[str, Any], columns: Sequence[Column]) -> str:
    said = [(column.title, row[column.name]) for column in columns if column.screen]
    named = {True: "", False: "not "}  # solved, not solved
    return ", ".join(f"{named[at]}{title}" if isinstance(at, bool) else f"{title} {at}" for title, at in said)


def _figures(levels: Levels, tables: Sequence[Table], axes: Sequence[str]) -> list[Figure]:
    """One axis as lines, two as a map; the other axes as tables alone."""
    along = [axis for axis in ("layer", "head", "denoise", "replan", "time") if axis in axes]
    n = f"Means over {plural(len(levels.question.selected), 'episode')}, every task weighing the same."
    stem = "by_" + "_".join(axes)
    if len(axes) != len(along) or not 1 <= len(along) <= 2:
        return []
    (x, xlabel), *rest = (_ALONG[axis] for axis in along)
    groups = tables[-1].shown
    if rest:
        if tables[0].name != "by":
            return []
        name = " / ".join("+".join(side) for side in sides(levels.grouping))
        options = {"x": x, "y": rest[0][0], "value": "ratio_lift", "xlabel": xlabel, "ylabel": rest[0][1],
                   "label": f"{name}, over even"}  # fmt: skip
        ratios = tables[0].shown.sort(x, rest[0][0])
        title = f"Ratio {name} over an even spread's, by {' and '.join(axes)}"
        return [Figure(stem, "heat_map", ratios, title, n, options)]
    lines = {"x": x, "value": "fraction", "color": "group", "xlabel": xlabel, "ylabel": "part of the attention"}
    found = [Figure(f"{stem}_groups", "lines", groups, f"How attention is divided, by {axes[0]}", n, lines)]
    if tables[0].name == "by":
        name = " / ".join("+".join(side) for side in sides(levels.grouping))
        drawn = {"x": x, "value": "ratio", "uniform": "uniform_ratio", "log": True, "xlabel": xlabel, "ylabel": name}
        title, caption = f"Ratio {name} by {axes[0]}", f"{n} Bands: 95% intervals."
        found.insert(0, Figure(stem, "lines", tables[0].shown, title, caption, drawn))
    return found
