"""The last section: formulas and what they mean. Its text is `templates/methods.html`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from vla_attention.analyze.report.section_parts import Section
from vla_attention.analyze.statistics.intervals import DEFAULT_LEVEL, Estimand


@dataclass(frozen=True)
class Methods:
    """`level`: of all intervals on the page; `about`: their estimand."""

    template: ClassVar[str] = "methods.html"
    level: str
    about: str


def method_section(estimand: Estimand) -> Section:
    """How everything on the page is computed."""
    return Section("methods", "How it is computed", [Methods(f"{100 * DEFAULT_LEVEL:g}%", estimand.words)])
