"""Heads: what each of them attends to, how much the heads of a layer differ, and their ranking."""

from __future__ import annotations

from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.measures.frames import (
    EPISODE_ID,
    Tables,
    cells_in_parts,
    float_values,
    groups_in_parts,
    head_axis,
    layer_axis,
    long_table,
)
from vla_attention.analyze.measures.masses import finite_mean, group_measures, ratio, sides, uniform_ratio
from vla_attention.analyze.measures.steps import MeasuredEpisode
from vla_attention.analyze.statistics.episode_intervals import ABOUT_COLUMNS, Sampling, means_with_intervals
from vla_attention.analyze.statistics.intervals import NO_LIMITS, POSITIVE, SHARE
from vla_attention.schemas.groupings.grouping import Grouping

_HEAD = ("layer", "block", "head")


def episode_heads(measured: MeasuredEpisode, grouping: Grouping) -> Tables:
    """Every (layer, head) of one episode: means over replans.

    Masses are averaged over denoise steps first, and measures are those of these means.

    Args:
        measured: the episode with heads kept apart.
        grouping: the groups, and the ratio if it has one.

    Returns:
        cells: suite, task_id, episode_index, layer, block, head; with a ratio `numerator_fraction`,
            `denominator_fraction`, `numerator_mass` and `denominator_mass`; `log2_ratio` and `log2_lift` (over the
            uniform ratio), means over the replans where they are finite; and `num_nonfinite`, the number of replans
            whose ratio is infinite, undefined or 0.
        groups: the same names, group, fraction and lift (see `masses.group_measures`).
    """
    mass, valid_mass = measured.mass.mean(axis=2), measured.valid_mass.mean(axis=2)
    uniform_mass, uniform_valid = measured.uniform_mass.mean(axis=2), measured.uniform_valid.mean(axis=2)
    measures = group_measures(mass, valid_mass, measured.num_keys, uniform_mass, uniform_valid)
    cells: dict[str, NDArray[Any]] = {}
    if grouping.ratio is not None:
        above, below = sides(mass, grouping)
        total = mass.sum(axis=-1)
        with np.errstate(divide="ignore", invalid="ignore"):
            log2 = np.log2(ratio(above, below))
            uniform = np.log2(uniform_ratio(uniform_mass, grouping))
            cells["numerator_fraction"] = finite_mean(above / total)
            cells["denominator_fraction"] = finite_mean(below / total)
            cells["log2_ratio"] = finite_mean(log2)
            cells["log2_lift"] = finite_mean(log2 - uniform)
        cells["numerator_mass"], cells["denominator_mass"] = above.mean(axis=0), below.mean(axis=0)
        cells["num_nonfinite"] = (~np.isfinite(log2)).sum(axis=0)
    groups = {"fraction": finite_mean(measures.fraction), "lift": finite_mean(measures.lift)}
    axes = [layer_axis(measured.selection), head_axis(measured.selection)]
    return Tables(
        long_table(measured.item, axes, cells),
        long_table(measured.item, [*axes, {"group": grouping.names}], groups),
    )


