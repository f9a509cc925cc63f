"""Norms of the contribution of each group of a grouping to the residual stream at one site, from stored Gram matrices.

The matrices are of whole segments (a span's keys of one role). Contributions add up as vectors and not as lengths: the
norm of a union of segments is sqrt(wᵀ G w). A group that takes only a part of a segment (a word, a patch, an object)
has no norm.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.measures.contribution_ratios import (
    contribution_rows,
    episode_means,
    joint_norm,
    ratio_columns,
    selected_gram,
    uniform_weights,
)
from vla_attention.analyze.measures.frames import (
    Tables,
    cells_in_parts,
    denoise_axis,
    groups_in_parts,
    in_larger_parts,
    layer_axis,
    long_table,
    replan_axis,
    tables_of_each,
)
from vla_attention.analyze.measures.not_in_memory import MadeWhenAsked, OnDisk
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.measures.selected import SelectedEpisode, resolve_episode
from vla_attention.analyze.statistics.episode_intervals import Sampling
from vla_attention.analyze.stores.parallel import each_episode, map_episodes
from vla_attention.analyze.stores.selection import Selection
from vla_attention.schemas.groupings.grouping import Grouping
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


def group_contribution_tables(question: Question, resolved: Sequence[ResolvedGrouping] | None = None) -> Tables | None:
    """Norms for every (episode, replan, layer, denoise step); None without records or where every group cuts a segment.

    Norms are root mean squares over the action queries.

    Returns:
        cells: suite, task_id, episode_index, replan, env_step, layer, block, denoise_step; when the grouping has a
            ratio of groups that can be measured, numerator_norm, denominator_norm (of the vector sum of a side's
            groups), contribution_ratio, their quotient, uniform_ratio and ratio_lift (see `contribution_ratios`).
        groups: the same names, group, norm; of every group that is made of whole segments in all episodes.
    """
    if not all(store.attributes.recording.contributions for store in question.stores):
        return None
    known = [None] * len(question.selected) if resolved is None else resolved
    take = partial(_segments_of_groups, site=question.site, grouping=question.grouping)
    chosen = map_episodes(take, zip(question.selected, known, strict=True))
    # A group that cannot be measured in one episode would be a mean over the others only.
    names = [name for name in question.grouping.names if all(name in parts for parts in chosen)]
    if not names:
        return None
    measure = partial(_episode_norms, selection=question.selection, site=question.site, grouping=question.grouping)
    measurable = [{name: parts[name] for name in names} for parts in chosen]
    kept = OnDisk(each_episode(measure, zip(question.selected, measurable, strict=True)))
    norms = MadeWhenAsked(lambda i: (question.selected[i], kept[i]), range(len(question.selected)))
    return tables_of_each(norms, lambda one: _norm_tables(*one, names, question.selection))


def _segments_of_groups(
    pair: tuple[SelectedEpisode, ResolvedGrouping | None], site: str, grouping: Grouping
) -> dict[str, NDArray[np.bool_]]:
    item, resolved = pair
    return whole_segments(item, resolved or resolve_episode(grouping, item), site)


def _episode_norms(
    pair: tuple[SelectedEpisode, Mapping[str, NDArray[np.bool_]]], selection: Selection, site: str, grouping: Grouping
) -> dict[str, NDArray[np.float64]]:
    """`norm` (replan, layer, denoise, group), and the measures of both sides (replan, layer, denoise)."""
    item, parts = pair
    gram = selected_gram(item, site, selection)
    found = {"norm": np.stack([joint_norm(gram, taken) for taken in parts.values()], axis=-1)}
    if grouping.ratio is not None and {*grouping.ratio.numerator, *grouping.ratio.denominator} <= parts.keys():
        uniform = uniform_weights(item, site, selection)
        above, below = (
            (joint_norm(gram, taken), joint_norm(gram, taken, uniform))
            for side in (grouping.ratio.numerator, grouping.ratio.denominator)
            for taken in [np.any([parts[name] for name in side], axis=0)]
        )
        found |= {"numerator_norm": above[0], "denominator_norm": below[0], **ratio_columns(above, below)}
    return found


def _norm_tables(
    item: SelectedEpisode, values: Mapping[str, NDArray[np.float64]], names: Sequence[str], selection: Selection
) -> Tables:
    axes = [replan_axis(item), layer_axis(selection), denoise_axis(selection)]
    cells = {name: array for name, array in values.items() if name != "norm"}
    return Tables(
        lambda: long_table(item, axes, cells),
        lambda: long_table(item, [*axes, {"group": list(names)}], {"norm": values["norm"]}),
    )


def norms_by_layer(tables: Tables) -> dict[tuple[str, str], float]:
    """By (layer, group): mean over episodes of the mean norm."""
    parts = in_larger_parts(groups_in_parts(tables))
    episodes = pl.concat([episode_means(part, pl.col("norm").mean(), by=("group",)) for part in parts])
    means = episodes.group_by("layer", "group", maintain_order=True).agg(pl.col("norm").mean())
    return {(layer, group): norm for layer, group, norm in means.iter_rows()}


def have_ratio(tables: Tables) -> bool:
    """Whether the grouping has a ratio whose sides can be measured."""
    return "contribution_ratio" in tables.parts[0].cells.columns


def ratios_by_layer(tables: Tables, sampling: Sampling) -> dict[str, dict[str, Any]]:
    """By layer the rows of `contribution_ratios.contribution_rows`; empty without a ratio."""
    if not have_ratio(tables):
        return {}
    rows = contribution_rows(cells_in_parts(tables), "numerator_norm", "denominator_norm", sampling)
    return {row["layer"]: row for row in rows.iter_rows(named=True)}
