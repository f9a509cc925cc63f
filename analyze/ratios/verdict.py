"""The published guide's reading of a ratio: visual-dominant, balanced or linguistic-dominant."""

from __future__ import annotations

import math

#: Thresholds of the published interpretation guide, on the mean ratio.
VISUAL_ABOVE, LINGUISTIC_BELOW = 1.5, 0.67


def verdict(ratio: float | None) -> str:
    """The guide's word for a mean ratio: above 1.5, below 0.67, or between; "undefined" without one."""
    if ratio is None or math.isnan(ratio):
        return "undefined"
    if ratio > VISUAL_ABOVE:
        return "visual-dominant"
    return "linguistic-dominant" if ratio < LINGUISTIC_BELOW else "balanced"
