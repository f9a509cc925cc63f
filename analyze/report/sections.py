"""The sections of the page that are made from the analysis's tables."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

import polars as pl

from vla_attention.analyze.measures.aggregate import layer_order, overall_layer, overall_rows
from vla_attention.analyze.measures.contributions import contribution_rows
from vla_attention.analyze.measures.frames import LAYERS_AVG
from vla_attention.analyze.ratios.analysis import Analysis, describe_heads
from vla_attention.analyze.ratios.plot_attention_fractions import plot_attention_fractions
from vla_attention.analyze.ratios.plot_ratio_distribution import plot_ratio_distribution
from vla_attention.analyze.ratios.plot_ratio_per_task import plot_ratio_per_task
from vla_attention.analyze.report.caveats import Caveat, verdict_sentence
from vla_attention.analyze.report.markup import (
    Cell,
    attribute,
    interval_cell,
    listed,
    number_cell,
    paragraph,
    percent_cell,
    table,
    text,
    text_cell,
)
from vla_attention.analyze.report.pictures import drawn
from vla_attention.analyze.show.numbers import format_interval, format_number
from vla_attention.analyze.statistics.bootstrap import DEFAULT_RESAMPLES
from vla_attention.schemas.errors import listing
from vla_attention.schemas.jsonable import to_json
from vla_attention.schemas.precision import FLOAT32_MANTISSA_BITS


@dataclass(frozen=True)
class Section:
    """A part of the page with a heading: `anchor` is its address inside the page, `content` its HTML."""

    anchor: str
    heading: str
    content: str


def headline(analysis: Analysis, notes: Sequence[Caveat]) -> Section:
    """The number, its interval, what uniform attention gives, and what to know before quoting it."""
    level = overall_rows(analysis.tasks)
    layer = overall_layer(level.cells)
    row, of_group = level.cells.filter(layer=layer).row(0, named=True), level.by_group("layer")
    solved = f"{row['success_rate']:.0%} solved"
    episodes = (
        f"{row['num_episodes']}",
        "episodes",
        f"of {row['num_tasks']} task{'s' * (row['num_tasks'] != 1)}; {solved}; {row['num_replans']} replans",
    )
    boxes = []
    sentence = ""
    if analysis.grouping.ratio is not None:
        sides = (" + ".join(side) for side in (analysis.grouping.ratio.numerator, analysis.grouping.ratio.denominator))
        name = " / ".join(side if len(side) < 60 else side[:59] + "…" for side in sides)
        over = "mean over layers" if layer == LAYERS_AVG else f"layer {layer}"
        if row["ratio_mean"] is None:
            boxes.append(("none", f"ratio {name}", f"no replan has a finite ratio; {over}"))
        else:
            boxes.append((format_number(row["ratio_mean"]), f"ratio {name}", f"{_interval(row, 'ratio_mean')}; {over}"))
        boxes.append(
            (format_number(row["uniform_ratio"]), "with uniform attention", "what the numbers of keys alone give")
        )
        boxes.append(
            (format_number(row["ratio_lift"]), "lift", f"{_interval(row, 'ratio_lift')}; 1 is uniform attention")
        )
        sentence = verdict_sentence(analysis.grouping, row["ratio_mean"], row["uniform_ratio"])
    else:
        for group in _present(analysis)[:3]:
            own = of_group[layer, group]
            value = own["fraction"]
            shown = "-" if value is None else f"{100 * value:.1f} %"
            low, high = own["fraction_low"], own["fraction_high"]
            bounds = "no interval" if low is None else f"95 % interval {100 * low:.1f} to {100 * high:.1f} %"
            boxes.append((shown, f"fraction of {group}", bounds))
    boxes.append(episodes)
    items = "".join(
        f"<div><dt>{text(label)}</dt><dd>{text(value)}<small>{text(note)}</small></dd></div>"
        for value, label, note in boxes
    )
    grave = "".join(
        f'<p class="banner"><strong>{text(note.topic)}.</strong> {text(note.sentence)}</p>'
        for note in notes
        if note.grave
    )
    other = ""
    if analysis.grouping.ratio is not None:
        other = paragraph(
            f"Ratio of means {format_number(row['ratio_of_means'])} "
            f"{format_interval(row['ratio_of_means_low'], row['ratio_of_means_high'])}, geometric mean "
            f"{format_number(row['geometric_mean'])} "
            f"{format_interval(row['geometric_mean_low'], row['geometric_mean_high'])}, median of the episodes "
            f"{format_number(row['ratio_median'])}.",
            "quiet",
        )
    verdict = paragraph(sentence) if sentence else ""
    return Section("headline", "Headline", f'{grave}<dl class="headline">{items}</dl>{verdict}{other}')


def _interval(row: dict, column: str) -> str:
    low, high = row[f"{column}_low"], row[f"{column}_high"]
    return (
        "no interval from fewer than two episodes"
        if low is None
        else f"95 % interval {format_number(low)} to {format_number(high)}"
    )


def caveat_section(notes: Sequence[Caveat]) -> Section:
    """What applies to this store."""
    items = "".join(
        f"<li{attribute('class', 'grave' * note.grave)}><strong>{text(note.topic)}.</strong> {text(note.sentence)}</li>"
        for note in notes
    )
    return Section("caveats", "What to know about these numbers", f'<ul class="caveats">{items}</ul>')


def task_section(analysis: Analysis, folder: Path) -> Section:
    """A row per task, sortable, and the picture of ratios per task."""
    grouping = analysis.grouping
    layer = overall_layer(analysis.tasks.cells)
    level = analysis.tasks.filter((pl.col("scope") == "task") & (pl.col("layer") == layer))
    rows, of_group = level.cells, level.by_group("suite", "task_id")
    several = rows["suite"].n_unique() > 1
    header = ["task", *(["suite"] if several else []), "instruction", "episodes", "solved %"]
    groups = _present(analysis)[: 2 if grouping.ratio is not None else 6]
    if grouping.ratio is not None:
        header += ["mean ratio", "95 % interval", "of means", "geom.", "uniform", "lift", "not finite"]
    header += [f"{group} %" for group in groups]
    body = []
    for row in rows.iter_rows(named=True):
        cells = [Cell(str(row["task_id"]), row["task_id"])]
        cells += [text_cell(row["suite"])] if several else []
        cells += [
            text_cell(row["instruction"]),
            Cell(str(row["num_episodes"]), row["num_episodes"]),
            percent_cell(row["success_rate"]),
        ]
        if grouping.ratio is not None:
            cells += [number_cell(row["ratio_mean"]), interval_cell(row["ratio_mean_low"], row["ratio_mean_high"])]
            cells += [
                number_cell(row[name]) for name in ("ratio_of_means", "geometric_mean", "uniform_ratio", "ratio_lift")
            ]
            cells.append(Cell(str(row["num_nonfinite"]), row["num_nonfinite"]))
        cells += [percent_cell(of_group[row["suite"], row["task_id"], group]["fraction"]) for group in groups]
        body.append(cells)
    shown = "mean over layers" if layer == LAYERS_AVG else f"layer {layer}"
    content = table(
        f"Tasks ({shown}). Per cent of a group: its fraction of all attention. The interval's column sorts by width.",
        header,
        body,
    )
    if grouping.ratio is not None:
        best = rows.filter(pl.col("ratio_mean").is_not_null()).sort("ratio_mean")
        spread = ""
        if best.height:
            low, high = best.row(0, named=True), best.row(-1, named=True)
            spread = (
                f" Lowest: task {low['task_id']} with {format_number(low['ratio_mean'])}; highest: task "
                f"{high['task_id']} with "
                f"{format_number(high['ratio_mean'])}."
            )
        content = (
            drawn(
                lambda where: plot_ratio_per_task(analysis.episodes.cells, analysis.tasks.cells, grouping, where),
                folder,
                f"Mean ratio of every task with its interval, single episodes, and the uniform baseline.{spread}",
                "Ratio per task: mean over episodes with its bootstrap interval, single episodes as dots, uniform "
                "attention dashed.",
            )
            + content
        )
    return Section("tasks", "Tasks", content)


def layer_section(analysis: Analysis, folder: Path, more: Sequence[str] = ()) -> Section:
    """A row per layer, and how ratios and fractions differ between layers. `more`: further figures."""
    grouping = analysis.grouping
    rows = overall_rows(analysis.tasks).cells
    groups = _present(analysis)
    parts = []
    if grouping.ratio is not None:
        parts.append(
            drawn(
                lambda where: plot_ratio_distribution(analysis.replans.cells, grouping, where),
                folder,
                f"Histogram of the ratio over replans, and a box for each of {rows.height} layers or averages "
                f"over episodes.",
                "How the ratio is spread over replans, and over episodes in every layer.",
            )
        )
    parts += more
    parts.append(
        drawn(
            lambda where: plot_attention_fractions(analysis.tasks, grouping, where),
            folder,
            "Stacked bars of every group's fraction in each layer: " + _fractions_in_words(analysis),
            "Fractions of all groups per layer, means over episodes.",
        )
    )
    parts += _layer_tables(analysis, groups)
    return Section("layers", "Layers and groups", "".join(parts))


def _layer_tables(analysis: Analysis, groups: Sequence[str]) -> list[str]:
    """Ratios of the layers, then fractions and lifts of the groups: two tables, because one would be too wide."""
    level = overall_rows(analysis.tasks)
    rows, of_group = level.cells, level.by_group("layer")
    by_layer = {row["layer"]: row for row in rows.iter_rows(named=True)}
    ratios, shares = [], []
    for layer in layer_order(rows):
        row = by_layer[layer]
        name = [Cell(layer, row["layer_number"])]
        if row["block"] is not None and str(row["block"]) != layer:
            name = [Cell(f"{layer} (block {row['block']})", row["layer_number"])]
        if analysis.grouping.ratio is not None:
            columns = ("ratio_median", "ratio_of_means", "geometric_mean", "uniform_ratio", "ratio_lift")
            bounds = interval_cell(row["ratio_mean_low"], row["ratio_mean_high"])
            numbers = [number_cell(row[column]) for column in columns]
            ratios.append(
                [
                    *name,
                    number_cell(row["ratio_mean"]),
                    bounds,
                    *numbers,
                    Cell(str(row["num_nonfinite"]), row["num_nonfinite"]),
                ]
            )
        fractions = [percent_cell(of_group[layer, group]["fraction"]) for group in groups]
        shares.append([*name, *fractions, *(number_cell(of_group[layer, group]["lift"]) for group in groups)])
    tables = []
    if ratios:
        header = [
            "layer",
            "mean ratio",
            "95 % interval",
            "median",
            "of means",
            "geom.",
            "uniform",
            "lift",
            "not finite",
        ]
        tables.append(table("Ratio per layer", header, ratios))
    header = ["layer", *(f"{group} %" for group in groups), *(f"{group} lift" for group in groups)]
    caption = "Groups per layer. Per cent: fraction of the groups' summed mass; lift: mass per key against the mean over valid keys"
    return [*tables, table(caption, header, shares)]


def _fractions_in_words(analysis: Analysis) -> str:
    level = overall_rows(analysis.tasks)
    layer = overall_layer(level.cells)
    of_group = level.by_group("layer")
    return (
        ", ".join(
            f"{group} {100 * (of_group[layer, group]['fraction'] or 0):.0f} %" for group in _present(analysis)[:8]
        )
        + " over all layers."
    )


def _present(analysis: Analysis) -> list[str]:
    """Groups that have keys here."""
    return list(overall_rows(analysis.tasks).groups_with_keys())


def contribution_section(contributions: pl.DataFrame | None, seed: int) -> Section | None:
    """Norms of what seeing and reading add to the residual stream, a row per layer; None when they were not recorded."""
    if contributions is None:
        return None
    note = (
        "A mass says how much attention keys get; a norm says how long the vector is that they add to the residual "
        "stream (value-weighted, through "
        "output projection and gate; root mean square over action queries, mean over replans and denoise steps). A "
        "sink has a large mass and may have "
        "a small norm. Unlike masses, norms of different sites may be divided by each other."
    )
    rows = [
        [
            Cell(row["layer"], row["layer_number"]),
            number_cell(row["visual_norm"]),
            number_cell(row["linguistic_norm"]),
            number_cell(row["ratio"]),
            interval_cell(row["ratio_low"], row["ratio_high"]),
        ]
        for row in contribution_rows(contributions, seed).iter_rows(named=True)
    ]
    header = ["layer", "visual norm", "linguistic norm", "ratio", "95 % interval"]
    caption = "Norms of contributions; ratio: mean over episodes of the mean ratio of norms"
    return Section("contributions", "Contributions", paragraph(note) + table(caption, header, rows))


def run_section(analysis: Analysis) -> Section:
    """Where everything comes from: stores, policy, protocol, recording, and what was asked."""
    question = analysis.question
    parts = []
    for store in question.stores:
        root = store.attributes
        policy, protocol, recording = root.policy, root.protocol, root.recording
        bits = "exact" if recording.mantissa_bits >= FLOAT32_MANTISSA_BITS else f"{recording.mantissa_bits} bits"
        libraries = [f"{name} {version}" for name, version in root.provenance.items() if name != "code"]
        cameras = [
            f"{view.name} from {view.source}{'' if view.upright else ', upside down'}{', mirrored' if view.mirrored else ''}"
            f"{'' if view.visible == 1 else f', middle {view.visible:.0%} of its side'}"
            for view in policy.cameras
        ]
        items = [
            ("store", f"<code>{text(store.path)}</code> with {len(store.episodes)} episodes"),
            ("suite", text(protocol.suite)),
            (
                "policy",
                f"{text(policy.name)} (family "
                f"{text(policy.family)}){', <strong>untrained weights</strong>' if policy.untrained else ''}",
            ),
            ("checkpoint", f"{text(policy.checkpoint)} ({text(policy.checkpoint_format)})"),
            ("digest of the weights", f"<code>{text(policy.digest)}</code>"),
            ("computed in", text(policy.config.get("dtype", "not stated"))),
            ("code version at capture", text(root.provenance.get("code", "not stated"))),
            ("libraries and machine", text(", ".join(libraries) or "not stated")),
            (
                "protocol",
                text(
                    f"seed {protocol.seed}, {protocol.wait_steps} waiting steps, a replan every "
                    f"{protocol.replan_steps} steps, at most "
                    f"{protocol.max_steps} steps"
                ),
            ),
            (
                "recording",
                text(
                    f"layers {listing(recording.layer_labels, 40)}; denoise steps "
                    f"{listing(recording.denoise_steps, 40)}; {len(recording.heads)} heads; queries: "
                    f"{recording.queries} of {recording.num_action_queries}; rows {bits}; frames "
                    f"{'stored' if recording.frames else 'not stored'}; contributions "
                    f"{'recorded' if recording.contributions else 'not recorded'}"
                ),
            ),
            ("cameras", text("; ".join(cameras) or "none")),
        ]
        parts.append(listed(items))
        parts.append(
            f"<details><summary>Configuration of the policy</summary>{listed(_flat(to_json(policy.config)))}</details>"
        )
    selection, settings, grouping = question.selection, question.settings, analysis.grouping
    ratio = (
        "none"
        if grouping.ratio is None
        else " / ".join(" + ".join(side) for side in (grouping.ratio.numerator, grouping.ratio.denominator))
    )
    asked = [
        ("site", text(question.site)),
        ("layers", text(listing(selection.layer_labels, 40))),
        ("denoise steps", text(listing(selection.denoise_steps, 40))),
        ("heads", text(describe_heads(selection, question.stores[0].attributes.policy.num_heads))),
        ("tasks", text("all" if settings.tasks is None else listing(settings.tasks, 40))),
        ("grouping", text(f"{grouping.name}: {grouping.description}" if grouping.description else grouping.name)),
        *(
            (f"group {name}", f"<code>{text(' | '.join(selectors))}</code>")
            for name, selectors in grouping.groups.items()
        ),
        ("ratio", text(ratio)),
        ("bootstrap", text(f"{DEFAULT_RESAMPLES} resamples, seed {settings.seed}")),
    ]
    return Section("run", "What was run, and what was asked", f"{''.join(parts)}<h3>Asked of it</h3>{listed(asked)}")


def _flat(value: object, name: str = "") -> list[tuple[str, str]]:
    """Nested configuration as (dotted name, value) pairs."""
    if isinstance(value, dict):
        return [pair for key, part in value.items() for pair in _flat(part, f"{name}.{key}" if name else str(key))]
    return [(name, text(value))]


def method_section() -> Section:
    """Formulas and what they mean."""
    return Section(
        "methods",
        "How it is computed",
        resources.files("vla_attention.analyze.report").joinpath("methods.html").read_text(encoding="utf-8"),
    )
