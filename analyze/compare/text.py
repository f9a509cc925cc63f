"""The text of `vla-analyze compare`."""

from __future__ import annotations

import polars as pl

from vla_attention.analyze.compare.comparison import D_Z, HEDGES_G, LOG2_RATIO, SUCCESS, Comparison
from vla_attention.analyze.measures.frames import LAYERS_AVG, layer_name
from vla_attention.analyze.show.findings import few_families_note, findings
from vla_attention.analyze.show.headings import (
    WIDTH,
    heading,
    interval_note,
    note_lines,
    title,
    untrained_warning,
    wrap,
)
from vla_attention.analyze.show.numbers import (
    format_interval,
    format_number,
    format_percent,
    format_signed,
    plural,
    row_interval,
)
from vla_attention.analyze.show.plot_text import shortened
from vla_attention.analyze.show.text_table import text_table
from vla_attention.analyze.statistics.effect_sizes import FEWEST_EPISODES, FEWEST_TASKS
from vla_attention.analyze.statistics.intervals import DEFAULT_LEVEL
from vla_attention.analyze.statistics.units import FEWEST_FAMILIES, Units
from vla_attention.schemas.errors import listing
from vla_attention.schemas.stores.store_format import episode_name

#: Sentences about a compared run that name what differs: of the quantities, and of the tasks.
_SENTENCES = 2


def comparison_text(comparison: Comparison) -> str:
    """The whole text, at most 100 columns wide."""
    layer = comparison.overall_layer
    parts = [_header(comparison, layer), _estimates_section(comparison, layer)]
    for name in comparison.names[1:]:
        parts.append(_difference_section(comparison, name, layer))
        if name in comparison.runs_with_common_tasks:
            parts.append(_tasks_section(comparison, name, layer))
    parts.append(_layers_section(comparison))
    return "\n\n".join(part for part in parts if part) + "\n"


def _header(comparison: Comparison, layer: str) -> str:
    lines = title("COMPARISON OF RUNS")
    if any(store.attributes.policy.untrained for run in comparison.runs for store in run.stores):
        lines += wrap(untrained_warning("a policy has"))
    for run in comparison.runs:
        policy = run.stores[0].attributes.policy
        stores = ", ".join(str(store.path) for store in run.stores)
        lines += wrap(f"{run.name}: {policy.name} ({policy.checkpoint}), {listing(run.suites)}; {stores}", rest="  ")
    which = layer_name(layer, LAYERS_AVG, "block")
    lines += wrap(
        f"Grouping '{comparison.grouping.name}', site {comparison.runs[0].question.site}, {which}; differences are run "
        f"minus {comparison.names[0]}. {interval_note(DEFAULT_LEVEL, comparison.units.words)}",
    )
    of_suites = comparison.estimates.filter(pl.col("layer") == layer).unique(["run", "suite"], maintain_order=True)
    few = few_families_note(of_suites, "suite", comparison.units)
    lines += note_lines([*comparison.notes, *([few] if few else [])])
    return "\n".join(lines)


def _estimates_section(comparison: Comparison, layer: str) -> str:
    parts = comparison.estimates.filter(pl.col("layer") == layer).partition_by("run", "suite", maintain_order=True)
    estimates = [{row["quantity"]: row for row in part.iter_rows(named=True)} for part in parts]
    ratio = LOG2_RATIO in comparison.quantities
    header = ["run", "suite", "episodes", "success"] + (["ratio", "interval", "uniform", "lift"] if ratio else [])
    fractions = [name for name in comparison.quantities if name.endswith("_fraction")][: 2 if ratio else 5]
    header += [name.removesuffix("_fraction")[:14] for name in fractions]
    body = []
    for of in estimates:
        row = of[SUCCESS]
        cells = [row["run"][:24], row["suite"][:16], str(row["num_episodes"]), format_percent(row["value"], 0)]
        if ratio:
            row = of["ratio"]
            cells += [format_number(row["value"]), format_interval(row["low"], row["high"])]
            cells += [format_number(row["uniform_ratio"]), format_number(of["ratio_lift"]["value"])]
        body.append(cells + [format_percent(of[name]["value"]) for name in fractions])
    note = (
        "ratio: geometric mean over tasks; uniform: what uniform attention gives; lift: ratio / uniform."
        if ratio
        else ""
    )
    lines = [heading("EACH RUN"), text_table(header, body, left=(0, 1)), *wrap(note)]
    for row in (of["ratio"] for of in estimates) if ratio else ():
        if row["num_nonfinite"] or row["episodes_without_ratio"]:
            lines += wrap(
                f"{row['run']}, {row['suite']}: {row['num_nonfinite']} replans have no finite ratio and are in no "
                f"ratio; {row['episodes_without_ratio']} of {row['num_episodes']} episodes have none at all.",
            )
    return "\n".join(lines)


