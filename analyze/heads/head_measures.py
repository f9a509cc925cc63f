"""Heads: what each of them attends to, how much they differ within a layer, and which ones look most and read most."""

from __future__ import annotations

from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.measures.masses import finite_mean, ratio
from vla_attention.analyze.measures.selected import SelectedEpisode
from vla_attention.analyze.statistics.bootstrap import DEFAULT_SEED, NO_LIMITS, POSITIVE, SHARE
from vla_attention.analyze.statistics.episode_intervals import means_with_intervals
from vla_attention.analyze.stores.selection import Selection
from vla_attention.schemas.groupings.grouping import Grouping


def head_values(
    mass: NDArray[np.float64], num_keys: NDArray[np.float64], num_valid: NDArray[np.int64], grouping: Grouping
) -> dict[str, NDArray[Any]]:
    """Reduce one episode's masses over replans; the formulas are those of `vla_attention.analyze.measures.aggregate`, for each head alone.

    Args:
        mass: (replan, layer, head, group + 1), the last that of all valid keys; mean over denoise steps.
        num_keys: (replan or 1, group).
        num_valid: (replan or 1,).
        grouping: the groups, and the ratio if it has one.

    Returns:
        Values of shape (layer, head) by name; NaN is undefined. With groups g `{g}_fraction` and `{g}_lift`, means over replans.
        With a ratio also `numerator_fraction`, `denominator_fraction`, `numerator_mass` and `denominator_mass`; `log2_ratio`
        and `log2_lift` (over the uniform ratio), means over the replans where they are finite; and `num_nonfinite`, the number of
        replans whose ratio is infinite, undefined or 0.
    """
    groups, valid = mass[..., :-1], mass[..., -1]
    keys = num_keys[:, None, None, :]
    total = groups.sum(axis=-1)
    values: dict[str, NDArray[Any]] = {}
    with np.errstate(divide="ignore", invalid="ignore"):
        uniform_density = valid / num_valid[:, None, None]
        for i, name in enumerate(grouping.names):
            lift = np.where(keys[..., i] > 0, groups[..., i] / keys[..., i] / uniform_density, np.nan)
            values[f"{name}_fraction"] = finite_mean(groups[..., i] / total)
            values[f"{name}_lift"] = finite_mean(lift)
        if grouping.ratio is not None:
            top = [grouping.names.index(name) for name in grouping.ratio.numerator]
            bottom = [grouping.names.index(name) for name in grouping.ratio.denominator]
            above, below = groups[..., top].sum(axis=-1), groups[..., bottom].sum(axis=-1)
            log2 = np.log2(ratio(above, below))
            uniform = np.log2(ratio(num_keys[:, top].sum(axis=1), num_keys[:, bottom].sum(axis=1)))
            values["numerator_fraction"] = finite_mean(above / total)
            values["denominator_fraction"] = finite_mean(below / total)
            values["log2_ratio"] = finite_mean(log2)
            values["log2_lift"] = finite_mean(log2 - uniform[:, None, None])
            values["numerator_mass"], values["denominator_mass"] = above.mean(axis=0), below.mean(axis=0)
            values["num_nonfinite"] = (~np.isfinite(log2)).sum(axis=0)
    return values


