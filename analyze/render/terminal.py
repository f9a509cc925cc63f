"""A result on a screen: what was run, the findings, then tables as far as they fit; what is left out is named."""

from __future__ import annotations

import shutil
import textwrap
from collections.abc import Collection, Iterable, Sequence

from vla_attention.analyze.core.result import Column, Result, Table
from vla_attention.analyze.render.numbers import cell

#: Columns and lines of a page of text, where there is no terminal.
WIDTH, LINES = 100, 40
#: On a terminal as much as it shows, between these columns and lines; wider lines are hard to read.
_WIDTHS, _HEIGHTS = (40, 120), (24, 60)
#: A table of which fewer rows would fit is left out.
_FEWEST_ROWS = 3
#: To so many characters the texts of a column are cut where a table is too wide, and which columns stay then.
_CUTS: tuple[tuple[int, tuple[str, ...]], ...] = ((24, ("text", "prose")), (20, ()), (10, ()))
#: Lines that name the tables that did not fit.
_NAMES_LEFT = 2
_NO_END = 1_000_000


def screen_size() -> tuple[int, int]:
    """Columns and lines of the terminal, in our limits; of a page of text where there is none."""
    given = shutil.get_terminal_size((WIDTH, LINES))
    width, lines = (
        min(max(number, least), most) for number, (least, most) in zip(given, (_WIDTHS, _HEIGHTS), strict=True)
    )
    return width, lines


def screen(result: Result, lines: int | None = None, last: Sequence[str] = ()) -> str:
    """At most so many lines of the terminal's width, unless about, findings and notes alone are more.

    lines: as many as the terminal has, if they are not given. last: lines that stand below everything, for instance
    where the files are.
    """
    width, height = screen_size()
    lines = height - 1 if lines is None else lines  # below it stands the prompt
    top = wrapped(result.about, width=width)
    for finding in result.findings:
        asks = f"{finding.asks} " if finding.asks else ""
        top += ["", *wrapped([f"{asks}{finding.sentence}"], width=width)]
        top += wrapped([finding.limit] if finding.limit else [], "  ", width)
        top += [f"  {finding.next_step}"] if finding.next_step else []  # to be copied: it is not wrapped
    below = wrapped((f"note: {note}" for note in result.notes), width=width)
    end = wrapped(last, width=width)
    room = lines - _NAMES_LEFT - sum(len(part) + 1 for part in (top, below, end) if part)
    room = _NO_END if result.whole else room
    tables: list[list[str]] = []
    left, said = [], set[str]()
    for table in (one for one in result.tables if one.columns):
        rows = table.shown
        if rows.is_empty():
            continue
        legend = wrapped(_legend(table, said, width), "  ", width)
        head = 1 + bool(table.title) + len(legend)
        fit = min(table.rows, rows.height, room - head - 2 if rows.height > room - head - 1 else rows.height)
        if fit < min(_FEWEST_ROWS, rows.height):
            left.append(table.title or table.name)
            continue
        block = [*([table.title] if table.title else []), *_laid_out(table, fit, width)]
        shown, (all_titles, *_), _ = _fitting(table, fit, width)
        more = [f"{rows.height - fit} more rows"] * (rows.height > fit)
        more += [f"columns {', '.join(all_titles[len(shown) :])}"] * (len(all_titles) > len(shown))
        block += wrapped([f"... {' and '.join(more)} in {table.of or table.name}"] if more else [], width=width)
        block += legend
        said |= {column.meaning for column in shown}
        tables.append(block)
        room -= len(block) + 1
    also = wrapped([f"Also in the files: {'; '.join(left)}."] if left else [], width=width)
    return "\n\n".join("\n".join(part) for part in (top, *tables, [*below, *also], end) if part)


def table_text(table: Table) -> str:
    """All rows of a table, with what its columns mean."""
    head = [table.title] if table.title else []
    return "\n".join([*head, *_laid_out(table, table.shown.height, WIDTH), *wrapped(_legend(table, (), WIDTH), "  ")])


def wrapped(texts: Iterable[str], first: str = "", width: int = WIDTH) -> list[str]:
    """Each text in lines of at most so many columns; `first` indents its first line, and the others by two more."""
    return [
        line
        for text in texts
        for line in textwrap.wrap(
            text, width, initial_indent=first, subsequent_indent=f"{first}  ", break_long_words=False,
            break_on_hyphens=False,
        )
    ]  # fmt: skip


def _legend(table: Table, said: Collection[str], width: int) -> list[str]:
    """What the columns mean that a terminal shows, but for what was said below an earlier table."""
    columns, _, _ = _fitting(table, table.rows, width)
    parts = [f"{one.title}: {one.meaning}" for one in columns if one.meaning not in ("", *said)]
    return [f"{'. '.join(parts)}."] if parts else []


def _fitting(table: Table, rows: int, width: int) -> tuple[list[Column], list[list[str]], list[int]]:
    """The columns that fit; the cells of all columns in the first rows, under their titles; the widths of those."""
    columns = [column for column in table.columns if column.screen]
    cells = [[column.title for column in columns]]
    cells += [[cell(row, column) for column in columns] for row in table.shown.head(rows).iter_rows(named=True)]
    widths = [max(len(row[i]) for row in cells) for i in range(len(columns))]
    if columns[-1].kind == "prose":
        widths[-1] = max(20, width - sum(widths[:-1]) - 2 * (len(widths) - 1))

    def too_wide() -> bool:
        return sum(widths) + 2 * (len(widths) - 1) > width

    # The longest texts are cut first; then the last columns give way: of numbers, later any.
    texts = [i for i, column in enumerate(columns) if column.kind == "text"]
    for shortest, kept in _CUTS:
        while too_wide() and texts and max(widths[i] for i in texts) > shortest:
            widths[max(texts, key=lambda i: widths[i])] -= 1
        while too_wide() and len(widths) > 2 and columns[-1].kind not in kept:
            columns, widths = columns[:-1], widths[:-1]
            texts = [i for i in texts if i < len(columns)]
    return columns, cells, widths


def _laid_out(table: Table, rows: int, width: int) -> list[str]:
    """The header and the first rows, aligned; numbers to the right. The last columns give way to the width."""
    columns, cells, widths = _fitting(table, rows, width)
    rest = max(20, width - sum(widths[:-1]) - 2 * (len(widths) - 1))
    if columns[-1].kind == "text":  # what runs over is cut: the files have it whole
        widths[-1] = min(widths[-1], rest)
    lines = []
    for row in cells:
        last = textwrap.wrap(row[len(columns) - 1], rest) if columns[-1].kind == "prose" else [row[len(columns) - 1]]
        parts = [
            shortened(text, wide).ljust(wide) if column.kind in ("text", "prose") else text.rjust(wide)
            for text, wide, column in zip([*row[: len(columns) - 1], (last or [""])[0]], widths, columns, strict=True)
        ]
        lines.append("  ".join(parts).rstrip())
        lines += [" " * (sum(widths[:-1]) + 2 * (len(widths) - 1)) + line for line in last[1:]]
    return lines


def shortened(name: str, width: int) -> str:
    """A name that must not be broken at spaces, in at most so many characters, with … where its middle was cut."""
    end = (width - 1) // 2
    return name if len(name) <= width else f"{name[: width - 1 - end]}…{name[len(name) - end :]}"