def dispersion(values: NDArray[np.float64], axis: int = -1) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Standard deviation over heads (ddof 0) and coefficient of variation (standard deviation / mean).

    Over the finite values; NaN with fewer than two of them, and the coefficient also where the mean is 0. Shape: that
    of `values` without the axis.
    """
    finite = np.isfinite(values)
    count = finite.sum(axis=axis)
    mean = finite_mean(values, axis)
    centred = np.where(finite, values - np.expand_dims(mean, axis), 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        std = np.sqrt((centred**2).sum(axis=axis) / np.where(count > 1, count, np.nan))
        return std, np.where(mean != 0, std / mean, np.nan)


def heads_tables(episodes: Tables, grouping: Grouping, sampling: Sampling) -> Tables:
    """Every (layer, head), from `episode_heads` of all episodes in their order: means over episodes with intervals.

    X_low and X_high bound X, and X_episodes says how many episodes have a finite value.

    Returns:
        cells: layer, block, head, num_episodes, num_tasks, `ABOUT_COLUMNS`; with a ratio, bounded,
            `numerator_fraction`, `log2_ratio` (two to its power is the geometric mean that `task_tables` has) and
            `log2_lift`; without bounds `denominator_fraction`, `ratio_of_means` (mean numerator mass / mean denominator
            mass) and `num_nonfinite`, the number of (episode, replan) left out of the logarithms.
        groups: layer, block, head, group, num_episodes, num_tasks, `ABOUT_COLUMNS`; bounded, `fraction` and `lift`.
    """
    limits = {"fraction": SHARE, "lift": POSITIVE}
    groups = pl.concat(
        means_with_intervals(part, (*_HEAD, "group"), limits, sampling)
        for part in groups_in_parts(episodes).by("layer")
    )
    if grouping.ratio is None:
        return Tables(
            groups.select(*_HEAD, "num_episodes", "num_tasks", *ABOUT_COLUMNS).unique(_HEAD, maintain_order=True),
            groups,
        )
    cells = pl.concat(_cells_of_heads(part, sampling) for part in cells_in_parts(episodes).by("layer"))
    return Tables(cells, groups)


def _cells_of_heads(episodes: pl.DataFrame, sampling: Sampling) -> pl.DataFrame:
    bounded = {"log2_ratio": NO_LIMITS, "log2_lift": NO_LIMITS, "numerator_fraction": SHARE}
    above, below = pl.col("numerator_mass").mean(), pl.col("denominator_mass").mean()
    plain = episodes.group_by(_HEAD).agg(
        pl.col("denominator_fraction").mean(),
        (above / below).fill_nan(None).alias("ratio_of_means"),
        pl.col("num_nonfinite").sum(),
    )
    return means_with_intervals(episodes, _HEAD, bounded, sampling).join(
        plain, on=_HEAD, how="left", maintain_order="left"
    )


def dispersion_table(episodes: Tables, grouping: Grouping, sampling: Sampling) -> pl.DataFrame:
    """How much the heads of a layer differ, one row per layer, from `episode_heads` of all episodes.

    Means over episodes with intervals: `fraction_std` and `fraction_cv`, standard deviation and coefficient
    of variation over heads of the numerator's fraction (without a ratio: of `main_group`'s); with a ratio
    `log2_ratio_std`, over the heads with a finite one. Further columns: layer, block, num_heads, num_episodes,
    num_tasks. Null with a single head.
    """
    main = None if grouping.ratio is not None else main_group(episodes, grouping)
    measured = {"fraction": "numerator_fraction"} | ({"log2_ratio": "log2_ratio"} if grouping.ratio else {})
    by = (*EPISODE_ID, "layer", "block")
    rows = []
    for tables in episodes.parts:
        cells = tables.cells
        if main is not None:
            cells = cells.with_columns(tables.of_group(main)["fraction"].alias("numerator_fraction"))
        for key, part in cells.group_by(by, maintain_order=True):
            row = dict(zip(by, key, strict=True)) | {"num_heads": part.height}
            for name, column in measured.items():
                std, cv = dispersion(float_values(part[column]))
                row |= {f"{name}_std": float(std), f"{name}_cv": float(cv)}
            rows.append(row)
    table = pl.DataFrame(rows).sort(*EPISODE_ID, maintain_order=True)
    values = {"fraction_std": POSITIVE, "fraction_cv": POSITIVE}
    values |= {"log2_ratio_std": POSITIVE} if grouping.ratio is not None else {}
    return means_with_intervals(table, ("layer", "block", "num_heads"), values, sampling)


def ranked_heads(heads: Tables, grouping: Grouping) -> pl.DataFrame:
    """The cells of `heads_tables` from the most to the least on the numerator (without a ratio: on `main_group`).

    By `log2_lift`, which is comparable where the numbers of keys differ; without a ratio by the group's fraction, heads
    without one last. A head whose ratio is infinite at every replan comes first, one whose ratio is always 0 last;
    heads without any mass on either side are left out. A block
    that was named by two layer numbers is listed once.
    """
    cells = heads.cells
    if grouping.ratio is None:
        fraction = heads.of_group(main_group(heads, grouping))["fraction"]
        once = cells.with_columns(fraction.alias("_order")).unique(["block", "head"], keep="first", maintain_order=True)
        return _descending(once)
    once = cells.unique(["block", "head"], keep="first", maintain_order=True)
    above, below = pl.col("numerator_fraction") > 0, pl.col("denominator_fraction") > 0
    limit = pl.when(above & ~below).then(float("inf")).when(below & ~above).then(float("-inf"))
    # Without a uniform baseline (a side without keys) the order is that of the ratio.
    order = pl.coalesce("log2_lift", "log2_ratio", limit)
    return _descending(once.with_columns(order.alias("_order")).filter(pl.col("_order").is_not_null()))


def _descending(heads: pl.DataFrame) -> pl.DataFrame:
    """From the largest to the smallest `_order`, heads without one last."""
    return heads.sort("_order", "block", "head", descending=[True, False, False], nulls_last=True).drop("_order")


def main_group(heads: Tables, grouping: Grouping) -> str:
    """The group by which heads are compared when the grouping has no ratio: the first that has any mass."""
    return next(iter(heads.groups_with("fraction")), grouping.names[0])
