"""The last section: formulas and what they mean. Its text is `templates/methods.html`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from vla_attention.analyze.report.section_parts import Section
from vla_attention.analyze.statistics.intervals import DEFAULT_LEVEL
from vla_attention.analyze.statistics.units import Units


@dataclass(frozen=True)
class Methods:
    """`level`: of all intervals on the page; `about`: what they are about."""

    template: ClassVar[str] = "methods.html"
    level: str
    about: str


def method_section(units: Units) -> Section:
    """How everything on the page is computed."""
    return Section("methods", "How it is computed", [Methods(f"{100 * DEFAULT_LEVEL:g}%", units.words)])
