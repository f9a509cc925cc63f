"""Tables as plain aligned text."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from itertools import zip_longest
from typing import Any

from vla_attention.analyze.show.headings import WIDTH


def text_table(
    header: Sequence[str],
    rows: Sequence[Sequence[str]],
    left: Sequence[int] = (),
    last: str = "",
    texts: Sequence[str] | None = None,
    width: int = WIDTH,
) -> str:
    """Columns aligned to the right (those in `left` to the left), with a rule under the header.

    Args:
        header: column names.
        rows: cells, one sequence per row; a cell of several lines makes its row as high.
        left: numbers of the columns that are aligned to the left.
        last: header of one more column of running text, wrapped into what is left of the width.
        texts: that column's texts, one per row.
        width: width of the page; only the running text gives way.
    """
    widths = [max(len(part) for row in [header, *rows] for part in row[i].split("\n")) for i in range(len(header))]
    gap = "  " if sum(widths) + 2 * (len(widths) - 1) <= width else " "

    def line(cells: Sequence[str]) -> str:
        return gap.join(
            cell.ljust(widths[i]) if i in left else cell.rjust(widths[i]) for i, cell in enumerate(cells)
        ).rstrip()

    def lines_of(cells: Sequence[str]) -> list[str]:
        parts = zip_longest(*(cell.split("\n") for cell in cells), fillvalue="")
        return [line(part) for part in parts]

    if texts is None:
        head, body = lines_of(header), [part for row in rows for part in lines_of(row)]
        return "\n".join([*head, *_rule([*head, *body]), *body])
    indent = sum(widths) + len(gap) * len(widths)
    room = max(20, width - indent)
    lines = []
    for row, text in zip(rows, texts, strict=True):
        wrapped = textwrap.wrap(text, room) or [""]
        beside = zip_longest(lines_of(row), wrapped, fillvalue="")
        lines += [(cells.ljust(indent) + more).rstrip() for cells, more in beside]
    head = lines_of(header)
    head[0] = head[0].ljust(indent) + last
    return "\n".join([*head, *_rule([*head, *lines]), *lines])


def _rule(lines: Sequence[str]) -> list[str]:
    return ["·" * max(map(len, lines))]


def episode_counts(rows: Sequence[Mapping[str, Any]], several_tasks: bool) -> tuple[str, list[str]]:
    """Header and cells of a column with `num_episodes` and, where there are several tasks, `num_tasks` in brackets."""
    if not several_tasks:
        return "episodes", [str(row["num_episodes"]) for row in rows]
    return "episodes (tasks)", [f"{row['num_episodes']} ({row['num_tasks']})" for row in rows]