def _difference_section(comparison: Comparison, name: str, layer: str) -> str:
    first = comparison.names[0]
    rows = comparison.differences.filter(pl.col("run") == name, pl.col("scope") == "all", pl.col("layer") == layer)
    lines = [heading(f"{name} AGAINST {first}")]
    lines += _pairing(comparison, name, rows)
    paired = bool(rows["paired"].any())
    effect, effect_name = (D_Z, "d_z") if paired else (HEDGES_G, "g")
    header = ["quantity", "n", first[:14], name[:14], "difference", "interval", "q", effect_name, "interval"]
    body = []
    for row in rows.iter_rows(named=True):
        n = str(row["num_pairs"]) if row["paired"] else f"{row['num_first']}/{row['num_other']}"
        body.append(
            [
                shortened(row["quantity"], 26),
                n,
                format_number(row["mean_first"]),
                format_number(row["mean_other"]),
                format_signed(row["difference"]),
                format_interval(row["low"], row["high"]),
                format_number(row["q"]),
                format_signed(row[effect]),
                row_interval(row, effect),
            ]
        )
    lines.append(text_table(header, body, left=(0,)))
    named = findings(
        rows["q"].to_list(), rows["quantity"].to_list(), "quantity", "a difference", _num_sentences(comparison)
    )
    lines += wrap(f"{_factor(comparison, name, rows)}{named}")
    meaning = (
        "d_z: mean / standard deviation of the paired differences (Cohen)"
        if paired
        else "g: Hedges' g, difference in standard deviations"
    )
    lines += wrap(
        f"{meaning}, all weighing the same, corrected for small samples; none below {FEWEST_EPISODES} pairs or "
        f"episodes, or {_fewest_units(comparison.units)} are the units. q: p of no difference, adjusted for the number "
        "of quantities (Benjamini-Hochberg)."
    )
    return "\n".join(lines)


def _fewest_units(units: Units) -> str:
    if units.families is None:
        return f"{FEWEST_TASKS} tasks where tasks"
    return f"{FEWEST_FAMILIES} families of tasks where these"


def _pairing(comparison: Comparison, name: str, rows: pl.DataFrame) -> list[str]:
    first = comparison.names[0]
    alone = {
        run: comparison.unpaired.filter(pl.col("run") == run, pl.col("compared_with") == other)
        for run, other in ((first, name), (name, first))
    }
    if not rows["paired"].any():
        return wrap(
            f"NOT PAIRED: no episode of {name} has the {_pairing_keys(comparison)} of one of {first}, so this compares "
            "means of independent episodes; differences between scenes are in it, and intervals are wider for that.",
        )
    pairs = comparison.pairs.filter(pl.col("run") == name).select("suite", "task_id", "episode_first").unique().height
    text = f"{plural(pairs, 'pair')} of episodes with the same {_pairing_keys(comparison)}."
    if name in comparison.reruns:
        text = f"{plural(pairs, 'pair')} of episodes, replan by replan: {name} is a rerun of {first}, the same calls."
    if comparison.ignores_seed:
        text += " Their seeds may differ: environment and noise are not the same in both runs."
    for run, table in alone.items():
        if table.height:
            names = [episode_name(row["task_id"], row["episode_index"]) for row in table.iter_rows(named=True)]
            text += f" Of {run}, {table.height} have no partner and are left out: {listing(names, 6)}."
    return wrap(text)


