"""Numbers as text: one function for each kind. A value that does not exist (None or NaN) is printed as -."""

from __future__ import annotations

import math
from collections.abc import Iterable

from vla_attention.schemas.command_line import format_bytes as format_bytes  # shared with capture
from vla_attention.schemas.errors import plural as plural


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
    text = f"{value:.{decimals}f}"
    # Whole numbers (keys, exact baselines) need no zeros behind the point.
    return f"{value:.0f}" if value == round(value) else text


def format_signed(value: float | None) -> str:
    """As `format_number`, with a + before positive numbers: for differences and effect sizes."""
    return format_number(value) if value is None or not value > 0 else f"+{format_number(value)}"


def format_interval(low: float | None, high: float | None) -> str:
    """`[low, high]`; - when there is no interval."""
    return "-" if low is None or high is None else f"[{format_number(low)}, {format_number(high)}]"


def format_percent(share: float | None, decimals: int = 1) -> str:
    """A share as per cent: 0.125 as 12.5%."""
    return "-" if share is None or math.isnan(share) else f"{100 * share:.{decimals}f}%"


def format_percent_interval(low: float | None, high: float | None, decimals: int = 1) -> str:
    """An interval of shares as `[12.5, 20.0]%`; - when there is no interval."""
    if low is None or high is None:
        return "-"
    return f"[{100 * low:.{decimals}f}, {100 * high:.{decimals}f}]%"


def interval_name(level: float) -> str:
    """The name of an interval of a level: `95% interval`."""
    return f"{100 * level:g}% interval"


def solved_text(outcomes: Iterable[bool | None]) -> str:
    """`3 solved`; `3 of 5 with a known outcome solved` where some are not known, `outcomes not known` where all are."""
    given = list(outcomes)
    known = [outcome for outcome in given if outcome is not None]
    if given and not known:
        return "outcomes not known"
    solved = sum(known)
    return f"{solved} solved" if len(known) == len(given) else f"{solved} of {len(known)} with a known outcome solved"


def of_tasks(num_episodes: int, num_tasks: int) -> str:
    """`16 episodes of 8 tasks`."""
    return f"{plural(num_episodes, 'episode')} of {plural(num_tasks, 'task')}"
