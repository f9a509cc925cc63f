"""Values as text: one function for the screen, the page and pictures. What does not exist is printed as -."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from vla_attention.analyze.core.result import Column
from vla_attention.analyze.statistics.intervals import says_a_size


def format_number(value: float | None) -> str:
    """Three to four significant digits: at most five characters from 0.001 to 99999, else as 1.2e-05."""
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
    # Whole numbers (keys, exact baselines) need no zeros behind the point.
    return f"{value:.0f}" if value == round(value) else f"{value:.{decimals}f}"


#: Sizes and multiples below it are nothing to a reader of a table; the files have them whole.
_NEXT_TO_NOTHING = 0.001


def cell(row: Mapping[str, Any], column: Column) -> str:
    """A column's cell of a row, with its interval where the row has one: `18.2 [17.7, 18.7]`, `12.5% [10.1, 15.0]`.

    `34.1 [any]`: the interval of a ratio from too few episodes, whose ends are worlds apart.
    """
    value = row[column.name]
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "-"
    if column.kind in ("text", "prose", "count"):
        return str(value)
    if column.kind == "p":
        return "<0.001" if value < 0.001 else f"{value:.3f}"
    low, high = (row.get(f"{column.name}_{end}") for end in ("low", "high"))
    shown = _shown(value, column.kind)
    if low is None or high is None:
        return shown
    if column.kind == "factor" and not says_a_size(low, high):
        return f"{shown} [any]"
    return f"{shown} [{', '.join(_shown(end, column.kind).rstrip('%') for end in (low, high))}]"


def _shown(value: float, kind: str) -> str:
    if kind == "percent":
        return f"{100 * value:.1f}%"
    if kind == "points":
        return f"{100 * value:+.1f}"
    if kind in ("number", "factor") and 0 < value < _NEXT_TO_NOTHING:
        return f"<{_NEXT_TO_NOTHING}"
    sign = "+" if kind == "signed" and value > 0 else ""
    return f"{sign}{format_number(value)}"
