"""The text of `vla-attention compare`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import polars as pl

from vla_attention.analyze.compare.comparison import LOG2_RATIO, SUCCESS, Comparison
from vla_attention.analyze.compare.differences import D_Z, HEDGES_G
from vla_attention.analyze.measures.frames import LAYERS_AVG, layer_name
from vla_attention.analyze.show.answer import Section
from vla_attention.analyze.show.findings import few_families_note, findings
from vla_attention.analyze.show.headings import interval_note, note_lines, title, untrained_warning, wrap
from vla_attention.analyze.show.numbers import format_number, plural, row_interval
from vla_attention.analyze.show.plot_text import shortened
from vla_attention.analyze.show.tables import (
    Column,
    Table,
    count,
    interval,
    number,
    percent,
    signed,
    signed_estimate,
    texts,
)
from vla_attention.analyze.statistics.effect_sizes import FEWEST_EPISODES, FEWEST_TASKS
from vla_attention.analyze.statistics.intervals import DEFAULT_LEVEL
from vla_attention.analyze.statistics.units import FEWEST_FAMILIES, Units
from vla_attention.schemas.errors import listing
from vla_attention.schemas.stores.store_format import episode_name

#: Sentences about a compared run that name what differs: of the quantities, and of the tasks.
_SENTENCES = 2


def comparison_sections(comparison: Comparison) -> list[Section]:
    """The whole answer."""
    layer = comparison.overall_layer
    sections = [_header(comparison, layer), _estimates_section(comparison, layer)]
    for name in comparison.names[1:]:
        sections.append(_difference_section(comparison, name, layer))
        sections += _effects_section(comparison, name)
        if name in comparison.runs_with_common_tasks:
            sections.append(_tasks_section(comparison, name, layer))
    return [*sections, *_layers_section(comparison)]


def _header(comparison: Comparison, layer: str) -> Section:
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
    return Section([[*lines, *note_lines([*comparison.notes, *([few] if few else [])])]])


def _estimates_section(comparison: Comparison, layer: str) -> Section:
    parts = comparison.estimates.filter(pl.col("layer") == layer).partition_by("run", "suite", maintain_order=True)
    estimates = [{row["quantity"]: row for row in part.iter_rows(named=True)} for part in parts]
    ratio = LOG2_RATIO in comparison.quantities
    columns = [
        texts("run", lambda of: of[SUCCESS]["run"][:24], left=True),
        texts("suite", lambda of: of[SUCCESS]["suite"][:16], left=True),
        count("episodes", lambda of: of[SUCCESS]["num_episodes"]),
        percent("success", _value_of(SUCCESS), decimals=0),
    ]
    if ratio:
        columns += [
            number("ratio", _value_of("ratio")),
            interval("", of=lambda of: of["ratio"]),
            number("uniform", lambda of: of["ratio"]["uniform_ratio"]),
            number("lift", _value_of("ratio_lift")),
        ]
    fractions = [name for name in comparison.quantities if name.endswith("_fraction")][: 2 if ratio else 5]
    columns += [percent(name.removesuffix("_fraction")[:14], _value_of(name)) for name in fractions]
    note = "ratio: geometric mean over tasks; uniform: what uniform attention gives; lift: ratio / uniform."
    left_out = [
        f"{row['run']}, {row['suite']}: {row['num_nonfinite']} replans have no finite ratio and are in no ratio; "
        f"{row['episodes_without_ratio']} of {row['num_episodes']} episodes have none at all."
        for row in (of["ratio"] for of in (estimates if ratio else ()))
        if row["num_nonfinite"] or row["episodes_without_ratio"]
    ]
    return Section([Table(columns, estimates), note if ratio else "", *left_out], "EACH RUN")


def _value_of(quantity: str) -> Callable[[Mapping[str, Any]], float | None]:
    def value(of: Mapping[str, Any]) -> float | None:
        number: float | None = of[quantity]["value"]
        return number

    return value


def _difference_section(comparison: Comparison, name: str, layer: str) -> Section:
    first = comparison.names[0]
    rows = comparison.differences.filter(pl.col("layer") == layer, run=name, scope="all")
    paired = bool(rows["paired"].any())
    columns = [
        texts("quantity", lambda row: shortened(row["quantity"], 26), left=True),
        *_of_both(first, name),
        *(signed_estimate("d_z", D_Z) if paired else signed_estimate("g", HEDGES_G)),
    ]
    named = findings(
        rows["q"].to_list(), rows["quantity"].to_list(), "quantity", "a difference", _num_sentences(comparison)
    )
    meaning = (
        "d_z: mean / standard deviation of the paired differences (Cohen)"
        if paired
        else "g: Hedges' g, difference in standard deviations"
    )
    note = (
        f"{meaning}, all weighing the same, corrected for small samples; none below {FEWEST_EPISODES} pairs or "
        f"episodes, or {_fewest_units(comparison.units)} are the units. q: p of no difference, adjusted for the number "
        "of quantities (Benjamini-Hochberg)."
    )
    said = f"{_factor(comparison, name, rows)}{named}"
    pairing, table = _pairing(comparison, name, rows), Table(columns, rows.to_dicts())
    return Section([pairing, table, said, note], f"{name} AGAINST {first}")


def _of_both(first: str, name: str) -> list[Column]:
    """What is compared in two runs: how often, either mean, and the difference."""
    return [
        _num_pairs(),
        number(first[:14], "mean_first"),
        number(name[:14], "mean_other"),
        signed("difference", "difference"),
        interval(""),
        number("q", "q"),
    ]


def _num_pairs() -> Column:
    return texts("n", lambda row: str(row["num_pairs"]) if row["paired"] else f"{row['num_first']}/{row['num_other']}")


def _fewest_units(units: Units) -> str:
    if units.families is None:
        return f"{FEWEST_TASKS} tasks where tasks"
    return f"{FEWEST_FAMILIES} families of tasks where these"


def _pairing(comparison: Comparison, name: str, rows: pl.DataFrame) -> str:
    first = comparison.names[0]
    alone = {
        run: comparison.unpaired.filter(pl.col("run") == run, pl.col("compared_with") == other)
        for run, other in ((first, name), (name, first))
    }
    if not rows["paired"].any():
        return (
            f"NOT PAIRED: no episode of {name} has the {_pairing_keys(comparison)} of one of {first}, so this compares "
            "means of independent episodes; differences between scenes are in it, and intervals are wider for that."
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
    return text


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


def _tasks_section(comparison: Comparison, name: str, layer: str) -> Section:
    quantity = comparison.quantities[0]
    rows = comparison.differences.filter(
        pl.col("run") == name, pl.col("scope") != "all", pl.col("layer") == layer, pl.col("quantity") == quantity
    )
    several = rows["suite"].n_unique() > 1

    def task(row: Mapping[str, Any]) -> str:
        number = "all" if row["task_id"] is None else row["task_id"]
        return f"{row['suite']} {number}" if several else str(row["task_id"])

    columns = [
        texts("task", task, left=True),
        _num_pairs(),
        signed("difference", "difference"),
        interval(""),
        number("q", lambda row: row["q"] if row["scope"] == "task" else None),
        texts("instruction", "instruction", running=True),
    ]
    tasks = rows.filter(scope="task").to_dicts()
    labels = [task(row) if several else f"task {task(row)}" for row in tasks]
    named = findings([row["q"] for row in tasks], labels, "task", "a difference", _num_sentences(comparison))
    said = f"{named} q: p of no difference, adjusted for the number of tasks (Benjamini-Hochberg)."
    return Section([Table(columns, rows.to_dicts()), said], f"PER TASK  {quantity}, {name} minus {comparison.names[0]}")


def _effects_section(comparison: Comparison, name: str) -> list[Section]:
    """Recorded effects of a run beside those of the first one."""
    first = comparison.names[0]
    table = comparison.effects.filter(run=name, scope="all").drop_nulls("difference")
    rows = table.sort(pl.max_horizontal("mean_first", "mean_other"), descending=True).to_dicts()
    if not rows:
        return []
    columns = [
        texts("item", lambda row: shortened(row["item"], 24), left=True),
        texts("read by", lambda row: {"total": "all", "direct": "action"}[row["reader"]], left=True),
        *_of_both(first, name),
    ]
    labels = [row["item"] if row["reader"] == "total" else f"{row['item']} (action queries alone)" for row in rows]
    named = findings([row["q"] for row in rows], labels, "effect", "a difference", _num_sentences(comparison))
    note = (
        "Change of the action without the item, in the spread of its own run's actions: when nobody reads it (all), or "
        "the action queries alone do not (action). q: p of no difference, adjusted for the number of effects "
        "(Benjamini-Hochberg)."
    )
    return [Section([named, Table(columns, rows), note], f"EFFECTS  without it, {name} and {first}")]


def _layers_section(comparison: Comparison) -> list[Section]:
    rows = comparison.differences.filter(scope="all", quantity=comparison.quantities[0])
    layers = [layer for layer in rows["layer"].unique(maintain_order=True) if layer != LAYERS_AVG]
    if len(layers) < 2:
        return []
    cells = {(row["run"], row["layer"]): row for row in rows.iter_rows(named=True)}
    others = comparison.names[1:4]

    def of_run(name: str) -> tuple[Column, ...]:
        def row(layer: str) -> dict[str, Any]:
            return cells.get((name, layer), {})

        return (
            signed(name[:20], lambda layer: row(layer).get("difference")),
            interval("", of=row),
            number("q", lambda layer: row(layer).get("layers_q")),
        )

    columns = [texts("block", str, left=True), *(column for name in others for column in of_run(name))]
    more = (
        f" (the first {len(others)} runs; the others are in the table)"
        if len(others) < len(comparison.names) - 1
        else ""
    )
    note = "q: p of no difference, adjusted for the number of blocks (Benjamini-Hochberg)."
    title = f"PER LAYER  {comparison.quantities[0]}, run minus {comparison.names[0]}{more}"
    return [Section([Table(columns, layers), note], title)]
