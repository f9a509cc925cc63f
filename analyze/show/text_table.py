"""Tables as plain aligned text."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
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
        rows: cells, one sequence per row.
        left: numbers of the columns that are aligned to the left.
        last: header of one more column of running text, wrapped into what is left of the width.
        texts: that column's texts, one per row.
        width: width of the page; only the running text gives way.
    """
    widths = [max(len(row[i]) for row in [header, *rows]) for i in range(len(header))]
    gap = "  " if sum(widths) + 2 * (len(widths) - 1) <= width else " "

    def line(cells: Sequence[str]) -> str:
        return gap.join(
            cell.ljust(widths[i]) if i in left else cell.rjust(widths[i]) for i, cell in enumerate(cells)
        ).rstrip()

    if texts is None:
        body = [line(row) for row in rows]
        return "\n".join([line(header), *_rule([line(header), *body]), *body])
    indent = sum(widths) + len(gap) * len(widths)
    room = max(20, width - indent)
    lines = []
    for row, text in zip(rows, texts, strict=True):
        wrapped = textwrap.wrap(text, room) or [""]
        lines.append((line(row).ljust(indent) + wrapped[0]).rstrip())
        lines += [" " * indent + more for more in wrapped[1:]]
    head = line(header).ljust(indent) + last
    return "\n".join([head, *_rule([head, *lines]), *lines])


def _rule(lines: Sequence[str]) -> list[str]:
    return ["·" * max(map(len, lines))]


def episode_counts(rows: Sequence[Mapping[str, Any]], several_tasks: bool) -> tuple[str, list[str]]:
    """Header and cells of a column with `num_episodes` and, where there are several tasks, `num_tasks` in brackets."""
    if not several_tasks:
        return "episodes", [str(row["num_episodes"]) for row in rows]
    return "episodes (tasks)", [f"{row['num_episodes']} ({row['num_tasks']})" for row in rows]