def dispersion(values: NDArray[np.float64], axis: int = -1) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Standard deviation over heads (ddof 0: a layer's heads are all there are) and coefficient of variation, std / mean.

    Over the finite values; NaN with fewer than two of them, and the coefficient also where the mean is 0. Shape: that of `values`
    without the axis.
    """
    finite = np.isfinite(values)
    count = finite.sum(axis=axis)
    mean = finite_mean(values, axis)
    centred = np.where(finite, values - np.expand_dims(mean, axis), 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        std = np.sqrt((centred**2).sum(axis=axis) / np.where(count > 1, count, np.nan))
        return std, np.where(mean != 0, std / mean, np.nan)


def head_frame(item: SelectedEpisode, selection: Selection, values: dict[str, NDArray[Any]]) -> pl.DataFrame:
    """One episode's `head_values` as rows: suite, task_id, episode_index, layer, block, head and the values."""
    layers, heads = len(selection.layers), len(selection.heads)
    columns: dict[str, NDArray[Any]] = {
        "layer": np.repeat(np.array(selection.layer_labels, dtype=np.int64), heads),
        "block": np.repeat(np.array(selection.blocks, dtype=np.int64), heads),
        "head": np.tile(np.array(selection.head_numbers, dtype=np.int64), layers),
        **{name: value.ravel() for name, value in values.items()},
    }
    attributes = item.episode.attributes
    return pl.DataFrame(columns).select(
        pl.lit(item.store.suite).alias("suite"),
        pl.lit(attributes.task_id, dtype=pl.Int64).alias("task_id"),
        pl.lit(attributes.episode_index, dtype=pl.Int64).alias("episode_index"),
        pl.all().fill_nan(None),
    )


def heads_table(episodes: pl.DataFrame, grouping: Grouping, seed: int = DEFAULT_SEED) -> pl.DataFrame:
    """One row per (layer, head), from `head_frame` of all episodes: means over episodes with two-level intervals (95 %).

    Columns: layer, block, head, num_episodes, num_tasks; bounded by X_low and X_high, with X_episodes saying how many episodes have
    a finite value: `{g}_fraction`, `{g}_lift`, and with a ratio `numerator_fraction`, `log2_ratio` (two to its power is
    the geometric mean that `tasks_table` has) and `log2_lift`; without bounds, with a ratio, `denominator_fraction`, `ratio_of_means`
    (mean numerator mass / mean denominator mass) and `num_nonfinite`, the number of (episode, replan) left out of the logarithms.
    """
    bounded = {f"{name}_fraction": SHARE for name in grouping.names}
    bounded |= {f"{name}_lift": POSITIVE for name in grouping.names}
    plain: list[pl.Expr] = []
    if grouping.ratio is not None:
        bounded = {"log2_ratio": NO_LIMITS, "log2_lift": NO_LIMITS, "numerator_fraction": SHARE, **bounded}
        above, below = pl.col("numerator_mass").mean(), pl.col("denominator_mass").mean()
        plain = [
            pl.col("denominator_fraction").mean(),
            (above / below).fill_nan(None).alias("ratio_of_means"),
            pl.col("num_nonfinite").sum(),
        ]
    by = ("layer", "block", "head")
    ordered = episodes.sort("suite", "task_id", "episode_index", maintain_order=True)
    means = means_with_intervals(ordered, by, bounded, seed)
    if not plain:
        return means
    return means.join(ordered.group_by(by).agg(*plain), on=by, how="left", maintain_order="left")


def dispersion_table(episodes: pl.DataFrame, grouping: Grouping, seed: int = DEFAULT_SEED) -> pl.DataFrame:
    """How much the heads of a layer differ, one row per layer, from `head_frame` of all episodes.

    Means over episodes with two-level intervals (95 %): `fraction_std` and `fraction_cv`, standard deviation and coefficient of
    variation over heads of the numerator's fraction (without a ratio: of `main_group`'s); with a ratio `log2_ratio_std`, over the
    heads with a finite one. Further columns: layer, block, num_heads, num_episodes, num_tasks. Null with a single head.
    """
    share = "numerator_fraction" if grouping.ratio is not None else f"{main_group(episodes, grouping)}_fraction"
    names = [share, *(["log2_ratio"] if grouping.ratio is not None else [])]
    by = ("suite", "task_id", "episode_index", "layer", "block")
    rows = []
    for key, part in episodes.group_by(by, maintain_order=True):
        row = dict(zip(by, key, strict=True)) | {"num_heads": part.height}
        for name, column in zip(("fraction", "log2_ratio"), names, strict=False):
            std, cv = dispersion(part[column].fill_null(float("nan")).to_numpy())
            row |= {f"{name}_std": float(std), f"{name}_cv": float(cv)}
        rows.append(row)
    table = pl.DataFrame(rows).sort("suite", "task_id", "episode_index", maintain_order=True)
    values = {"fraction_std": POSITIVE, "fraction_cv": POSITIVE}
    values |= {"log2_ratio_std": POSITIVE} if grouping.ratio is not None else {}
    return means_with_intervals(table, ("layer", "block", "num_heads"), values, seed)


def ranked_heads(heads: pl.DataFrame, grouping: Grouping) -> pl.DataFrame:
    """The rows of `heads_table` from the most to the least on the numerator (without a ratio: on the first group that has mass).

    By `log2_lift`, which is comparable where the numbers of keys differ, or the group's fraction. A head whose ratio is infinite at
    every replan comes first, one whose ratio is always 0 last; heads without any mass on either side are left out. A block
    that was named by two layer numbers is listed once.
    """
    once = heads.unique(["block", "head"], keep="first", maintain_order=True)
    if grouping.ratio is None:
        return once.sort(f"{main_group(heads, grouping)}_fraction", "block", "head", descending=[True, False, False])
    above, below = pl.col("numerator_fraction") > 0, pl.col("denominator_fraction") > 0
    limit = pl.when(above & ~below).then(float("inf")).when(below & ~above).then(float("-inf"))
    # Without a uniform baseline (a side without keys) the order is that of the ratio.
    order = pl.coalesce("log2_lift", "log2_ratio", limit)
    return (
        once.with_columns(order.alias("_order"))
        .filter(pl.col("_order").is_not_null())
        .sort("_order", "block", "head", descending=[True, False, False])
        .drop("_order")
    )


def main_group(table: pl.DataFrame, grouping: Grouping) -> str:
    """The group that speaks for a grouping without a ratio: the first that has any mass."""
    having = [name for name in grouping.names if (table[f"{name}_fraction"].fill_null(0.0) > 0).any()]
    return having[0] if having else grouping.names[0]
