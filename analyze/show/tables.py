"""Tables as data: columns that say what they show of a row, and rows; as aligned text, or as cells of a page.

A column has a header for texts and one for the page, so that a table that stands in both is defined once. A unit stands
behind every value of a text, and in the header of a page.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from typing import Any

from vla_attention.analyze.show.headings import WIDTH
from vla_attention.analyze.show.numbers import (
    format_interval,
    format_number,
    format_percent,
    format_signed,
    interval_name,
)
from vla_attention.analyze.statistics.intervals import DEFAULT_LEVEL

#: The header of intervals where their level is said.
INTERVAL = interval_name(DEFAULT_LEVEL)
#: What a column shows of a row: a member, by its name, or a function of the row.
Shown = str | Callable[[Any], Any]


@dataclass(frozen=True)
class Cell:
    """One cell of a page. `sort_key` orders the rows; None sorts last in either direction."""

    text: str
    sort_key: float | str | None = None
    kind: str = "number"


@dataclass(frozen=True)
class Column:
    """What one column shows.

    Attributes:
        header: in a text; None where a text has no such column.
        text: a row's cell in a text; several lines make the row as high.
        cell: a row's cell on the page.
        page: header on the page; None where the page has no such column.
        left: whether a text has it aligned to the left.
        running: whether it is running text, which stands last in a text, wrapped into what is left of the width.
    """

    header: str | None
    text: Callable[[Any], str]
    cell: Callable[[Any], Cell]
    page: str | None = None
    left: bool = False
    running: bool = False


def number(header: str | None, shown: Shown, page: str | None = None) -> Column:
    """Numbers as `format_number`."""
    return _of_numbers(header, shown, format_number, page)


def signed(header: str, shown: Shown) -> Column:
    """Numbers with their sign, in texts."""
    return _of_numbers(header, shown, format_signed)


def count(header: str | None, shown: Shown, page: str | None = None, left: bool = False) -> Column:
    """Whole numbers."""
    return _of_numbers(header, shown, str, page, left)


def percent(header: str | None, shown: Shown, page: str | None = None, decimals: int = 1) -> Column:
    """Shares in per cent; on the page the sign is in the header."""
    value = _value(shown)

    def cell(row: Any) -> Cell:
        known = _known(value(row))
        return Cell("-" if known is None else f"{100 * known:.1f}", known)

    unit = None if page is None else f"{page} %"
    return Column(header, lambda row: format_percent(value(row), decimals), cell, unit)


def interval(
    name: str,
    page: str | None = None,
    header: str | None = "interval",
    of: Callable[[Any], Mapping[str, Any] | None] = lambda row: row,
    times: float = 1.0,
) -> Column:
    """The members NAME_low and NAME_high of a row, both multiplied by `times`. On the page it sorts by its width.

    of: where they are; without any there is no interval.
    """
    names = (f"{name}_low", f"{name}_high") if name else ("low", "high")

    def cell(row: Any) -> Cell:
        low, high = ((of(row) or {}).get(end) for end in names)
        if low is None or high is None:
            return Cell("-")
        return Cell(format_interval(times * low, times * high), times * (high - low))

    return Column(header, lambda row: cell(row).text, cell, page)


def estimate(header: str, name: str, page: str | None = None) -> tuple[Column, Column]:
    """The member NAME of a row, as `number`, and its `interval`."""
    return number(header, name, page), interval(name, None if page is None else INTERVAL)


def texts(header: str | None, shown: Shown, left: bool = False, running: bool = False) -> Column:
    """Cells of a text as they are."""
    return words(header, shown, None, left, running)


def words(
    header: str | None, shown: Shown, page: str | None = None, left: bool = True, running: bool = False
) -> Column:
    """Words, aligned to the left; nothing where there are none."""
    value = _value(shown)

    def text(row: Any) -> str:
        return value(row) or ""

    return Column(header, text, lambda row: Cell(text(row), text(row), "words"), page, left, running)


def _of_numbers(
    header: str | None, shown: Shown, show: Callable[[Any], str], page: str | None = None, left: bool = False
) -> Column:
    value = _value(shown)

    def cell(row: Any) -> Cell:
        return Cell(show(value(row)), _known(value(row)))

    return Column(header, lambda row: show(value(row)), cell, page, left)


def _value(shown: Shown) -> Callable[[Any], Any]:
    return shown if callable(shown) else lambda row: row[shown]


def _known(value: float | None) -> float | None:
    return None if value is None or math.isnan(value) else value


@dataclass(frozen=True)
class Table:
    """Columns and rows; `caption` stands above it on the page. A row is whatever its columns take."""

    columns: Sequence[Column]
    rows: Sequence[Any]
    caption: str = ""

    @property
    def can_be_cut(self) -> bool:
        """Whether its first rows alone may be shown: with running text, there are as many rows as there are texts."""
        return not any(column.running and column.header is not None for column in self.columns)

    def __str__(self) -> str:
        head, rows = self.laid_out()
        rule = "·" * max(map(len, [*head, *(line for row in rows for line in row)]))
        return "\n".join([*head, rule, *(line for row in rows for line in row)])

    def laid_out(self, width: int = WIDTH) -> tuple[list[str], list[list[str]]]:
        """Lines of the header, and of each row; only running text gives way to the width."""
        shown = [column for column in self.columns if column.header is not None]
        fixed = [column for column in shown if not column.running]
        header = [str(column.header) for column in fixed]
        cells = [[column.text(row) for column in fixed] for row in self.rows]
        widths = [max(len(part) for row in (header, *cells) for part in row[i].split("\n")) for i in range(len(fixed))]
        gap = "  " if sum(widths) + 2 * (len(widths) - 1) <= width else " "

        def lines_of(row: Sequence[str]) -> list[str]:
            parts = zip_longest(*(cell.split("\n") for cell in row), fillvalue="")
            return [
                gap.join(
                    cell.ljust(wide) if column.left else cell.rjust(wide)
                    for column, cell, wide in zip(fixed, part, widths, strict=True)
                ).rstrip()
                for part in parts
            ]

        head, body = lines_of(header), list(map(lines_of, cells))
        indent = sum(widths) + len(gap) * len(widths)
        for column in shown:
            if column.running:
                head[0] = head[0].ljust(indent) + str(column.header)
                for i, row in enumerate(self.rows):
                    beside = textwrap.wrap(column.text(row), max(20, width - indent))
                    pairs = zip_longest(body[i], beside, fillvalue="")
                    body[i] = [(cells.ljust(indent) + more).rstrip() for cells, more in pairs]
        return head, body
