"""The whole page: its sections in order, put into the templates of `templates/`."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import ClassVar

import jinja2

from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.measures.sinks import SinkSearch, search_sinks
from vla_attention.analyze.measures.steps import role_masses
from vla_attention.analyze.ratios.analysis import Analysis, analyse
from vla_attention.analyze.report.caveats import Caveat, caveat_section, caveats
from vla_attention.analyze.report.headline import headline_section
from vla_attention.analyze.report.overlay_section import overlay_section
from vla_attention.analyze.report.question_sections import (
    deviation_section,
    effect_section,
    object_section,
    sink_section,
    time_section,
    word_section,
)
from vla_attention.analyze.report.ratio_sections import contribution_section, layer_section, task_section
from vla_attention.analyze.report.report_settings import ReportSettings
from vla_attention.analyze.report.run_section import run_section
from vla_attention.analyze.report.section_parts import Section
from vla_attention.analyze.show.numbers import of_tasks
from vla_attention.analyze.show.output_files import write_text, writing
from vla_attention.analyze.statistics.intervals import DEFAULT_LEVEL
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.progress_bar import progress_bar
from vla_attention.schemas.safe_text import visible

#: Endings of a file's name that make it a page.
_ENDINGS = (".html", ".htm")


@dataclass(frozen=True)
class Methods:
    """How everything on the page is computed. `level`: of all intervals; `about`: what they are about."""

    template: ClassVar[str] = "methods.html"
    level: str
    about: str


def report_file(path: Path) -> Path:
    """The file of a report: `path` if it ends with .html or .htm, else `report.html` in the folder `path`.

    Raises:
        BadArgument: `path` is a file of another kind.
    """
    if path.is_file() and path.suffix.lower() not in _ENDINGS:
        raise BadArgument(f"Cannot write the report to the file {path}; expected a folder, or a file FILE.html.")
    return path if path.suffix.lower() in _ENDINGS and not path.is_dir() else path / "report.html"


def write_report(question: Question, path: Path, settings: ReportSettings) -> None:
    """Analyse and write the page of `report_html`, atomically.

    Raises:
        BadArgument: the file cannot be written.
    """
    page = report_html(analyse(question), settings)
    with writing("the report", path, "another path"):
        write_text(path, page)


def report_html(analysis: Analysis, settings: ReportSettings) -> str:
    """One self-contained HTML page on an analysis. The same analysis gives the same page, to the byte."""
    question = analysis.question
    search = search_sinks(question) if settings.rows else None
    notes = caveats(analysis, role_masses(question), None if search is None else search.sinks)
    sections = []
    with tempfile.TemporaryDirectory() as folder:
        makers = _section_makers(analysis, notes, search, Path(folder), settings)
        with progress_bar(len(makers), "sections") as advance:
            for make in makers:
                section = make()
                advance(1)
                if section is not None:
                    sections.append(section)
    return render(analysis, sections)


def _section_makers(
    analysis: Analysis,
    notes: Sequence[Caveat],
    search: SinkSearch | None,
    folder: Path,
    settings: ReportSettings,
) -> list[Callable[[], Section | None]]:
    """A function per section, in the page's order. It returns None for a section that does not apply."""
    question = analysis.question
    makers: list[Callable[[], Section | None]] = [
        lambda: headline_section(analysis, notes),
        lambda: caveat_section(notes),
        lambda: effect_section(analysis, settings.reruns, folder),
        lambda: deviation_section(analysis, folder),
        lambda: task_section(analysis, folder),
        lambda: layer_section(analysis, folder),
        lambda: time_section(analysis, folder),
    ]
    if search is not None:
        makers += [
            lambda: sink_section(search),
            lambda: word_section(question),
            lambda: object_section(question),
        ]
    return [
        *makers,
        lambda: contribution_section(analysis),
        lambda: overlay_section(question, analysis.replans.cells, settings),
        lambda: run_section(analysis),
        lambda: Section("methods", "How it is computed", [Methods(f"{100 * DEFAULT_LEVEL:g}%", question.units.words)]),
    ]


def render(analysis: Analysis, sections: Sequence[Section]) -> str:
    """The sections in the page's frame."""
    stores = analysis.question.stores
    policy, row = stores[0].attributes.policy, analysis.overall
    suites = ", ".join(dict.fromkeys(store.suite for store in stores))
    untrained = " (untrained weights)" if policy.untrained else ""
    return (
        templates()
        .get_template("page.html")
        .render(
            title=f"Attention of {policy.name} on {suites}",
            subtitle=f"{of_tasks(row['num_episodes'], row['num_tasks'])}, site {analysis.question.site}, grouping "
            f"{analysis.grouping.name}{untrained}",
            version=_version(),
            sections=sections,
        )
    )


def templates() -> jinja2.Environment:
    """The folder `templates/`. Every text is escaped and `visible`; an unknown name in a template is an error."""
    return jinja2.Environment(
        loader=jinja2.PackageLoader("vla_attention.analyze.report"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        finalize=lambda value: visible(value) if type(value) is str else value,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def _version() -> str:
    try:
        return metadata.version("vla-attention")
    except metadata.PackageNotFoundError:
        return "(not installed)"
