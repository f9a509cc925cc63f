"""How many independent replans an episode is worth. Replans follow each other within a second and repeat each other.

The integrated autocorrelation time is estimated with Geyer's initial positive sequence (Geyer 1992, "Practical Markov chain
Monte Carlo", Statistical Science 7): autocovariances are summed in neighbouring pairs until a pair's sum is no
longer positive, because what follows is noise. An episode has a few dozen replans and its mean is estimated from them, so
slow drifts look weaker than they are: the effective number is an upper bound rather than a midpoint. It is shown, and never
used to weigh anything: the episode stays the unit of every interval.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import ArrayLike, NDArray

from vla_attention.analyze.measures.aggregate import EPISODE_KEYS
from vla_attention.schemas.groupings.grouping import Grouping

#: With fewer replans than this, there is no pair of lags to look at.
FEWEST = 4


@dataclass(frozen=True)
class EffectiveCount:
    """What a series is worth.

    Attributes:
        num_values: length of the series.
        time: integrated autocorrelation time in replans, at least 1; None when it cannot be estimated (see `effective_count`).
        effective: num_values / time; None likewise.
    """

    num_values: int
    time: float | None
    effective: float | None


def autocovariances(series: ArrayLike) -> NDArray[np.float64]:
    """Autocovariances (lag,) of a series (replan,), lags 0 to n - 1, about its mean, each divided by n.

    The divisor n, not n - lag, keeps the sequence positive definite (Priestley 1981, Spectral Analysis and Time Series).
    """
    values = np.asarray(series, dtype=np.float64)
    centred = values - values.mean()
    return np.correlate(centred, centred, mode="full")[len(values) - 1 :] / len(values)


def effective_count(series: ArrayLike) -> EffectiveCount:
    """Effective number of independent values in a series (replan,).

    With g the autocovariances and G(m) = g(2m) + g(2m + 1), time = (2 * sum of G(0) ... G(k) - g(0)) / g(0), where k is the last
    before the first G that is not positive. A time below 1 (values that alternate) counts as 1: in so short a series that
    is no evidence of more than n values' worth. None for a series with values that are not finite, which has gaps, for one that
    never changes, and for fewer than four values.
    """
    values = np.asarray(series, dtype=np.float64)
    if len(values) < FEWEST or not np.isfinite(values).all() or np.ptp(values) <= 1e-12 * np.abs(values).max():
        return EffectiveCount(len(values), None, None)
    covariances = autocovariances(values)
    if not covariances[0] > 0:  # differences so small that their squares vanish
        return EffectiveCount(len(values), None, None)
    pairs = covariances[: len(covariances) // 2 * 2].reshape(-1, 2).sum(axis=1)
    stop = int(np.argmax(pairs <= 0)) if (pairs <= 0).any() else len(pairs)
    time = max(1.0, float(2 * pairs[:stop].sum() / covariances[0] - 1))
    return EffectiveCount(len(values), time, len(values) / time)


def autocorrelation_table(replans: pl.DataFrame, grouping: Grouping) -> pl.DataFrame:
    """One row per (episode, layer), from `aggregate.per_replan` or `aggregate.add_layers_avg`.

    The series is `series` = "log2_ratio", or the first group's fraction when the grouping has no ratio. Columns: the episode's,
    layer, layer_number, series, num_replans, autocorrelation_time, effective_replans (null when they cannot be estimated).
    """
    name = "log2_ratio" if grouping.ratio else f"{grouping.names[0]}_fraction"
    rows = []
    keys = [*EPISODE_KEYS, "layer", "layer_number"]
    ordered = replans.sort("replan")
    for values, part in ordered.group_by(keys, maintain_order=True):
        count = effective_count(part[name].fill_null(float("nan")).to_numpy())
        rows.append((*values, name, count.num_values, count.time, count.effective))
    kinds = {key: replans.schema[key] for key in keys}
    schema: dict[str, Any] = {
        **kinds,
        "series": pl.String,
        "num_replans": pl.Int64,
        "autocorrelation_time": pl.Float64,
        "effective_replans": pl.Float64,
    }
    table = pl.DataFrame(rows, schema=schema, orient="row")
    return table.sort("suite", "task_id", "episode_index", "layer_number", nulls_last=True)
