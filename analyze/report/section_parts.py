"""The parts of a section, as plain data. Each kind of part names the template in `templates/` that shows it.

The templates escape every text, so nothing from a store can become markup.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Protocol

from vla_attention.analyze.show.numbers import format_interval, format_number


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
class Cell:
    """One cell of a table. `sort_key` orders the rows; None sorts last in either direction."""

    text: str
    sort_key: float | str | None
    kind: str = "number"


@dataclass(frozen=True)
class Table:
    """A table whose columns sort by a click on their headers. The first cell of a row is its name."""

    template: ClassVar[str] = "table.html"
    caption: str
    header: Sequence[str]
    rows: Sequence[Sequence[Cell]]

    @property
    def kinds(self) -> list[str]:
        """The kind of cells in every column: headers are aligned as their cells are."""
        return [cell.kind for cell in self.rows[0]] if self.rows else ["number"] * len(self.header)


def number_cell(value: float | None) -> Cell:
    """A number; - for none."""
    return Cell(format_number(value), _known(value))


def count_cell(value: int) -> Cell:
    """A whole number."""
    return Cell(str(value), value)


def percent_cell(share: float | None) -> Cell:
    """A share in per cent, without the sign: that is in the header."""
    known = _known(share)
    return Cell("-" if known is None else f"{100 * known:.1f}", known)


def interval_cell(low: float | None, high: float | None, times: float = 1.0) -> Cell:
    """An interval, both ends multiplied by `times`. It sorts by its width."""
    if low is None or high is None:
        return Cell(format_interval(None, None), None)
    return Cell(format_interval(times * low, times * high), times * (high - low))


def text_cell(text: str) -> Cell:
    """Words."""
    return Cell(text, text, "words")


def _known(value: float | None) -> float | None:
    return None if value is None or math.isnan(value) else value
