"""Summaries of a sample. Pure numpy functions on arrays.

A ratio can be infinite (no mass in the denominator) or undefined (no mass on either side). Such values are in no mean;
each function here returns how many values it left out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike


@dataclass(frozen=True)
class SampleSummary:
    """Five numbers over the finite values of a sample (None without any), and how many values are not finite.

    `std` is the standard deviation of the values themselves (ddof 0), as in the published scripts.
    """

    mean: float | None
    std: float | None
    median: float | None
    min: float | None
    max: float | None
    num_nonfinite: int


def summarize(values: ArrayLike) -> SampleSummary:
    """Summarize a sample of shape (n,) over its finite values; NaN and infinities are counted in `num_nonfinite`."""
    sample = np.asarray(values, dtype=np.float64)
    finite = sample[np.isfinite(sample)]
    left_out = int(sample.size - finite.size)
    if finite.size == 0:
        return SampleSummary(None, None, None, None, None, left_out)
    return SampleSummary(
        mean=float(finite.mean()),
        std=float(finite.std()),
        median=float(np.median(finite)),
        min=float(finite.min()),
        max=float(finite.max()),
        num_nonfinite=left_out,
    )


def geometric_mean(ratios: ArrayLike) -> tuple[float | None, int]:
    """exp(mean(log ratio)) over the finite positive ratios of shape (n,), and how many ratios were left out.

    Unlike the mean, it does not depend on which side is the numerator: geometric_mean(1/x) = 1/geometric_mean(x).
    """
    sample = np.asarray(ratios, dtype=np.float64)
    usable = sample[np.isfinite(sample) & (sample > 0)]
    left_out = int(sample.size - usable.size)
    return (float(np.exp(np.log(usable).mean())) if usable.size else None), left_out
