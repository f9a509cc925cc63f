"""Small builders of HTML. Everything that is not markup goes through `text`, so nothing from a store can become markup."""

from __future__ import annotations

import base64
import html
import math
from collections.abc import Sequence
from dataclasses import dataclass

from vla_attention.analyze.show.numbers import format_interval, format_number


def text(value: object) -> str:
    """Any value as text inside HTML or inside a quoted attribute."""
    return html.escape(str(value), quote=True)


def paragraph(sentence: str, kind: str = "") -> str:
    """A sentence as a paragraph; `kind` is its class."""
    return f"<p{attribute('class', kind)}>{text(sentence)}</p>"


def attribute(name: str, value: str) -> str:
    """` name="value"`, or nothing without a value."""
    return f' {name}="{text(value)}"' if value else ""


def data_uri(content: bytes, kind: str) -> str:
    """A file as an address that needs no network."""
    return f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"


def listed(items: Sequence[tuple[str, str]]) -> str:
    """Names and what they are, as a definition list; values may hold markup."""
    rows = "".join(f"<div><dt>{text(name)}</dt><dd>{value}</dd></div>" for name, value in items)
    return f"<dl>{rows}</dl>"


@dataclass(frozen=True)
class Cell:
    """One cell of a table: what is shown, and by what it sorts (None: after everything else, in either direction)."""

    shown: str
    key: float | str | None
    css: str = "number"


def number_cell(value: float | None) -> Cell:
    """A number, or - for none."""
    missing = value is None or math.isnan(value)
    return Cell(format_number(value), None if missing else value)


def interval_cell(low: float | None, high: float | None) -> Cell:
    """An interval; sorts by its width."""
    return Cell(format_interval(low, high), None if low is None or high is None else high - low)


def percent_cell(value: float | None) -> Cell:
    """A share, in per cent."""
    missing = value is None or math.isnan(value)
    return Cell("-" if missing else f"{100 * value:.1f}", None if missing else value)  # type: ignore[operator]


def text_cell(value: str) -> Cell:
    """Words."""
    return Cell(value, value, "words")


def table(caption: str, header: Sequence[str], rows: Sequence[Sequence[Cell]], sortable: bool = True) -> str:
    """A table that scrolls on its own where the page is narrow; its columns sort by a click on their headers.

    The first column names the row. Header buttons are the script's: without it the table is plain.
    """
    # A header stands over its column as its cells do.
    kinds = [cell.css for cell in rows[0]] if rows else ["number"] * len(header)
    head = "".join(
        f'<th scope="col" class="{kind}">{text(name)}</th>' for name, kind in zip(header, kinds, strict=True)
    )
    body = []
    for row in rows:
        cells = []
        for i, cell in enumerate(row):
            name = 'th scope="row"' if i == 0 else "td"
            key = "" if cell.key is None else repr(cell.key) if isinstance(cell.key, float) else str(cell.key)
            cells.append(f'<{name} class="{cell.css}" data-key="{text(key)}">{text(cell.shown)}</{name.split()[0]}>')
        body.append(f"<tr>{''.join(cells)}</tr>")
    return (
        f'<div class="scroll" role="region" tabindex="0" '
        f'aria-label="{text(caption)}"><table{attribute("class", "sortable" * sortable)}>'
        f"<caption><span>{text(caption)}</span></caption><thead><tr>{head}</tr></thead><tbody>{''.join(body)}</tbody></table></div>"
    )
