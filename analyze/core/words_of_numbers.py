"""Columns and phrases that several questions share."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from vla_attention.analyze.core.result import Column
from vla_attention.schemas.groupings.grouping import Grouping

GROUP_COLUMNS = (
    Column("group", "text"),
    Column("fraction", "percent", "of the attention", "part of the attention to all groups"),
    Column(
        "lift", "factor", "times even", "attention per token, over what it would be if spread evenly over all tokens"
    ),
    Column("keys", "number", "tokens"),
)
RATIO_COLUMNS = (
    Column(
        "geometric_mean",
        "factor",
        "ratio",
        "attention to one side over the other, geometric mean over layers, calls and tasks",
    ),
    Column("uniform_ratio", "number", "if even", "the ratio if attention were spread evenly over all tokens"),
    Column("ratio_lift", "factor", "per token", "ratio / ratio if even"),
)
NORM_COLUMNS = (
    Column("layer", "text"),
    Column("visual_norm", "number", "pictures", "length of the vector that the keys add to the residual stream"),
    Column("linguistic_norm", "number", "text"),
    Column("geometric_mean", "factor", "ratio"),
    Column("uniform_ratio", "number", "if even", "the ratio if attention were shared out evenly between the segments"),
    Column("ratio_lift", "factor", "over even", "ratio / ratio if even"),
)


def sides(grouping: Grouping) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The groups on both sides of the ratio."""
    assert grouping.ratio is not None
    return grouping.ratio.numerator, grouping.ratio.denominator


def inverse(value: float, low: float | None, high: float | None) -> list[float | None]:
    """1 / value with its interval."""
    return [1 / value, None if high is None else 1 / high, None if low is None else 1 / low]


def with_interval(row: Mapping[str, Any], name: str) -> str:
    """`2.89 [2.13, 3.93]`; the value alone without an interval."""
    low, high = row[f"{name}_low"], row[f"{name}_high"]
    return f"{row[name]:.3g}" + ("" if low is None else f" [{low:.3g}, {high:.3g}]")
