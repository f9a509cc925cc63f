"""Looks or reads? How attention is divided between the groups of a grouping, and the ratio of two sides."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace
from typing import Any, TypeAlias

import polars as pl

from vla_attention.analyze.commands.apart import kept_apart
from vla_attention.analyze.commands.effects import word_effects
from vla_attention.analyze.commands.holdings import holdings, overlaps_of
from vla_attention.analyze.core.about import (
    GROUP_COLUMNS,
    RATIO_COLUMNS,
    about,
    enough,
    inverse,
    notes,
    only,
    out_of,
    sides,
    with_interval,
    would_show,
)
from vla_attention.analyze.core.axes import COLUMNS, check_axes
from vla_attention.analyze.core.behaviour import behaviour, with_choices
from vla_attention.analyze.core.contributions import tables_of_norms
from vla_attention.analyze.core.levels import Levels, detectable_lift, levels_of, overall, task_cells, task_groups
from vla_attention.analyze.core.listening import listens
from vla_attention.analyze.core.result import Column, Figure, Finding, Result, Table
from vla_attention.analyze.core.sinks import SinkRule, search_sinks
from vla_attention.analyze.core.sinks import without_sinks as take_out
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.measures.tables import LAYERS_AVG
from vla_attention.analyze.published.plot_evolution import evolution_files
from vla_attention.analyze.published.results_writer import results_files
from vla_attention.analyze.statistics.intervals import says_a_size
from vla_attention.schemas.errors import listing, plural
from vla_attention.schemas.groupings.builtin_groupings import find_grouping

_Row: TypeAlias = Mapping[str, Any]
AVERAGE = pl.col("layer") == LAYERS_AVG
_NUMBERS = ("geometric_mean", "geometric_mean_low", "geometric_mean_high", "uniform_ratio", "ratio_lift",
            "ratio_lift_low", "ratio_lift_high", "num_episodes", "num_tasks", "episodes_with_ratio",
            "tasks_with_ratio")  # fmt: skip


def analyze(
    question: Question,
    by: Collection[str] = (),
    without_sinks: SinkRule | str | None = None,
    list: bool = False,
    save_viz: bool = False,
) -> Result:
    """Fractions and lifts of the groups and the ratio of the grouping, over all tasks, by task and by layer.

    Args:
        by: axes that are kept apart, of `axes.COLUMNS` and "camera"; see `apart.kept_apart`.
        without_sinks: take the keys that are sinks by this rule out of every group; reads all rows.
        list: what the stores hold, and what the grouping takes of it, instead.
        save_viz: also a picture per episode and layer.
    """
    check_axes(by, (*COLUMNS, "camera"))
    if list:
        return holdings(question)
    sinks = []
    if without_sinks is not None:
        rule = SinkRule.parse(without_sinks) if isinstance(without_sinks, str) else without_sinks
        search = search_sinks(question, rule)
        question = take_out(question, search.sinks, rule)
        sinks = [Table("sinks", search.sinks), Table("sink_heads", search.heads)]
    if "camera" in by:
        question = replace(question, grouping=replace(find_grouping("cameras", question.vocabulary), ratio=None))
    levels = levels_of(question, heads="head" in by or question.settings.per_head)
    if by:
        return kept_apart(levels, by, sinks)
    episodes, of_groups = levels.episodes(), levels.episodes_groups()
    tasks, groups = task_cells(episodes, question.sampling), task_groups(of_groups, question.sampling)
    rows = {row["group"]: row for row in overall(groups).filter(AVERAGE).iter_rows(named=True)}
    shown = [name for name in question.grouping.names if rows[name]["keys"] or rows[name]["mass"]]
    cell = overall(tasks).filter(AVERAGE).row(0, named=True)
    has_ratio = question.grouping.ratio is not None
    part = only(question, episodes.filter(AVERAGE, pl.col("log_ratio_mean").is_finite())) if has_ratio else question
    files = results_files(levels) if has_ratio and not question.of_other_loop else {}
    if save_viz:
        files |= evolution_files(levels)
    return Result(
        "Looks or reads?" if question.grouping.compares_modalities else "Where attention goes",
        about(question),
        [
            *(_of_ratio(question, part, rows, cell, episodes) if has_ratio else [_of_fractions(question, rows)]),
            *_of_words(question),
        ],
        [
            *_shown_tables(question, tasks, groups, shown),
            *tables_of_norms(question),
            Table("episodes", episodes),
            Table("episodes_groups", of_groups),
            Table("steps", levels.steps()),
            Table("steps_groups", levels.steps_groups()),
            Table("replans", levels.replans(), file=False),
            Table("replans_groups", levels.groups("replan", "layer"), file=False),
            *sinks,
        ],
        _figures(levels, tasks, groups, episodes),
        [*notes(part), *_notes(levels, cell)],
        files,
    )


def _of_words(question: Question) -> list[Finding]:
    """Whether it listens, and which words decide, as `language` says it; of the question that is asked by default."""
    if not question.grouping.compares_modalities or not question.vocabulary.words or question.of_other_loop:
        return []
    if all(item.episode.attributes.steps is None for item in question.selected[:1]):
        return []  # nor have the others: they are recorded in the same way
    asked = with_choices(behaviour(question.episodes))
    return [] if asked.is_empty() else [listens(asked), *word_effects(question)[0]]


def _shown_tables(question: Question, tasks: pl.DataFrame, groups: pl.DataFrame, shown: Collection[str]) -> list[Table]:
    """Groups, layers and tasks, in two files."""
    scope = pl.col("scope") == ("combined" if (tasks["scope"] == "combined").any() else "all")
    columns = RATIO_COLUMNS if question.grouping.ratio is not None else ()
    found = [Table("tasks_groups", groups, GROUP_COLUMNS, "Groups", scope & AVERAGE & pl.col("group").is_in([*shown]))]
    if columns and len(question.selection.layers) > 1:
        of_layers = (Column("layer", "text"), *columns)
        found.append(Table("layers", tasks, of_layers, "Layers", scope & ~AVERAGE, 20, of="tasks"))
    of_tasks = (
        Column("task_id", "count", "task"), *columns, Column("num_episodes", "count", "episodes"),
        Column("success_rate", "percent", "solved"), Column("instruction", "text"),
    )  # fmt: skip
    several = question.num_tasks > 1
    return [*found, Table("tasks", tasks, of_tasks if several else (), "Tasks", AVERAGE & (pl.col("scope") == "task"))]


def _of_fractions(question: Question, rows: Mapping[str, _Row]) -> Finding:
    """The groups that get most attention, for a grouping without a ratio."""
    most = sorted((row for row in rows.values() if row["fraction"]), key=lambda row: -row["fraction"])
    said = ", ".join(f"{row['group']} {row['fraction']:.0%}" for row in most[:5])
    more = f" and {len(most) - 5} more groups" if len(most) > 5 else ""
    numbers = {row["group"]: row["fraction"] for row in most}
    return Finding(f"Of the attention: {said}{more}.", "Where does attention go?", numbers, enough(question))


def _of_ratio(
    question: Question, part: Question, rows: Mapping[str, _Row], cell: _Row, episodes: pl.DataFrame
) -> list[Finding]:
    """How attention is divided between both sides, and per token; then the ratio itself.

    part: the episodes in which both sides get attention; of the others there is no ratio.
    """
    grouping, compares = question.grouping, question.grouping.compares_modalities
    above, below = ("the pictures", "the text") if compares else map(" + ".join, sides(grouping))
    shares = [sum(rows[name]["fraction"] or 0.0 for name in side) for side in sides(grouping)]
    asks = "Looks or reads?" if compares else "Where does attention go?"
    sentence = f"{shares[0]:.0%} of the attention goes to {above}, {shares[1]:.0%} to {below}."
    numbers = dict(zip(("numerator_fraction", "denominator_fraction"), shares, strict=True))
    numbers |= {name: cell[name] for name in _NUMBERS}
    limit, some = enough(part), out_of(part, question)
    if cell["geometric_mean"] is None:
        none = f"In none of {plural(len(question.selected), 'episode')} do both get some: there is no ratio."
        return [Finding(f"{sentence} {none}", asks, numbers, enough(question))]
    if some:
        sentence += f" Both get some in {some}; what follows is of these."
    ratio = f"The ratio of {above} to {below}{f' in {some}' if some else ''} is "
    ratio += with_interval(cell, "geometric_mean")
    if cell["ratio_lift"] is None or cell["uniform_ratio"] is None:
        return [Finding(f"{sentence} {ratio}.", asks, numbers, limit)]
    even = f"attention spread evenly over all tokens would give {cell['uniform_ratio']:.3g}"
    low, high = cell["ratio_lift_low"], cell["ratio_lift_high"]
    if low is not None and low <= 1 <= high:
        limit = f"{would_show(detectable_lift(episodes, question.sampling))} {limit}".strip()
    if cell["ratio_of_means"] is not None:  # what the parts above give
        ratio += f" (geometric mean over layers and calls; of all attention together {cell['ratio_of_means']:.3g})"
    return [
        Finding(f"{sentence} {_token_by_token(question, cell, above, below)}", asks, numbers, limit),
        Finding(f"{ratio}; {even}.", "The ratio?", numbers),
    ]


def _token_by_token(question: Question, cell: _Row, above: str, below: str) -> str:
    """Which side a single token gets more attention on; nothing is claimed that the interval does not show."""
    compares, lift = question.grouping.compares_modalities, [cell[f"ratio_lift{end}"] for end in ("", "_low", "_high")]
    one, other = "an image patch", "a token of the text"
    if not compares:
        one, other = f"a token of {above}", f"a token of {below}"
    if lift[0] < 1:  # the side that gets more stands first
        one, other, lift = other, one, inverse(*lift)
    value, low, high = lift
    bounds = f" [{low:.2g}, {high:.2g}]" if low is not None and says_a_size(low, high) else ""
    gets = f"{one} gets {value:.2g} times the attention of {other}{bounds}"
    if low is None:
        return f"Per token, {gets}; without an interval nobody knows whether that is more."
    if low <= 1 <= high:
        return f"Per token, neither is shown to get more: {gets}."
    return f"{gets[0].upper()}{gets[1:]}."


def _notes(levels: Levels, cell: _Row) -> list[str]:
    """What a named grouping is, and what the ratio leaves out or counts twice."""
    grouping = levels.grouping
    named = bool(levels.question.settings.grouping not in (None, "default") and grouping.description)
    said = [f"Grouping '{grouping.name}': {grouping.description}."] if named else []
    shared = overlaps_of(levels.question).select("group", "other", "keys_max").iter_rows()
    if pairs := [f"{group} and {other} share {keys:.3g} tokens" for group, other, keys in shared]:
        said.append(f"{listing(pairs, 4)}: these count in both groups, and twice in a side of the ratio with both.")
    if levels.grouping.ratio is not None and cell["num_nonfinite"]:
        which = f"{cell['num_nonfinite']} of {plural(cell['num_replans'], 'policy call')}"
        said.append(f"The ratio of {which} is infinite or undefined, and in no mean of ratios; the tables count them.")
    return said


def _figures(levels: Levels, tasks: pl.DataFrame, groups: pl.DataFrame, episodes: pl.DataFrame) -> list[Figure]:
    """Fractions by layer; with a ratio also tasks, the layers' profile, and how episodes are spread."""
    num_episodes = len(levels.question.selected)
    n = f"Means over {plural(num_episodes, 'episode')}, every task weighing the same."
    stacked = {"x": "layer", "value": "fraction", "color": "group", "ylabel": "part of the attention",
               "mean": LAYERS_AVG, "num_episodes": num_episodes}  # fmt: skip
    title, all_of_them = "How attention is divided, by layer", f"{n} Beside the names: all layers, with 95% intervals."
    found = [Figure("attention_fractions", "stacked", overall(groups), title, all_of_them, stacked)]
    if levels.grouping.ratio is None:
        return found
    name = " / ".join("+".join(side) for side in sides(levels.grouping))
    look = {"log": True, "uniform": "uniform_ratio", "value": "geometric_mean", "baseline_name": "if spread evenly"}
    label = pl.coalesce(
        pl.format("{}: {}", "task_id", "instruction"), pl.format("{}, all tasks", "suite"), pl.lit("all suites")
    ).alias("task")
    of_tasks = tasks.filter(AVERAGE).with_columns(label)
    dots = episodes.filter(AVERAGE).with_columns(label)
    title, bars = f"Ratio {name} of every task", f"{n} Bars: 95% intervals; small dots: episodes."
    axis = f"{name} (logarithmic)"
    found.append(Figure("ratio_per_task", "forest", of_tasks, title, bars, {**look, "label": "task", "dots": dots,
                        "xlabel": axis}))  # fmt: skip
    along = {**look, "xlabel": "layer", "ylabel": axis}
    if len(levels.question.selection.layers) > 1:
        profile, bands = overall(tasks).filter(~AVERAGE).sort("layer_number"), f"{n} Bands: 95% intervals."
        options = {**along, "x": "layer_number"}
        found.append(Figure("layer_profile", "lines", profile, f"Ratio {name} by layer", bands, options))
    spread = episodes.sort("layer_number", nulls_last=True).with_columns(pl.col("layer").replace(LAYERS_AVG, "all"))
    title, boxes = (
        f"Ratio {name} of single episodes, by layer",
        "Dots: episodes; boxes: quartiles; whiskers: 5% to 95%.",
    )
    return [*found, Figure("ratio_distribution", "distribution", spread, title, boxes, {**along, "x": "layer"})]
