"""A table of attention calls for errors: module, kind, queries x keys, heads, dtype, how often."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence

from vla_attention.capture.torch_policies.attention_calls import CallShape


def calls_table(calls: Sequence[CallShape]) -> str:
    """Return the calls as lines of text; those that differ in a number of their module's path only share a line."""
    if not calls:
        return "(no attention call was seen)"
    counts: Counter[tuple[str, ...]] = Counter()
    numbers: dict[tuple[str, ...], dict[str, None]] = {}
    for call in calls:
        line: tuple[str, ...] = (
            re.sub(r"(?<=\.)\d+(?=\.|$)", "{}", call.module) or "(policy)",
            call.kind,
            f"{call.queries} x {call.keys}",
            str(call.heads),
            str(call.batch),
            call.dtype,
        )
        counts[line] += 1
        numbers.setdefault(line, {}).update(dict.fromkeys([".".join(re.findall(r"(?<=\.)\d+(?=\.|$)", call.module))]))
    rows: list[tuple[str, ...]] = [("module", "kind", "queries x keys", "heads", "batch", "dtype", "calls", "{} is")]
    for line, count in counts.items():
        found = [name for name in numbers[line] if name]
        rows.append((*line, str(count), f"{found[0]}..{found[-1]}" if len(found) > 1 else "".join(found)))
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    return "\n".join(
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows
    )
