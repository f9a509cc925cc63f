"""What a ratio may be called: the published guide's words, where attention differs from uniform attention at all.

The guide calls a mean ratio above 1.5 visual-dominant and one below 0.67 linguistic-dominant. Uniform attention over
512 image keys and a dozen words has a ratio near 40. A word is therefore withheld where the numbers do not differ from
those of uniform attention, where nobody can know whether they do, and for weights that were never trained.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from vla_attention.analyze.show.numbers import format_interval, format_number
from vla_attention.schemas.groupings.grouping import Grouping

#: Thresholds of the published interpretation guide, on the mean ratio.
VISUAL_ABOVE, LINGUISTIC_BELOW = 1.5, 0.67
#: Words in place of the guide's, and what they mean.
UNTRAINED, AS_UNIFORM, UNDECIDED = "untrained", "as uniform", "undecided"
_MEANINGS = {
    UNTRAINED: "the weights are random, so a word would be about nothing",
    AS_UNIFORM: "looks as uniform attention does: the lift's interval holds 1",
    UNDECIDED: "without an interval, nobody knows whether it differs from uniform attention",
}


def verdict(ratio: float | None) -> str:
    """The guide's name for a mean ratio: above 1.5, below 0.67, or between; "undefined" without a ratio."""
    if ratio is None or math.isnan(ratio):
        return "undefined"
    if ratio > VISUAL_ABOVE:
        return "visual-dominant"
    return "linguistic-dominant" if ratio < LINGUISTIC_BELOW else "balanced"


def reading(row: Mapping[str, Any], untrained: bool) -> str:
    """What a row of `aggregate.task_tables` may be called: the guide's word, or the reason why it has none.

    `row` has geometric_mean, ratio_lift and their bounds, and uniform_ratio. Without a uniform ratio (a side without
    keys) there is nothing to compare with, and the guide's word stands.
    """
    if untrained:
        return UNTRAINED
    word, uniform = verdict(row["geometric_mean"]), row["uniform_ratio"]
    if word == "undefined" or uniform is None or not math.isfinite(uniform):
        return word
    if row["ratio_lift_low"] is None:
        return UNDECIDED
    # The lift decides: prompts differ in length between tasks, so the ratio's interval over tasks is wide anyway.
    return AS_UNIFORM if row["ratio_lift_low"] <= 1.0 <= row["ratio_lift_high"] else word


def meanings(readings: list[str]) -> str:
    """What those of the given words mean that are not the guide's, as sentences; empty without any."""
    return " ".join(f"{word}: {meaning}." for word, meaning in _MEANINGS.items() if word in readings)


def verdict_sentence(grouping: Grouping, row: Mapping[str, Any], untrained: bool) -> str:
    """What the ratio of a row may be called, beside uniform attention; empty where the guide does not apply."""
    ratio, uniform = row["geometric_mean"], row["uniform_ratio"]
    if not grouping.compares_modalities or ratio is None or uniform is None:
        return ""
    word, of_uniform = reading(row, untrained), verdict(uniform)
    if word == UNTRAINED:
        return "The weights are untrained: the ratio says nothing about seeing or reading."
    if word == AS_UNIFORM:
        bounds = format_interval(row["ratio_lift_low"], row["ratio_lift_high"])
        return (
            f"The attention looks as uniform attention does, whose ratio is {format_number(uniform)}: the interval of "
            f"the lift, {bounds}, holds 1."
        )
    if word == UNDECIDED:
        return (
            f"There is no interval, so nobody knows whether {format_number(ratio)} differs from the "
            f"{format_number(uniform)} of uniform attention."
        )
    guide = f"The published guide (above {VISUAL_ABOVE} visual, below {LINGUISTIC_BELOW} linguistic) calls "
    guide += f"{format_number(ratio)} '{word}'"
    if word == of_uniform:
        same = f"It calls the {format_number(uniform)} of uniform attention the same"
        return f"{guide}. {same}: here the word means nothing, and the lift tells."
    return f"{guide}, and the {format_number(uniform)} of uniform attention '{of_uniform}'."
