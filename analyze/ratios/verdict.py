"""The published guide's reading of a ratio: thresholds and wording (visual-dominant, balanced, linguistic-dominant)."""

from __future__ import annotations

import math

from vla_attention.analyze.show.numbers import format_number
from vla_attention.schemas.groupings.grouping import Grouping

#: Thresholds of the published interpretation guide, on the mean ratio.
VISUAL_ABOVE, LINGUISTIC_BELOW = 1.5, 0.67


def verdict(ratio: float | None) -> str:
    """The guide's name for a mean ratio: above 1.5, below 0.67, or between; "undefined" without a ratio."""
    if ratio is None or math.isnan(ratio):
        return "undefined"
    if ratio > VISUAL_ABOVE:
        return "visual-dominant"
    return "linguistic-dominant" if ratio < LINGUISTIC_BELOW else "balanced"


def verdict_sentence(grouping: Grouping, ratio: float | None, uniform: float | None) -> str:
    """The guide's names for a ratio and for that of uniform attention; empty where the guide does not apply."""
    if not grouping.compares_modalities or ratio is None or uniform is None:
        return ""
    word, of_uniform = verdict(ratio), verdict(uniform)
    guide = f"The published guide (above {VISUAL_ABOVE} visual, below {LINGUISTIC_BELOW} linguistic) calls "
    guide += f"{format_number(ratio)} '{word}'"
    if word == of_uniform:
        same = f"It calls the {format_number(uniform)} of uniform attention the same"
        return f"{guide}. {same}: here the word means nothing."
    return f"{guide}, and the {format_number(uniform)} of uniform attention '{of_uniform}'."
