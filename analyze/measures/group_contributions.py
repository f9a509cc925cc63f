"""Norms of the contribution of each group of a grouping to the residual stream at one site, from stored Gram matrices.

The matrices are of whole segments (a span's keys of one role). Contributions add up as vectors and not as lengths: the
norm of a union of segments is sqrt(wᵀ G w). A group that takes only a part of a segment (a word, a patch, an object)
has no norm.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.measures.contributions import joint_norm, selected_gram
from vla_attention.analyze.measures.frames import (
    EPISODE_ID,
    LAYERS_AVG,
    Tables,
    concat_tables,
    denoise_axis,
    layer_axis,
    long_table,
    replan_axis,
)
from vla_attention.analyze.measures.masses import ratio
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.measures.selected import SelectedEpisode
from vla_attention.analyze.statistics.bootstrap import POSITIVE
from vla_attention.analyze.statistics.episode_intervals import means_with_intervals
from vla_attention.analyze.stores.parallel import map_episodes
from vla_attention.schemas.groupings.resolve import ResolvedGrouping
from vla_attention.schemas.segments import segment_members, weights_on_segments


def whole_segments(item: SelectedEpisode, resolved: ResolvedGrouping, site: str) -> dict[str, NDArray[np.bool_]]:
    """The parts of the Gram matrix that each group takes, (part,) bool; groups that cut a segment are left out.

    A group must take a segment whole or not at all, and the same ones at every replan that has the segment. The
    matrix's last part is the block's whole update, and belongs to no group.
    """
    tokens, segments = item.tokens, item.episode.attributes.segments[site]
    members = segment_members(tokens.layout, tokens.static_roles, segments)
    present = members.any(axis=1)
    parts = {}
    for i, name in enumerate(resolved.names):
        weights = weights_on_segments(resolved.weights[:, :, i : i + 1], members)
        if weights is None:
            continue
        taken = weights[:, :, 0].max(axis=0)
        if np.isin(taken, (0.0, 1.0)).all() and (~present | (weights[:, :, 0] == taken)).all():
            parts[name] = np.array([*(taken == 1.0), False])
    return parts


def group_contribution_tables(question: Question, resolved: Sequence[ResolvedGrouping]) -> Tables | None:
    """Norms for every (episode, replan, layer, denoise step); None without records or where every group cuts a segment.

    Norms are root mean squares over the action queries.

    Returns:
        cells: suite, task_id, episode_index, replan, env_step, layer, block, denoise_step; when the grouping has a
            ratio of groups that can be measured, numerator_norm, denominator_norm (of the vector sum of a side's
            groups) and contribution_ratio, their quotient.
        groups: the same names, group, norm; of every group that is made of whole segments in all episodes.
    """
    if not all(store.attributes.recording.contributions for store in question.stores):
        return None
    chosen = [
        whole_segments(item, groups, question.site) for item, groups in zip(question.selected, resolved, strict=True)
    ]
    # A group that cannot be measured in one episode would be a mean over the others only.
    names = [name for name in question.grouping.names if all(name in parts for parts in chosen)]
    if not names:
        return None
    return concat_tables(
        map_episodes(
            lambda pair: _episode_norms(pair[0], {name: pair[1][name] for name in names}, question),
            list(zip(question.selected, chosen, strict=True)),
        )
    )


def _episode_norms(item: SelectedEpisode, parts: Mapping[str, NDArray[np.bool_]], question: Question) -> Tables:
    selection, grouping = question.selection, question.grouping
    gram = selected_gram(item.episode, question.site, selection)
    norms = np.stack([joint_norm(gram, taken) for taken in parts.values()], axis=-1)
    sides: dict[str, NDArray[np.float64]] = {}
    if grouping.ratio is not None and {*grouping.ratio.numerator, *grouping.ratio.denominator} <= parts.keys():
        above, below = (
            joint_norm(gram, np.any([parts[name] for name in side], axis=0))
            for side in (grouping.ratio.numerator, grouping.ratio.denominator)
        )
        sides = {"numerator_norm": above, "denominator_norm": below, "contribution_ratio": ratio(above, below)}
    axes = [replan_axis(item), layer_axis(selection), denoise_axis(selection)]
    return Tables(
        long_table(item, axes, sides),
        long_table(item, [*axes, {"group": list(parts)}], {"norm": norms}),
    )


def _episode_means(table: pl.DataFrame, measure: pl.Expr, *by: str) -> pl.DataFrame:
    """Means over replans and denoise steps, one row per (episode, layer or "layers_avg", `by`); `layer` is a string.

    A block that was named by two layer numbers counts once in "layers_avg".
    """
    once = table.select("layer", "block").unique(maintain_order=True).unique("block", keep="first")["layer"]
    layers = table.group_by(*EPISODE_ID, "layer", *by, maintain_order=True).agg(measure)
    average = table.filter(pl.col("layer").is_in(once.implode())).group_by(*EPISODE_ID, *by, maintain_order=True)
    return pl.concat(
        [
            layers.with_columns(pl.col("layer").cast(pl.String)),
            average.agg(measure).with_columns(pl.lit(LAYERS_AVG).alias("layer")).select(layers.columns),
        ]
    )


def norms_by_layer(tables: Tables) -> dict[tuple[str, str], float]:
    """By (layer, group): mean over episodes of the mean norm."""
    episodes = pl.concat([_episode_means(part.groups, pl.col("norm").mean(), "group") for part in tables.parts])
    means = episodes.group_by("layer", "group", maintain_order=True).agg(pl.col("norm").mean())
    return {(layer, group): norm for layer, group, norm in means.iter_rows()}


def ratios_by_layer(cells: pl.DataFrame, seed: int) -> dict[str, dict[str, Any]]:
    """By layer: mean over episodes of the mean ratio of norms, with its interval; empty without a ratio."""
    if "contribution_ratio" not in cells.columns:
        return {}
    finite = pl.col("contribution_ratio").filter(pl.col("contribution_ratio").is_finite())
    episodes = _episode_means(cells, finite.mean())
    means = means_with_intervals(episodes, ["layer"], {"contribution_ratio": POSITIVE}, seed)
    return {row["layer"]: row for row in means.iter_rows(named=True)}
