"""Means over episodes with the house's intervals: the task is the unit, as if no two tasks were related."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import polars as pl

from vla_attention.analyze.core.estimate import estimate
from vla_attention.analyze.statistics.units import Sampling

#: Scale on which a number is averaged and compared, and the way back.
SCALES = {"log": (np.log, np.exp), "plain": (lambda x: x, lambda x: x)}


def means(table: pl.DataFrame, by: Sequence[str], value: str = "value", scale: str = "plain") -> list[dict[str, Any]]:
    """Rows with `by`, value, low, high and the number of episodes and tasks.

    table: one row per episode and item, with suite and task_id. With one task or without spread, low and high are None.
    """
    into, back = SCALES[scale]
    values = table[value].to_numpy().astype(np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        transformed = into(values)
    there = np.isfinite(transformed)
    chosen = table.with_columns(pl.Series(value, transformed)).filter(pl.Series(there))
    if not chosen.height:
        return []
    found = estimate(chosen, by, {value: "plain"}, Sampling())
    rows = []
    for row in found.iter_rows(named=True):
        numbers = {
            "value" if end == "" else end[1:]: None
            if row[f"{value}{end}"] is None
            else float(back(row[f"{value}{end}"]))
            for end in ("", "_low", "_high")
        }
        rows.append({name: row[name] for name in (*by, "num_episodes", "num_tasks")} | numbers)
    return rows


def ranks(values: np.ndarray) -> np.ndarray:
    """Ranks from 1; equal values share their mean rank."""
    return pl.Series(values).rank("average").to_numpy()


def spearman(first: np.ndarray, second: np.ndarray) -> float:
    """Rank correlation (Spearman 1904); NaN where one of them has no spread or fewer than four items are known."""
    there = np.isfinite(first) & np.isfinite(second)
    if there.sum() < 4:
        return float("nan")
    one, other = ranks(first[there]), ranks(second[there])
    if one.std() == 0 or other.std() == 0:
        return float("nan")
    return float(np.corrcoef(one, other)[0, 1])
