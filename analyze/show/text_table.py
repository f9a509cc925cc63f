"""Numbers and tables as plain aligned text."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence


def format_number(value: float | None) -> str:
    """At most five characters from 0.001 to 99999, with three to four significant digits, else as 1.2e-05; - for none."""
    if value is None or math.isnan(value):
        return "-"
    if math.isinf(value):
        return "inf" if value > 0 else "-inf"
    size = abs(value)
    if size != 0 and (size < 0.001 or size >= 99999.5):
        return f"{value:.1e}"
    if size >= 999.5:
        return f"{value:.0f}"
    decimals = 1 if size >= 99.95 else 2 if size >= 9.995 else 3
    text = f"{value:.{decimals}f}"
    # Whole numbers (keys, exact baselines) need no zeros behind the point.
    return f"{value:.0f}" if value == round(value) else text


def format_interval(low: float | None, high: float | None) -> str:
    """`[low, high]`, or - when there is no interval."""
    return "-" if low is None or high is None else f"[{format_number(low)}, {format_number(high)}]"


def text_table(
    header: Sequence[str],
    rows: Sequence[Sequence[str]],
    left: Sequence[int] = (),
    last: str = "",
    texts: Sequence[str] | None = None,
    width: int = 100,
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
