"""The text summary: run and selection, ratios beside those of uniform attention, fractions, lifts, tasks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import polars as pl

from vla_attention.analyze.measures.aggregate import layer_order, overall_layer, overall_rows
from vla_attention.analyze.measures.frames import LAYERS_AVG, Tables, layer_name
from vla_attention.analyze.ratios.verdict import LINGUISTIC_BELOW, VISUAL_ABOVE, meanings, reading, verdict
from vla_attention.analyze.show.answer import Section
from vla_attention.analyze.show.findings import few_families_note
from vla_attention.analyze.show.headings import WIDTH, title, untrained_warning, wrap, wrap_all
from vla_attention.analyze.show.numbers import format_number, format_percent, plural, solved_text
from vla_attention.analyze.show.plot_text import shortened
from vla_attention.analyze.show.tables import (
    INTERVAL,
    Cell,
    Column,
    Table,
    count,
    interval,
    number,
    percent,
    texts,
    words,
)
from vla_attention.analyze.statistics.units import Units
from vla_attention.schemas.errors import listing
from vla_attention.schemas.groupings.grouping import Grouping

#: With fewer episodes of a task, the summary warns that the width of the task's interval says little.
FEW_EPISODES = 5
#: Relative difference below which the uniform ratio reads as the quotient of the mean numbers of keys.
_SAME_QUOTIENT = 0.005


@dataclass(frozen=True)
class AnalysedRun:
    """The lines of the summary's header that the tables do not hold.

    Attributes:
        stores: paths or names of the stores.
        policy: name of the policy and its checkpoint, as it should be shown.
        untrained: whether the weights are random.
        denoise_steps: denoise steps that were averaged over.
        units: what the intervals over all tasks are about.
        heads: how heads were averaged, as text.
        notes: further lines, for instance about translated layer numbers.
        answer: the sentences that stand first.
    """

    stores: Sequence[str]
    policy: str
    untrained: bool
    denoise_steps: Sequence[int]
    units: Units
    heads: str = "mean over all heads"
    notes: Sequence[str] = field(default_factory=tuple)
    answer: Sequence[str] = ()


def summary_sections(run: AnalysedRun, grouping: Grouping, episodes: Tables, tasks: Tables) -> list[Section]:
    """The summary, from `aggregate.episode_tables` and `aggregate.task_tables`."""
    sections = _header(run, grouping, episodes)
    if grouping.ratio:
        sections += [*_ratio_sections(run, grouping, tasks), *_nonfinite_section(overall_rows(tasks).cells)]
    sections += [*_group_sections(grouping, tasks, "fraction"), *_group_sections(grouping, tasks, "lift")]
    suites = tasks.cells["suite"].drop_nulls().unique().sort().to_list()
    if len(suites) > 1:
        sections.append(_across_section(run, grouping, tasks, "all"))
    for suite in suites:
        of = f" OF {suite}" if len(suites) > 1 else ""
        sections.append(_across_section(run, grouping, tasks.filter(pl.col("suite") == suite), "task", of))
    return sections


def _header(run: AnalysedRun, grouping: Grouping, episodes: Tables) -> list[Section]:
    of_layer = episodes.filter(pl.col("layer") == overall_layer(episodes.cells))
    overall = of_layer.cells
    num_tasks = overall.select("suite", "task_id").n_unique()
    known = overall["success"].drop_nulls()
    outcomes = (
        f"{int(known.sum())} successful ({format_percent(int(known.sum()) / len(known))})"
        if len(known) == overall.height
        else solved_text(overall["success"])
    )
    layers = [layer for layer in layer_order(episodes.cells) if layer != LAYERS_AVG]
    blocks = dict(episodes.cells.select("layer", "block").unique().iter_rows())
    translated = [f"{layer} = block {blocks[layer]}" for layer in layers if str(blocks[layer]) != layer]
    above = [*title("ATTENTION SUMMARY"), *wrap_all(run.answer)]
    lines: list[str] = [] if run.answer else above
    if run.untrained:
        lines += ["!" * WIDTH, *wrap(untrained_warning()), "!" * WIDTH]
    lines += _labelled("store", ", ".join(run.stores))
    lines += _labelled("policy", run.policy + (" (UNTRAINED WEIGHTS)" if run.untrained else ""))
    lines += _labelled("suite", ", ".join(sorted(overall["suite"].unique())))
    lines += _labelled(
        "episodes",
        f"{overall.height} of {plural(num_tasks, 'task')}, {outcomes}; {int(overall['num_replans'].sum())} replans",
    )
    lines += _labelled("layers", listing(layers, 40) + (f" ({', '.join(translated)})" if translated else ""))
    lines += _labelled("averaged over", f"denoise steps {listing(run.denoise_steps, 40)}; {run.heads}")
    lines += _labelled("grouping", f"{grouping.name}{': ' + grouping.description if grouping.description else ''}")
    having = of_layer.groups_with_keys()
    for name, selectors in grouping.groups.items():
        absent = "" if name in having else "   (no keys here)"
        lines += wrap(f"{name} = {' | '.join(selectors)}{absent}", first=" " * 17, rest=" " * 21)
    if grouping.ratio:
        lines += _labelled("ratio", ratio_definition(grouping))
    for note in run.notes:
        lines += _labelled("note", note)
    return [*([Section([above])] if run.answer else []), Section([lines])]


def ratio_columns(bounds_of_lift: bool = False) -> list[Column]:
    """The ratio of a row of `aggregate.task_tables`, what uniform attention gives, and the lift over it."""
    return [
        number("ratio", "geometric_mean", "ratio"),
        interval("geometric_mean", INTERVAL, INTERVAL),
        number("uniform", "uniform_ratio", "uniform"),
        number("lift", "ratio_lift", "lift"),
        *([interval("ratio_lift", INTERVAL)] if bounds_of_lift else []),
        number("of means", "ratio_of_means", "of means"),
    ]


def _layer() -> Column:
    def cell(row: Mapping[str, Any]) -> Cell:
        block = "" if row["block"] is None or str(row["block"]) == row["layer"] else f" (block {row['block']})"
        return Cell(f"{row['layer']}{block}", row["layer_number"])

    return Column("layer", lambda row: str(row["layer"]), cell, "layer", left=True)


def layer_table(grouping: Grouping, tasks: Tables, untrained: bool) -> Table:
    """The ratio over all tasks in every layer, in a text and on the page."""
    columns = [
        _layer(),
        *ratio_columns(),
        texts("mean ± std", _mean_and_spread),
        number(None, "ratio_mean", "mean"),
        number("median", "ratio_median", "median"),
        count(None, "num_nonfinite", "not finite"),
    ]
    if grouping.compares_modalities:
        columns.append(texts("verdict", lambda row: reading(row, untrained), left=True))
    return Table(columns, _by_layer(overall_rows(tasks).cells), "Ratio per layer")


def _ratio_sections(run: AnalysedRun, grouping: Grouping, tasks: Tables) -> list[Section]:
    level, table = overall_rows(tasks), layer_table(grouping, tasks, run.untrained)
    overall = level.cells.filter(pl.col("layer") == overall_layer(level.cells)).row(0, named=True)
    compares = grouping.compares_modalities
    legend = (
        "ratio, uniform, lift: geometric means; uniform: what uniform attention gives, lift: ratio / uniform. of "
        "means: mean numerator mass / mean denominator mass. mean, std, median: of the episodes' mean ratios "
        f"(n = {overall['num_episodes']}). {_interval_note(run, overall)} "
        f"{meanings([reading(row, run.untrained) for row in table.rows]) if compares else ''}".strip()
    )
    return [
        Section([table], f"RATIO  {ratio_definition(grouping)}"),
        Section([legend, _baseline_sentence(grouping, overall["uniform_ratio"], level)]),
    ]


def _interval_note(run: AnalysedRun, overall: dict[str, object]) -> str:
    if overall["num_episodes"] == 1:
        return "No interval: a single episode says nothing about how much episodes differ."
    about = run.units.words if overall["num_tasks"] != 1 else "episodes like these of the one task"
    return f"interval: of the geometric mean, about {about}."


def _baseline_sentence(grouping: Grouping, uniform: float | None, level: Tables) -> str:
    assert grouping.ratio is not None
    if uniform is None:
        return (
            "There is no uniform baseline, because a side of the ratio has no keys; the ratio means little without one."
        )
    of_group, layer = level.by_group("layer"), overall_layer(level.cells)
    above = sum(of_group[layer, name]["keys"] for name in grouping.ratio.numerator)
    below = sum(of_group[layer, name]["keys"] for name in grouping.ratio.denominator)
    baseline = (
        f"Uniform attention alone gives ratio = {format_number(uniform)}, because there are on average "
        f"{format_number(above)} keys on one side and {format_number(below)} on the other"
    )
    if abs(above - uniform * below) > _SAME_QUOTIENT * above:
        baseline += (
            " (a geometric mean over episodes and tasks, of what each query gives the keys that it sees, and not the "
            "quotient of these two means)"
        )
    if not grouping.compares_modalities:
        return f"{baseline}: read the ratio beside it, or read the lift."
    return (
        f"{baseline}, and that alone would be called '{verdict(uniform)}': the verdict (above {VISUAL_ABOVE} visual, "
        f"below {LINGUISTIC_BELOW} linguistic) means little without the lift."
    )


def _nonfinite_section(rows: pl.DataFrame) -> list[Section]:
    lines = []
    for row in _by_layer(rows):
        of = layer_name(row["layer"], LAYERS_AVG)
        if row["num_nonfinite"]:
            without = row["episodes_without_ratio"]
            lines.append(
                f"{of}: {row['num_nonfinite']} of {row['num_replans']} replans"
                + (f"; {without} of {row['num_episodes']} episodes have no finite ratio at all" if without else "")
            )
        zeros = row["geometric_left_out"] - row["num_nonfinite"]
        if zeros:
            lines.append(f"{of}: {zeros} ratios are 0 and left out of the geometric mean")
        if row["layer"] == LAYERS_AVG and row["nonfinite_layers"]:
            lines.append(f"{of}: {row['nonfinite_layers']} (replan, layer) ratios left out of the average over layers")
    explanation = (
        "Infinite (no denominator mass) or undefined (no mass on either side). Left out of mean, median and geometric "
        "mean; the ratio of means and the fractions include these replans."
    )
    return [Section([explanation, lines], "RATIOS THAT ARE NOT FINITE")] if lines else []


def layer_groups_table(level: Tables, groups: Sequence[str]) -> Table:
    """Fractions, then lifts of groups in every layer; a text has them in tables of their own, the page in one."""
    of_group = level.by_group("layer")
    cells = {row["layer"]: row for row in level.cells.iter_rows(named=True)}
    rows = [
        {name: cells[layer][name] for name in ("layer", "layer_number", "block")}
        | {f"{kind} {group}": of_group[layer, group][kind] for kind in ("fraction", "lift") for group in groups}
        for layer in layer_order(level.cells)
    ]
    fractions = [percent(shortened(group, 24), f"fraction {group}", group) for group in groups]
    lifts = [number(shortened(group, 24), f"lift {group}", f"{group} lift") for group in groups]
    caption = (
        "Groups per layer. Per cent: fraction of the groups' summed mass; lift: mass over what uniform attention gives"
    )
    return Table([_layer(), *fractions, *lifts], rows, caption)


def _group_sections(grouping: Grouping, tasks: Tables, kind: str) -> list[Section]:
    """Layers by groups that have keys; in blocks of as many groups as the width allows."""
    level = overall_rows(tasks)
    groups = level.groups_with_keys()
    table = layer_groups_table(level, groups)
    layer, columns = table.columns[0], table.columns[1:][: len(groups)]
    if kind == "lift":
        columns = table.columns[1:][len(groups) :]

    def width_of(column: Column) -> int:
        return max(len(text) for text in (str(column.header), *map(column.text, table.rows)))

    blocks: list[list[Column]] = [[]]
    used, room = 0, WIDTH - width_of(layer)
    for column in columns:
        width = 2 + width_of(column)
        if used + width > room and blocks[-1]:
            blocks.append([])
            used = 0
        blocks[-1].append(column)
        used += width
    heading = "FRACTION of the summed masses of all groups" + (" (groups overlap)" if grouping.overlap else "")
    note = ""
    if kind == "lift":
        heading = "LIFT  mass, against what uniform attention gives"
        note = "Mean over replans of mass / mass of attention that is uniform at each query, which has 1."
    tables = [Table([layer, *block], table.rows) for block in blocks]
    last = len(tables) - 1
    return [Section([one, note if i == last else ""], "" if i else heading) for i, one in enumerate(tables)]


def across_table(
    grouping: Grouping, level: Tables, scope: str = "task", several_suites: bool = False, on_page: Sequence[str] = ()
) -> Table:
    """A row per task (scope "task") or per suite (scope "all"), in a text and on the page.

    Args:
        grouping: whose ratio, or without one whose first groups, are shown.
        level: the rows.
        scope: of the rows.
        several_suites: whether the page names the suites.
        on_page: groups that the page shows.
    """
    of_group = level.by_group("suite", "task_id")
    rows = [
        row
        | {f"fraction {group}": of_group[row["suite"], row["task_id"], group]["fraction"] for group in grouping.names}
        for row in level.cells.iter_rows(named=True)
    ]
    by_suite = scope == "all"
    columns = [
        words("suite", "suite") if by_suite else count("task", "task_id", "task", left=True),
        *([words(None, "suite", "suite")] if several_suites else []),
        *([] if by_suite else [words("instruction", "instruction", "instruction", running=True)]),
        count("n", "num_episodes", "episodes"),
        percent("success", "success_rate", "solved"),
        *([*ratio_columns(), number("mean", "ratio_mean", "mean")] if grouping.ratio else []),
        *([count(None, "num_nonfinite", "not finite")] if grouping.ratio else []),
        *(
            percent(shortened(group, 12), f"fraction {group}")
            for group in (() if grouping.ratio else grouping.names[:5])
        ),
        *(percent(None, f"fraction {group}", group) for group in on_page),
    ]
    return Table(columns, rows)


def _across_section(run: AnalysedRun, grouping: Grouping, tasks: Tables, scope: str, of: str = "") -> Section:
    layer = overall_layer(tasks.cells)
    level = tasks.filter((pl.col("scope") == scope) & (pl.col("layer") == layer))
    what = "ratio" if grouping.ratio else f"fractions of {listing(grouping.names[:5])}"
    fewest, warning = level.cells["num_episodes"].min(), ""
    if grouping.ratio and scope == "task" and isinstance(fewest, int) and 1 < fewest < FEW_EPISODES:
        warning = (
            "The interval of a task with n episodes rests on n - 1 degrees of freedom. With fewer than "
            f"{FEW_EPISODES} episodes its width varies much by chance: a narrow one is no sign of certainty."
        )
    if scope == "all":
        warning = few_families_note(level.cells, "suite", run.units)
    name = "SUITE" if scope == "all" else "TASK"
    heading = f"PER {name}{of}  {what}, {layer_name(layer, LAYERS_AVG)}"
    return Section([across_table(grouping, level, scope), warning], heading)


def _by_layer(rows: pl.DataFrame) -> list[dict[str, Any]]:
    return list(rows.sort("layer_number", nulls_last=True).iter_rows(named=True))


def _mean_and_spread(row: dict[str, Any]) -> str:
    # The std of a single episode is 0, which would suggest certainty.
    if row["num_episodes"] - row["episodes_without_ratio"] < 2:
        return format_number(row["ratio_mean"])
    return f"{format_number(row['ratio_mean'])} ± {format_number(row['ratio_std'])}"


def ratio_definition(grouping: Grouping) -> str:
    """The ratio of a grouping as text, `visual / linguistic`; of a side with many groups, the first four."""
    assert grouping.ratio is not None
    sides = []
    for names in (grouping.ratio.numerator, grouping.ratio.denominator):
        # The list of groups names all of them; here many names would hide the numbers.
        shown = " + ".join(names[:4]) + (f" + {len(names) - 4} more" if len(names) > 4 else "")
        sides.append(f"({shown})" if len(names) > 1 else shown)
    return " / ".join(sides)


def _labelled(label: str, text: str) -> list[str]:
    return wrap(f"{label + ':':<15}{text}", rest=" " * 15)
