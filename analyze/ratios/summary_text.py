"""The text summary: run and selection, ratios beside those of uniform attention, fractions, lifts, tasks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import polars as pl

from vla_attention.analyze.measures.aggregate import layer_order, overall_layer, overall_rows
from vla_attention.analyze.measures.frames import LAYERS_AVG, Tables, layer_name
from vla_attention.analyze.ratios.verdict import LINGUISTIC_BELOW, VISUAL_ABOVE, meanings, reading, verdict
from vla_attention.analyze.show.findings import few_families_note
from vla_attention.analyze.show.headings import (
    WIDTH,
    heading,
    title,
    untrained_warning,
    wrap,
    wrap_all,
)
from vla_attention.analyze.show.numbers import (
    format_number,
    format_percent,
    interval_name,
    plural,
    row_interval,
    solved_text,
)
from vla_attention.analyze.show.plot_text import shortened
from vla_attention.analyze.show.text_table import text_table
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
        level: level of the intervals in `tasks_table`.
        notes: further lines, for instance about translated layer numbers.
        answer: the sentences that stand first.
    """

    stores: Sequence[str]
    policy: str
    untrained: bool
    denoise_steps: Sequence[int]
    units: Units
    heads: str = "mean over all heads"
    level: float = 0.95
    notes: Sequence[str] = field(default_factory=tuple)
    answer: Sequence[str] = ()


def summary_text(run: AnalysedRun, grouping: Grouping, episodes: Tables, tasks: Tables) -> str:
    """The whole summary, at most 100 columns wide, from `aggregate.episode_tables` and `aggregate.task_tables`."""
    parts = [_header(run, grouping, episodes)]
    if grouping.ratio:
        parts += [_ratio_section(run, grouping, tasks), _nonfinite_section(overall_rows(tasks).cells)]
    parts += [_groups_section(grouping, tasks, "fraction"), _groups_section(grouping, tasks, "lift")]
    suites = tasks.cells["suite"].drop_nulls().unique().sort().to_list()
    if len(suites) > 1:
        parts.append(_across_section(run, grouping, tasks, "all"))
    for suite in suites:
        of = f" OF {suite}" if len(suites) > 1 else ""
        parts.append(_across_section(run, grouping, tasks.filter(pl.col("suite") == suite), "task", of))
    return "\n\n".join(part for part in parts if part) + "\n"


def _header(run: AnalysedRun, grouping: Grouping, episodes: Tables) -> str:
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
    lines = [*title("ATTENTION SUMMARY"), *wrap_all(run.answer), *([""] if run.answer else [])]
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
    return "\n".join(lines)


def _ratio_section(run: AnalysedRun, grouping: Grouping, tasks: Tables) -> str:
    level = overall_rows(tasks)
    rows = level.cells
    header = ["layer", "ratio", interval_name(run.level), "uniform", "lift", "of means", "mean ± std", "median"]
    header += ["verdict"] * grouping.compares_modalities
    body = [
        [
            row["layer"],
            format_number(row["geometric_mean"]),
            row_interval(row, "geometric_mean"),
            *(format_number(row[column]) for column in ("uniform_ratio", "ratio_lift", "ratio_of_means")),
            _mean_and_spread(row),
            format_number(row["ratio_median"]),
            *[reading(row, run.untrained)] * grouping.compares_modalities,
        ]
        for row in _by_layer(rows)
    ]
    overall = rows.filter(pl.col("layer") == overall_layer(rows)).row(0, named=True)
    words = meanings([reading(row, run.untrained) for row in _by_layer(rows)]) if grouping.compares_modalities else ""
    legend = (
        "ratio, uniform, lift: geometric means; uniform: what uniform attention gives, lift: ratio / uniform. of "
        "means: mean numerator mass / mean denominator mass. mean, std, median: of the episodes' mean ratios "
        f"(n = {overall['num_episodes']}). {_interval_note(run, overall)} {words}".strip()
    )
    return "\n".join(
        [
            heading(f"RATIO  {ratio_definition(grouping)}"),
            text_table(header, body, left=(0, 8) if grouping.compares_modalities else (0,)),
            "",
            *wrap(legend),
            *wrap(_baseline_sentence(grouping, overall["uniform_ratio"], level)),
        ]
    )


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


