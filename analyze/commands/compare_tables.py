"""The tables and pictures of `compare`: what was done, attention of groups, words and heads, single pairs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import polars as pl

from vla_attention.analyze.core.camera_maps import stored_picture
from vla_attention.analyze.core.compared import KINDS, Compared, RunValues, side_by_side, strip_of_pair
from vla_attention.analyze.core.perturbations import any_perturbed, by_suite, perturbations
from vla_attention.analyze.core.result import Column, Figure, Finding, Table
from vla_attention.analyze.measures.tables import LAYERS_AVG
from vla_attention.schemas.errors import shortened
from vla_attention.schemas.safe_text import visible

ALL = pl.col("scope") == "all"


def tables_of(parts: Sequence[Compared], told: Mapping[str, pl.DataFrame]) -> list[Table]:
    """What was told and done; differences of groups, words, heads, layers and tasks; then single pairs."""
    several = [Column("run", "text")] if len(parts) > 1 else []
    names = {"first": parts[0].first.run.name, "other": parts[0].name if len(parts) == 1 else "other"}
    did, both, times = ([_named_after(column, names) for column in columns] for columns in (_DID, _BOTH, _TIMES))
    behaved = [rows for part in parts if (rows := side_by_side(part, told)) is not None]
    found = [Table("behaviour", pl.concat(behaved), [*several, *did], "Told and did", rows=6)] if behaved else []
    rows_of = {kind: [_of_run(part, part.rows[kind]) for part in parts if kind in part.rows] for kind in KINDS}
    each = {kind: pl.concat(rows) for kind, rows in rows_of.items() if rows}
    groups, main = each["groups"], each["groups"]["quantity"][0]
    average = pl.col("layer") == (LAYERS_AVG if (groups["layer"] == LAYERS_AVG).any() else groups["layer"][0])
    for kind, columns, title in _EACH:
        if kind in each:
            rows = each[kind].sort(pl.col("difference").abs(), descending=True, nulls_last=True, maintain_order=True)
            is_log = kind in _LOGARITHMS
            rows, shown_values = (as_factors(rows), times) if is_log else (rows, both)
            where = ALL & (pl.col("reader") == "total") if kind == "effects" else ALL
            found.append(Table(kind, rows, [*several, *columns, *shown_values], title, where, rows=5))
    shown = ALL & average & (pl.col("quantity") != "success")
    # Behind objects and words, before the heads.
    at = len(found) - ("heads" in each)
    found.insert(at, Table("differences", groups, [*several, Column("quantity", "text"), *both], "Attention", shown))
    of_main = pl.col("quantity") == main
    layers, tasks = [*several, Column("layer", "text"), *both], [*several, Column("task_id", "count", "task"), *both]
    found.append(Table("layers", groups, layers, f"{main} by layer", ALL & ~average & of_main, of="differences"))
    by_task = (pl.col("scope") == "task") & average & of_main
    found.append(
        Table("tasks", groups, [*tasks, Column("instruction", "text")], f"{main} by task", by_task, 6, "differences")
    )
    values = [_of_run(part, part.values["groups"]) for part in parts if part.pairs.height]
    return [*found, *([Table("pairs", pl.concat(values))] if values else []),
            Table("unpaired", pl.concat([part.alone() for part in parts]))]  # fmt: skip


def perturbed(
    base: RunValues, parts: Sequence[Compared], told: Mapping[str, pl.DataFrame]
) -> tuple[list[Finding], list[Table]]:
    """By what LIBERO-PRO changed: success, doing what was told, attention to what the task names; none without it.

    `pairs`: of episodes that begin alike in the first run; its suites share no states.
    """
    ran = [(part.other, part.pairs) for part in parts if not part.other.run.repeats(base.run)]
    every = [(base, None), *ran]
    if not any_perturbed(suite for one, _ in every for suite in one.run.suites):
        return [], []
    found = []
    for one, pairs in every:
        suites = by_suite(one.run.question, told[one.run.name], one.named)
        num_pairs = [None if pairs is None else pairs.filter(suite=suite).height for suite in suites["suite"]]
        run, of_pairs = pl.lit(one.run.name).alias("run"), pl.Series("pairs", num_pairs, pl.Int64)
        found.append(suites.select(run, pl.all()).with_columns(of_pairs))
    finding, table = perturbations(pl.concat(found))
    return [finding], [table]


def _named_after(column: Column, names: Mapping[str, str]) -> Column:
    """A column of one of the runs with the run's name in its title."""
    for side, name in names.items():
        if column.name.endswith(f"_{side}") and column.name != "num_first":
            return replace(column, header=f"{shortened(name, 18)}{column.header.removeprefix(side)}")
    return column


