"""Autocorrelation of replans: how many independent values the replans of an episode are worth.

Replans follow each other within a second, so their values are correlated. The integrated autocorrelation time is
estimated with Geyer's initial positive sequence (Geyer 1992, "Practical Markov chain Monte Carlo", Statistical Science
7): autocovariances are summed in neighbouring pairs until a pair's sum is no longer positive, because the rest is
noise. An episode has a few dozen replans, and its mean is estimated from the same replans, so slow drifts look weaker
than they are: the effective number is an upper bound rather than a midpoint. It is shown and never used as a weight;
the episode stays the unit of every interval.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import ArrayLike, NDArray

FEWEST = 4


@dataclass(frozen=True)
class EffectiveCount:
    """The number of independent values that a series is worth.

    Attributes:
        num_values: length of the series.
        time: integrated autocorrelation time in replans, at least 1; None when it cannot be estimated, see
            `effective_count`.
        effective: num_values / time; None likewise.
    """

    num_values: int
    time: float | None
    effective: float | None


def autocovariances(series: ArrayLike) -> NDArray[np.float64]:
    """Autocovariances (lag,) of a series (replan,), lags 0 to n - 1, about its mean, each divided by n.

    The divisor n, not n - lag, keeps the sequence positive definite
    (Priestley 1981, Spectral Analysis and Time Series).
    """
    values = np.asarray(series, dtype=np.float64)
    centred = values - values.mean()
    return np.correlate(centred, centred, mode="full")[len(values) - 1 :] / len(values)


def effective_count(series: ArrayLike) -> EffectiveCount:
    """Effective number of independent values in a series (replan,).

    With g the autocovariances and G(m) = g(2m) + g(2m + 1), time = (2 * sum of G(0) ... G(k) - g(0)) / g(0), where k is
    the last index before the first G that is not positive. A time below 1 (alternating values) counts as 1: so short a
    series is no evidence of more than n independent values. None for a series with values that are not finite, for a
    constant one, and for fewer than four values.
    """
    values = np.asarray(series, dtype=np.float64)
    if len(values) < FEWEST or not np.isfinite(values).all() or np.ptp(values) <= 1e-12 * np.abs(values).max():
        return EffectiveCount(len(values), None, None)
    covariances = autocovariances(values)
    if not covariances[0] > 0:  # differences so small that their squares underflow
        return EffectiveCount(len(values), None, None)
    pairs = covariances[: len(covariances) // 2 * 2].reshape(-1, 2).sum(axis=1)
    stop = int(np.argmax(pairs <= 0)) if (pairs <= 0).any() else len(pairs)
    time = max(1.0, float(2 * pairs[:stop].sum() / covariances[0] - 1))
    return EffectiveCount(len(values), time, len(values) / time)


def autocorrelation_table(table: pl.DataFrame, by: Sequence[str], series: str) -> pl.DataFrame:
    """The effective number of replans of every series in a table with one row per replan, in the order of time.

    Args:
        table: columns `by` and `series`; a null value counts as not finite.
        by: the columns that identify one series, for instance an episode and a layer.
        series: the column with the values.

    Returns:
        One row per series in order of first appearance: `by`, series (the column's name), num_replans,
        autocorrelation_time, effective_replans (null when they cannot be estimated).
    """
    rows = []
    for key, part in table.group_by(by, maintain_order=True):
        count = effective_count(part[series].fill_null(float("nan")).to_numpy())
        rows.append((*key, series, count.num_values, count.time, count.effective))
    schema: dict[str, Any] = {
        **{name: table.schema[name] for name in by},
        "series": pl.String,
        "num_replans": pl.Int64,
        "autocorrelation_time": pl.Float64,
        "effective_replans": pl.Float64,
    }
    return pl.DataFrame(rows, schema=schema, orient="row")