def _nonfinite_section(rows: pl.DataFrame) -> str:
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
    if not lines:
        return ""
    explanation = (
        "Infinite (no denominator mass) or undefined (no mass on either side). Left out of mean, median and geometric "
        "mean; the ratio of means and the fractions include these replans."
    )
    return "\n".join([heading("RATIOS THAT ARE NOT FINITE"), *wrap(explanation), *lines])


def _groups_section(grouping: Grouping, tasks: Tables, kind: str) -> str:
    """Layers by groups that have keys; in blocks of as many groups as the width allows."""
    level = overall_rows(tasks)
    groups = level.groups_with_keys()
    names = [shortened(name, 24) for name in groups]
    layers, of_group = layer_order(level.cells), level.by_group("layer")
    show = format_percent if kind == "fraction" else format_number
    cells = {group: [show(of_group[layer, group][kind]) for layer in layers] for group in groups}
    room = WIDTH - max(map(len, [*layers, "layer"]))
    blocks: list[list[int]] = [[]]
    used = 0
    for i, group in enumerate(groups):
        width = 2 + max(map(len, [names[i], *cells[group]]))
        if used + width > room and blocks[-1]:
            blocks.append([])
            used = 0
        blocks[-1].append(i)
        used += width
    tables = [
        text_table(
            ["layer", *(names[i] for i in block)],
            [[layer, *(cells[groups[i]][j] for i in block)] for j, layer in enumerate(layers)],
            left=(0,),
        )
        for block in blocks
    ]
    if kind == "fraction":
        of_groups = "FRACTION of the summed masses of all groups" + (" (groups overlap)" if grouping.overlap else "")
        note = ""
    else:
        of_groups = "LIFT  mass, against what uniform attention gives"
        note = "\nMean over replans of mass / mass of attention that is uniform at each query, which has 1."
    return "\n".join([heading(of_groups), "\n\n".join(tables)]) + note


def _across_section(run: AnalysedRun, grouping: Grouping, tasks: Tables, scope: str, of: str = "") -> str:
    """A row per task (scope "task") or per suite (scope "all"), of `overall_layer`."""
    layer = overall_layer(tasks.cells)
    level = tasks.filter((pl.col("scope") == scope) & (pl.col("layer") == layer))
    rows, of_group = level.cells, level.by_group("suite", "task_id")
    name = "suite" if scope == "all" else "task"
    header = [name, "n", "success"]
    if grouping.ratio:
        header += ["ratio", interval_name(run.level), "uniform", "lift", "of means", "mean"]
    else:
        header += [shortened(group, 12) for group in grouping.names[:5]]
    body = []
    for row in rows.iter_rows(named=True):
        cells = [
            row["suite"] if scope == "all" else str(row["task_id"]),
            str(row["num_episodes"]),
            format_percent(row["success_rate"]),
        ]
        if grouping.ratio:
            cells += [
                format_number(row["geometric_mean"]),
                row_interval(row, "geometric_mean"),
                *(format_number(row[c]) for c in ("uniform_ratio", "ratio_lift", "ratio_of_means", "ratio_mean")),
            ]
        else:
            cells += [
                format_percent(of_group[row["suite"], row["task_id"], group]["fraction"])
                for group in grouping.names[:5]
            ]
        body.append(cells)
    last = "" if scope == "all" else "instruction"
    texts = [row["instruction"] or "" for row in rows.iter_rows(named=True)]
    shown = layer_name(layer, LAYERS_AVG)
    what = "ratio" if grouping.ratio else f"fractions of {listing(grouping.names[:5])}"
    table = text_table(header, body, left=(0,), last=last, texts=texts if last else None, width=WIDTH)
    fewest = rows["num_episodes"].min()
    if grouping.ratio and scope == "task" and isinstance(fewest, int) and 1 < fewest < FEW_EPISODES:
        warning = (
            "The interval of a task with n episodes rests on n - 1 degrees of freedom. With fewer than "
            f"{FEW_EPISODES} episodes its width varies much by chance: a narrow one is no sign of certainty."
        )
        table = "\n".join([table, *wrap(warning)])
    if scope == "all":
        table = "\n".join([table, *wrap(few_families_note(rows, "suite", run.units))])
    return "\n".join([heading(f"PER {name.upper()}{of}  {what}, {shown}"), table])


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
