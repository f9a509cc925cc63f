"""Sections on masses, ratios and contributions: tasks, layers and groups, contributions."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import polars as pl

from vla_attention.analyze.heads.layer_time import layer_time_table
from vla_attention.analyze.heads.plot_layer_time import plot_layer_time
from vla_attention.analyze.measures.aggregate import overall_rows
from vla_attention.analyze.measures.frames import layer_name
from vla_attention.analyze.ratios.analysis import Analysis
from vla_attention.analyze.ratios.contribution_text import contributions_table
from vla_attention.analyze.ratios.plot_attention_fractions import plot_attention_fractions
from vla_attention.analyze.ratios.plot_layer_profile import plot_layer_profile
from vla_attention.analyze.ratios.plot_ratio_distribution import plot_ratio_distribution
from vla_attention.analyze.ratios.plot_ratio_per_task import plot_ratio_per_task
from vla_attention.analyze.ratios.summary_text import across_table, layer_groups_table, layer_table
from vla_attention.analyze.report.pictures import Diagram, drawn
from vla_attention.analyze.report.section_parts import PageTable, Paragraph, Part, Section
from vla_attention.analyze.show.numbers import format_number, format_percent

#: Groups with a column of their own in the table of tasks: beside a ratio, and alone.
_GROUPS_BESIDE_RATIO, _GROUPS_ALONE = 2, 6


def task_section(analysis: Analysis, folder: Path) -> Section:
    """A row per task, and the picture of ratios per task."""
    ratio, layer = analysis.grouping.ratio, analysis.overall["layer"]
    chosen = analysis.tasks.filter((pl.col("scope") == "task") & (pl.col("layer") == layer))
    several = chosen.cells["suite"].n_unique() > 1
    groups = analysis.present_groups[: _GROUPS_ALONE if ratio is None else _GROUPS_BESIDE_RATIO]
    table = across_table(analysis.grouping, chosen, several_suites=several, on_page=groups)
    caption = (
        f"Tasks ({layer_name(layer)}). Per cent of a group: its fraction of all attention. The interval's column sorts "
        "by width."
    )
    parts: list[Part] = [PageTable(replace(table, caption=caption))]
    if ratio is not None:
        parts.insert(0, _tasks_diagram(analysis, chosen.cells, folder))
    return Section("tasks", "Tasks", parts)


def _tasks_diagram(analysis: Analysis, tasks: pl.DataFrame, folder: Path) -> Diagram:
    known = tasks.filter(pl.col("geometric_mean").is_not_null()).sort("geometric_mean").rows(named=True)
    ends = [f"{format_number(row['geometric_mean'])} (task {row['task_id']})" for row in (*known[:1], *known[-1:])]
    extremes = f" The estimates run from {' to '.join(ends)}." if ends else ""
    return drawn(
        lambda where: plot_ratio_per_task(analysis.episodes.cells, analysis.tasks.cells, analysis.grouping, where),
        folder,
        f"Geometric mean ratio of every task with its interval, single episodes, and the uniform baseline.{extremes}",
        "Ratio per task: geometric mean with its interval, single episodes as dots, uniform attention dashed.",
    )


def layer_section(analysis: Analysis, folder: Path) -> Section:
    """A row per layer, and how ratios and fractions differ between layers."""
    grouping, rows = analysis.grouping, overall_rows(analysis.tasks).cells
    parts: list[Part] = []
    if grouping.ratio is not None:
        parts.append(
            drawn(
                lambda where: plot_ratio_distribution(analysis.replans.cells, grouping, where),
                folder,
                f"Histogram of the ratio over replans, and a box for each of {rows.height} layers or averages over "
                "episodes.",
                "How the ratio is spread over replans, and over episodes in every layer.",
            )
        )
    if len(set(analysis.question.selection.blocks)) > 1:
        parts += _layer_diagrams(analysis, folder)
    shares = [
        f"{group} {format_percent(analysis.overall_groups[group]['fraction'] or 0, 0)}"
        for group in analysis.present_groups[:8]
    ]
    parts.append(
        drawn(
            lambda where: plot_attention_fractions(analysis.tasks, grouping, where),
            folder,
            f"Stacked bars of every group's fraction in each layer: {', '.join(shares)} over all layers.",
            "Fractions of all groups per layer, means over episodes.",
        )
    )
    # Two tables, because one would be too wide.
    if grouping.ratio is not None:
        parts.append(PageTable(layer_table(grouping, analysis.tasks, analysis.question.untrained)))
    parts.append(PageTable(layer_groups_table(overall_rows(analysis.tasks), analysis.present_groups)))
    return Section("layers", "Layers and groups", parts)


def _layer_diagrams(analysis: Analysis, folder: Path) -> list[Diagram]:
    """Layer profile, and layers over time."""
    grouping = analysis.grouping
    what = "fractions" if grouping.ratio is None else "ratio"
    extremes = ""
    time = layer_time_table(analysis.replans, grouping, analysis.question.sampling)
    if grouping.ratio is not None:
        known = time.filter(pl.col("mean").is_not_null()).sort("mean")["layer"].to_list()
        extremes = f" The estimates run from layer {known[0]} to layer {known[-1]}." if known else ""
    return [
        drawn(
            lambda where: plot_layer_profile(analysis.tasks, grouping, where),
            folder,
            f"Lines of the {what} over the layers with intervals.",
            "Every layer with its interval.",
        ),
        drawn(
            lambda where: plot_layer_time(time, analysis.replans, grouping, where),
            folder,
            f"A map of the {what} with layers from bottom to top and the episodes' time from left to right.{extremes}",
            "Layers over the course of the episodes, from the first replan (0) to the end (1).",
        ),
    ]


def contribution_section(analysis: Analysis) -> Section | None:
    """What the image keys and the text keys add to the residual stream; None when it was not recorded."""
    if analysis.contribution_rows is None:
        return None
    note = (
        "A mass is how much attention keys get; a norm is the length of the vector that they add to the residual "
        "stream (value-weighted, through output projection and gate; root mean square over action queries, mean over "
        "replans and denoise steps). A sink has a large mass and may have a small norm. Unlike masses, norms of "
        "different sites may be divided by each other."
    )
    return Section(
        "contributions", "Contributions", [Paragraph(note), PageTable(contributions_table(analysis.contribution_rows))]
    )
