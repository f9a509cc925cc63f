"""A grouping kept apart by axes (`--by`): one row per episode and cell of the axes, for `core.estimate`."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from functools import partial

import numpy as np
import polars as pl

from vla_attention.analyze.core.axes import OF_ROWS
from vla_attention.analyze.core.levels import MORE, Levels, cells_of
from vla_attention.analyze.core.measure import Measured, means
from vla_attention.analyze.measures.frames import EPISODE_ID, EPISODE_KEYS, LAYERS_AVG, frame_of_episodes

#: Parts of an episode's time.
TIME_PARTS = 20
_LAYER = ("layer", "layer_number", "block")


def ratios_by(levels: Levels, by: Collection[str]) -> pl.DataFrame:
    """The ratio of every episode and cell of the axes; the grouping has one.

    Returns:
        `EPISODE_KEYS`, the columns of the axes; ratio, uniform_ratio and ratio_lift (geometric means over replans and,
        unless they are kept, over layers, of ratios with a finite logarithm), numerator_fraction, denominator_fraction,
        numerator_mass, denominator_mass (means), num_nonfinite (ratios without a finite logarithm).
    """
    axes = [axis for axis in OF_ROWS if axis in by]
    inner = {"replan", "layer", *axes}

    def then(rows: pl.DataFrame) -> pl.DataFrame:
        cells = cells_of(rows, levels.grouping).filter(pl.col("layer") != LAYERS_AVG)
        if "layer" not in by:  # a block that two layer numbers name counts once
            cell = [*EPISODE_ID, "replan", "block", "denoise_step", "head"]
            cells = cells.unique(cell, keep="first", maintain_order=True)
        names = [*EPISODE_KEYS, *_names(by, axes)]
        if "time" in by:
            cells = with_time(cells, levels.measured)
        weight = pl.col("weight") if "time" in by else pl.lit(1.0)
        logs = {name: pl.col(name).log() for name in ("ratio", "uniform_ratio", "ratio_lift")}
        plain = ("numerator_fraction", "denominator_fraction", "numerator_mass", "denominator_mass")
        return cells.group_by(names, maintain_order=True).agg(
            *(weighted(log, weight).exp().alias(name) for name, log in logs.items()),
            *(weighted(pl.col(name), weight).alias(name) for name in plain),
            (~logs["ratio"].is_finite().fill_null(False)).sum().cast(pl.Int64).alias("num_nonfinite"),
        )

    made = partial(means, by=frozenset(inner), more=frozenset(MORE))
    return frame_of_episodes(levels.measured, made, then).collect()


def groups_by(levels: Levels, by: Collection[str]) -> pl.DataFrame:
    """Keys, mass, fraction and lift of every group in every episode and cell of the axes, means over replans."""
    axes = [axis for axis in OF_ROWS if axis in by]

    def then(rows: pl.DataFrame) -> pl.DataFrame:
        rows = rows.filter(pl.col("kind") == "group").rename({"share": "fraction"})
        if "layer" in by:
            rows = rows.filter(pl.col("layer") != LAYERS_AVG)
        if "time" not in by:
            return rows
        rows = with_time(rows, levels.measured)
        names = [*EPISODE_KEYS, *_names(by, axes), "group"]
        return rows.group_by(names, maintain_order=True).agg(
            weighted(pl.col(name), pl.col("weight")).alias(name) for name in ("keys", "mass", "fraction", "lift")
        )

    made = partial(means, by=frozenset({*axes, *(("replan",) if "time" in by else ())}))
    return frame_of_episodes(levels.measured, made, then).collect()


def _names(by: Collection[str], axes: Sequence[str]) -> list[str]:
    columns = {"replan": ("replan", "env_step"), "layer": _LAYER, "denoise": ("denoise_step",), "head": ("head",)}
    return [*(name for axis in axes for name in columns[axis]), *(("phase",) if "time" in by else ())]


def weighted(value: pl.Expr, weight: pl.Expr) -> pl.Expr:
    """Weighted mean over the finite values; null without any."""
    known = value.is_finite().fill_null(False)
    total = pl.when(known).then(weight).otherwise(0.0).sum()
    return pl.when(total > 0).then(pl.when(known).then(value * weight).otherwise(0.0).sum() / total)


def with_time(rows: pl.DataFrame, measured: Sequence[Measured]) -> pl.DataFrame:
    """The rows once for each part of the episode's time that their replan lasts in, with the share as `weight`.

    `phase` is the middle of the part. A replan's value holds until the next replan, as its actions do.
    """
    wanted = set(rows.select(EPISODE_ID).unique().rows())
    parts = []
    for one in measured:
        if (key := one.item.key) not in wanted:
            continue
        starts, num_steps = one.item.timing(one.env_step)
        edges = np.linspace(0.0, 1.0, TIME_PARTS + 1)
        ends = np.append(starts[1:], num_steps)
        shares = np.minimum(edges[1:, None], ends / num_steps) - np.maximum(edges[:-1, None], starts / num_steps)
        part, replan = np.nonzero(shares > 1e-12)  # rounding can make neighbours overlap by a tiny amount
        identity = dict(zip(EPISODE_ID, key, strict=True))
        parts.append(
            pl.DataFrame(
                {
                    "replan": replan,
                    "phase": ((edges[:-1] + edges[1:]) / 2).round(6)[part],
                    "weight": shares[part, replan],
                }
            ).with_columns(pl.lit(value).alias(name) for name, value in identity.items())
        )
    weights = pl.concat(parts).with_columns(
        pl.col("replan").cast(pl.Int64), pl.col("task_id", "episode_index").cast(pl.Int64)
    )
    return rows.join(weights, on=[*EPISODE_ID, "replan"], how="left", maintain_order="left")