def _num_sentences(comparison: Comparison) -> int:
    return _SENTENCES * (len(comparison.names) - 1)


def _pairing_keys(comparison: Comparison) -> str:
    return "suite, task and initial state" if comparison.ignores_seed else "suite, task, initial state and seed"


def _factor(comparison: Comparison, name: str, rows: pl.DataFrame) -> str:
    ratio = rows.filter(pl.col("quantity") == LOG2_RATIO)
    if ratio.is_empty() or ratio["difference"][0] is None:
        return ""
    row = ratio.row(0, named=True)
    bounds = {end: None if row[end] is None else 2.0 ** row[end] for end in ("low", "high")}
    interval = row_interval(bounds)
    factor = f"{format_number(2.0 ** row['difference'])}{'' if interval == '-' else f' {interval}'}"
    return f"Ratio of {name} / ratio of {comparison.names[0]}: {factor} (2 to the difference). "


def _tasks_section(comparison: Comparison, name: str, layer: str) -> str:
    quantity = comparison.quantities[0]
    rows = comparison.differences.filter(
        pl.col("run") == name, pl.col("scope") != "all", pl.col("layer") == layer, pl.col("quantity") == quantity
    )
    several = rows["suite"].n_unique() > 1
    header = ["task", "n", "difference", "interval", "q"]
    body = [
        [
            f"{row['suite']} {'all' if row['task_id'] is None else row['task_id']}" if several else str(row["task_id"]),
            str(row["num_pairs"]) if row["paired"] else f"{row['num_first']}/{row['num_other']}",
            format_signed(row["difference"]),
            format_interval(row["low"], row["high"]),
            format_number(row["q"] if row["scope"] == "task" else None),
        ]
        for row in rows.iter_rows(named=True)
    ]
    tasks = rows.filter(pl.col("scope") == "task")
    labels = [
        f"{row['suite']} {row['task_id']}" if several else f"task {row['task_id']}"
        for row in tasks.iter_rows(named=True)
    ]
    named = findings(tasks["q"].to_list(), labels, "task", "a difference", _num_sentences(comparison))
    said = wrap(f"{named} q: p of no difference, adjusted for the number of tasks (Benjamini-Hochberg).")
    texts = [row["instruction"] or "" for row in rows.iter_rows(named=True)]
    table = text_table(header, body, left=(0,), last="instruction", texts=texts, width=WIDTH)
    return "\n".join([heading(f"PER TASK  {quantity}, {name} minus {comparison.names[0]}"), table, *said])


def _layers_section(comparison: Comparison) -> str:
    rows = comparison.differences.filter(pl.col("scope") == "all", pl.col("quantity") == comparison.quantities[0])
    layers = [layer for layer in rows["layer"].unique(maintain_order=True) if layer != LAYERS_AVG]
    if len(layers) < 2:
        return ""
    cells = {(row["run"], row["layer"]): row for row in rows.iter_rows(named=True)}
    others = comparison.names[1:4]
    header = ["block"] + [text for name in others for text in (name[:20], "interval", "q")]
    body = []
    for layer in layers:
        line = [layer]
        for name in others:
            row = cells.get((name, layer))
            line += (
                ["-", "-", "-"]
                if row is None
                else [format_signed(row["difference"]), row_interval(row), format_number(row["layers_q"])]
            )
        body.append(line)
    more = (
        f" (the first {len(others)} runs; the others are in the table)"
        if len(others) < len(comparison.names) - 1
        else ""
    )
    per_layer = f"PER LAYER  {comparison.quantities[0]}, run minus {comparison.names[0]}{more}"
    note = "q: p of no difference, adjusted for the number of blocks (Benjamini-Hochberg)."
    return "\n".join([heading(per_layer), text_table(header, body, left=(0,)), note])
