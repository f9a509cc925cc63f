"""The parts of a section, as plain data. Each kind of part names the template in `templates/` that shows it.

The templates escape every text, so nothing from a store can become markup.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Protocol

from markupsafe import Markup

from vla_attention.analyze.core.result import Result
from vla_attention.analyze.render.page import fragment
from vla_attention.analyze.show.tables import Cell, Table


class Part(Protocol):
    """What a section holds: data for the template `template`, which finds it under the name `part`."""

    template: ClassVar[str]


@dataclass(frozen=True)
class Section:
    """A part of the page with a heading. `anchor` is its address inside the page."""

    anchor: str
    heading: str
    parts: Sequence[Part]


@dataclass(frozen=True)
class Paragraph:
    """Running text; `quiet` text is small and grey."""

    template: ClassVar[str] = "paragraph.html"
    text: str
    quiet: bool = False


@dataclass(frozen=True)
class ResultPart:
    """A question's whole result."""

    template: ClassVar[str] = "result_part.html"
    result: Result

    @property
    def html(self) -> Markup:
        """It as HTML, every text escaped."""
        return Markup(fragment(replace(self.result, about=())))  # noqa: S704 - the templates of results escape


@dataclass(frozen=True)
class Item:
    """A name and its value; a `code` value is shown in a typewriter font."""

    name: str
    value: object
    code: bool = False


@dataclass(frozen=True)
class Definitions:
    """Names with their values. With a `summary` the list is folded under that line; `heading` stands above it."""

    template: ClassVar[str] = "definitions.html"
    items: Sequence[Item]
    summary: str = ""
    heading: str = ""


@dataclass(frozen=True)
class PageTable:
    """A table whose columns sort by a click on their headers. The first cell of a row is its name."""

    template: ClassVar[str] = "table.html"
    table: Table

    @property
    def caption(self) -> str:
        """What stands above it."""
        return self.table.caption

    @property
    def header(self) -> list[str]:
        """The columns' names."""
        return [column.page for column in self.table.columns if column.page is not None]

    @property
    def rows(self) -> list[list[Cell]]:
        """The cells of every row."""
        columns = [column for column in self.table.columns if column.page is not None]
        return [[column.cell(row) for column in columns] for row in self.table.rows]

    @property
    def kinds(self) -> list[str]:
        """The kind of cells in every column: headers are aligned as their cells are."""
        rows = self.rows
        return [cell.kind for cell in rows[0]] if rows else ["number"] * len(self.header)
