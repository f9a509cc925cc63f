"""The whole page: sections in order, style and script inside it."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from importlib import metadata, resources
from pathlib import Path
from string import Template

import polars as pl

from vla_attention.analyze.measures.aggregate import overall_layer, overall_rows
from vla_attention.analyze.measures.sinks import merged_sinks, sinks_table
from vla_attention.analyze.ratios.analysis import Analysis
from vla_attention.analyze.report.caveats import Caveat, caveats, role_shares
from vla_attention.analyze.report.markup import text
from vla_attention.analyze.report.overlay_section import overlay_section
from vla_attention.analyze.report.question_sections import (
    layer_figures,
    object_section,
    sink_section,
    time_section,
    word_section,
)
from vla_attention.analyze.report.sections import (
    Section,
    caveat_section,
    contribution_section,
    headline,
    layer_section,
    method_section,
    run_section,
    task_section,
)
from vla_attention.analyze.show.numbers import plural
from vla_attention.analyze.show.progress import progress_bar

DEFAULT_EPISODES, DEFAULT_REPLANS = 4, 24


def report_html(
    analysis: Analysis, episodes: int = DEFAULT_EPISODES, replans: int = DEFAULT_REPLANS, rows: bool = True
) -> str:
    """One self-contained HTML page on an analysis. The same analysis gives the same page, to the byte.

    `episodes`: how many episodes have overlays; `replans`: how many replans of each, at most; `rows`: also what
    needs every row to be read once or more: sinks, words and objects.
    """
    question = analysis.question
    sinks = merged_sinks(sinks_table(question)) if rows else None
    notes = caveats(analysis, role_shares(question), sinks)
    found = []
    with tempfile.TemporaryDirectory() as folder:
        parts = _parts(analysis, notes, sinks, Path(folder), episodes, replans)
        with progress_bar(len(parts), "sections") as advance:
            for make in parts:
                section = make()
                advance(1)
                if section is not None:
                    found.append(section)
    return assemble(analysis, found)


def _parts(
    analysis: Analysis,
    notes: Sequence[Caveat],
    sinks: pl.DataFrame | None,
    folder: Path,
    episodes: int,
    replans: int,
) -> list[Callable[[], Section | None]]:
    """What makes each section, in the page's order; a section that does not apply is None."""
    question = analysis.question
    parts: list[Callable[[], Section | None]] = [
        lambda: headline(analysis, notes),
        lambda: caveat_section(notes),
        lambda: task_section(analysis, folder),
        lambda: layer_section(analysis, folder, layer_figures(analysis, folder)),
        lambda: time_section(analysis, folder),
    ]
    if sinks is not None:
        parts += [
            lambda: sink_section(sinks),
            lambda: word_section(question, folder),
            lambda: object_section(question, folder),
        ]
    return [
        *parts,
        lambda: contribution_section(analysis.contributions, question.settings.seed),
        lambda: overlay_section(question, analysis.replans.cells, episodes, replans),
        lambda: run_section(analysis),
        method_section,
    ]


def assemble(analysis: Analysis, sections: Sequence[Section]) -> str:
    """Put sections into the page's frame."""
    stores = analysis.question.stores
    policy = stores[0].attributes.policy
    suites = ", ".join(dict.fromkeys(store.suite for store in stores))
    row = overall_rows(analysis.tasks).cells.filter(layer=overall_layer(analysis.tasks.cells)).row(0, named=True)
    untrained = " (untrained weights)" if policy.untrained else ""
    subtitle = (
        f"{plural(row['num_episodes'], 'episode')} of {plural(row['num_tasks'], 'task')}, "
        f"site {analysis.question.site}, grouping {analysis.grouping.name}{untrained}"
    )
    shown = "\n".join(
        f'<section id="{section.anchor}" aria-labelledby="{section.anchor}-heading"><h2 '
        f'id="{section.anchor}-heading">{text(section.heading)}</h2>'
        f"{section.content}</section>"
        for section in sections
    )
    navigation = "".join(f'<li><a href="#{section.anchor}">{text(section.heading)}</a></li>' for section in sections)
    return Template(_resource("page.html")).substitute(
        title=text(f"Attention of {policy.name} on {suites}"),
        subtitle=text(subtitle),
        version=text(_version()),
        navigation=navigation,
        sections=shown,
        style=_resource("style.css"),
        script=_resource("script.js"),
    )


def _resource(name: str) -> str:
    return resources.files("vla_attention.analyze.report").joinpath(name).read_text(encoding="utf-8")


def _version() -> str:
    try:
        return metadata.version("vla-attention")
    except metadata.PackageNotFoundError:
        return "(not installed)"