def _of_run(part: Compared, rows: pl.DataFrame) -> pl.DataFrame:
    return rows.select(pl.lit(part.name).alias("run"), pl.all())


def figures_of(part: Compared, told: Mapping[str, pl.DataFrame]) -> list[Figure]:
    """The ratio's differences by layer, the words', and pictures of a pair that ended otherwise."""
    first, name = part.first.run.name, part.name
    groups, found = part.rows["groups"].filter(ALL), []
    main = groups["quantity"][0]
    layer = pl.when(pl.col("layer") == LAYERS_AVG).then(pl.lit("all layers")).otherwise(pl.format("layer {}", "layer"))
    of_layers = groups.filter(quantity=main).with_columns(layer=layer, num_episodes="num_first")
    if main == "log2_ratio":
        title, looks = "The ratio", _FACTORS | {"xlabel": "times the ratio (logarithmic)"}
        of_layers = as_factors(of_layers)
    else:
        title, looks = main.removesuffix("_fraction"), _LOOK
    title = f"{title} by layer, {name} against {first}"
    found.append(Figure(f"layers_{name}", "forest", of_layers, title, _BARS, {**looks, "label": "layer"}))
    if "words" in part.rows:
        looks = {**_FACTORS, "label": "item", "xlabel": "times the attention (logarithmic)"}
        title = f"Attention to words, {name} against {first}"
        words = as_factors(part.rows["words"].filter(ALL)).with_columns(num_episodes="num_first")
        found.append(Figure(f"words_{name}", "forest", words, title, _BARS, looks))
    if part.pairs.height:
        items, rows = strip_of_pair(part, told[first], told[name])
        title = f"Told '{visible(items[0].episode.attributes.instruction)}' from one beginning: {first} and {name}"
        look = {"picture": lambda a: stored_picture(items[a["row"]], a["camera"], a["replan"])}
        found += [Figure(f"pair_{name}", "pictures", rows, title, options=look)] if rows.height else []
    return found


def as_factors(rows: pl.DataFrame) -> pl.DataFrame:
    """Values and differences of logarithms to base 2 as what they are of, and as factors `times`."""
    found = rows.with_columns((2.0 ** pl.col(name)).alias(name) for name in ("mean_first", "mean_other"))
    ends = {f"difference{end}": f"times{end}" for end in ("", "_low", "_high")}
    found = found.with_columns((2.0 ** pl.col(name)).alias(name) for name in ends)
    return found.rename({**ends, "difference_q": "times_q"})


_LOOK = {"value": "difference", "baseline": 0.0, "baseline_name": "the same", "xlabel": "difference of the shares"}
_FACTORS = {**_LOOK, "value": "times", "baseline": 1.0, "log": True}
_BARS = "Points: means over episodes, every task weighing the same; bars: 95% intervals."
_DID = [
    Column("told", "text"),
    Column("touched_first", "text", "first: touched"),
    Column("did_first", "text", "first: reached"),
    Column("touched_other", "text", "other: touched"),
    Column("did_other", "text", "other: reached"),
    Column("episodes", "count"),
]
_BOTH = [
    Column("mean_first", "number", "first"),
    Column("mean_other", "number", "other"),
    Column("difference", "signed", "other - first", "of a log2, 1 is twice as much"),
    Column("difference_q", "p", "q", "p of no difference, adjusted for the number of rows (Benjamini-Hochberg)"),
    Column("num_first", "count", "n", "pairs of episodes, or episodes of the first run"),
]
_TIMES = [
    *_BOTH[:2],
    Column("times", "factor", "other / first"),
    Column("times_q", "p", "q", "p of no difference, adjusted for the number of rows (Benjamini-Hochberg)"),
    _BOTH[-1],
]
#: Kinds whose values are logarithms.
_LOGARITHMS = ("effects", "objects", "words")
_WORD, _LAYER, _HEAD = Column("item", "text", "word"), Column("layer", "count"), Column("head", "count")
_EACH = (
    (
        "effects",
        [Column("label", "text", "without, or changed")],
        "How far the action moves",
    ),
    (
        "maps",
        [Column("item", "text", "on", "what the sentence names, the robot, or neither")],
        "Patches that move the action: the part of it",
    ),
    ("objects", [Column("item", "text", "object")], "Attention to objects, over that of their area"),
    ("words", [_WORD], "Attention to words, evenly spread = 1"),
    ("heads", [_LAYER, _HEAD], "Heads: their attention on the first side of the ratio"),
)
