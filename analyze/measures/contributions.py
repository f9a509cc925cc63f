"""Norms of the contributions of visual and of linguistic keys to the residual stream, from stored Gram matrices.

A mass measures how much attention keys get, not what they add. The contribution of a set of keys is a vector
(probabilities x values, through the output projection and gate; Kobayashi et al. 2020). Its norm follows from the Gram
matrix of the parts: |sum of the chosen parts| = sqrt(wᵀ G w). Unlike masses, norms of different sites are lengths in
the same space, so a norm of self-attention may be divided by one of cross-attention.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.measures.contribution_ratios import joint_norm, ratio_columns, selected_gram, uniform_weights
from vla_attention.analyze.measures.frames import TableInParts, denoise_axis, layer_axis, long_table, replan_axis
from vla_attention.analyze.measures.not_in_memory import MadeWhenAsked, OnDisk
from vla_attention.analyze.measures.selected import SelectedEpisode
from vla_attention.analyze.stores.parallel import each_episode
from vla_attention.analyze.stores.selection import Selection
from vla_attention.schemas.segments import Segment
from vla_attention.schemas.stores.reader import StoredEpisode
from vla_attention.schemas.stores.store_format import RootAttributes

#: Roles of the keys on each side of the ratio: the images that the policy sees now, and the text.
VISUAL_ROLES = ("image",)
LINGUISTIC_ROLES = ("bos", "template", "instruction", "text")


def contribution_table(
    selected: Sequence[SelectedEpisode], selection: Selection, layers: Sequence[int] | None = None
) -> TableInParts | None:
    """Norms of both sides for every (episode, replan, layer, denoise step); None without recorded contributions.

    Columns: suite, task_id, episode_index, replan, env_step, layer, block, denoise_step, visual_norm, linguistic_norm,
    contribution_ratio (visual / linguistic; infinite or null where the denominator is 0), uniform_ratio and ratio_lift
    (see `contribution_ratios`). A side is read at the site that has such keys: both at `joint` for
    pi, `self` and `cross` for Cosmos. None also when a run has no such keys.

    Where the two sites are in different blocks, a ratio inside a block is undefined: the rows then are of the blocks of
    both, with the norm of the side that the block has, no ratio, and the columns `visual_norm_of_uniform` and
    `linguistic_norm_of_uniform`, from which `contribution_rows` makes the ratio over blocks.

    Args:
        selected: the episodes.
        selection: layers and denoise steps, at the question's site.
        layers: the layers that the user chose, None for all; needed for sites in other blocks.
    """
    if not all(item.store.attributes.recording.contributions for item in selected):
        return None

    norms = OnDisk(each_episode(partial(_episode_norms, selection=selection, layers=layers), selected))
    if not all(norms[i] for i in range(len(norms))):
        return None
    return TableInParts(MadeWhenAsked(lambda i: _table(selected[i], selection, norms[i]), range(len(selected))))


def _table(item: SelectedEpisode, selection: Selection, norms: dict[str, NDArray[Any]]) -> pl.DataFrame:
    layer = {name: norms.pop(name) for name in ("layer", "block")}
    return long_table(item, [replan_axis(item), layer, denoise_axis(selection)], norms)


def _episode_norms(
    item: SelectedEpisode, selection: Selection, layers: Sequence[int] | None
) -> dict[str, NDArray[Any]]:
    """The columns of one episode's norms (replan, layer, denoise), and the layers' labels; empty without a side."""
    root, episode = item.store.attributes, item.episode
    sides = [_parts_of_side(root, episode, roles) for roles in (VISUAL_ROLES, LINGUISTIC_ROLES)]
    if len({root.recording_of(side[0]).layers for side in sides if side}) > 1:
        return _of_different_blocks(item, selection, layers, [side for side in sides if side])
    sites = {side[0] for side in sides if side}
    grams = {site: selected_gram(item, site, selection) for site in sites}
    uniform = {site: uniform_weights(item, site, selection) for site in sites}
    norms = [
        (joint_norm(grams[side[0]], side[1]), joint_norm(grams[side[0]], side[1], uniform[side[0]]))
        for side in sides
        if side is not None
    ]
    if len(norms) < len(sides):
        return {}
    visual, linguistic = norms
    labels = {name: np.array(values) for name, values in layer_axis(selection).items()}
    return {**labels, "visual_norm": visual[0], "linguistic_norm": linguistic[0], **ratio_columns(visual, linguistic)}


def _of_different_blocks(
    item: SelectedEpisode,
    selection: Selection,
    layers: Sequence[int] | None,
    sides: Sequence[tuple[str, NDArray[np.bool_]]],
) -> dict[str, NDArray[Any]]:
    """The same where the sides are at sites in different blocks; empty where no chosen block has one of the sides."""
    root = item.store.attributes
    blocks_of = {
        site: tuple(b for b in root.recording_of(site).layers if layers is None or b in layers) for site, _ in sides
    }
    if len(sides) < 2 or not all(blocks_of.values()):
        return {}
    union = sorted({block for blocks in blocks_of.values() for block in blocks})
    shape = (item.tokens.num_replans, len(union), len(selection.denoise))
    values: dict[str, NDArray[Any]] = {"layer": np.array(union), "block": np.array(union)}
    for name, (site, parts) in zip(("visual_norm", "linguistic_norm"), sides, strict=True):
        recorded = root.recording_of(site).layers
        own = replace(selection, layers=tuple(recorded.index(block) for block in blocks_of[site]))
        gram, uniform = selected_gram(item, site, own), uniform_weights(item, site, own)
        at = [union.index(block) for block in blocks_of[site]]
        for column, norm in ((name, joint_norm(gram, parts)), (f"{name}_of_uniform", joint_norm(gram, parts, uniform))):
            values[column] = np.full(shape, np.nan)
            values[column][:, at] = norm
    return values | dict.fromkeys(("contribution_ratio", "uniform_ratio", "ratio_lift"), np.full(shape, np.nan))


def _parts_of_side(
    root: RootAttributes, episode: StoredEpisode, roles: Sequence[str]
) -> tuple[str, NDArray[np.bool_]] | None:
    """The first site that has segments with these roles, and which parts they are, (part,)."""
    for site in root.sites:
        segments: tuple[Segment, ...] = episode.attributes.segments[site.name]
        # The last part is the whole update of the block, and belongs to neither side.
        parts = np.array([*(segment.role in roles for segment in segments), False])
        if parts.any():
            return site.name, parts
    return None
