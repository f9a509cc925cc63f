"""Norms of the contributions of visual and of linguistic keys to the residual stream, from stored Gram matrices.

A mass measures how much attention keys get, not what they add. The contribution of a set of keys is a vector
(probabilities x values, through the output projection and gate; Kobayashi et al. 2020). Its norm follows from the Gram
matrix of the parts: |sum of the chosen parts| = sqrt(wᵀ G w). Unlike masses, norms of different sites are lengths in
the same space, so a norm of self-attention may be divided by one of cross-attention.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.measures.frames import (
    LAYERS_AVG,
    denoise_axis,
    float_values,
    layer_axis,
    long_table,
    replan_axis,
)
from vla_attention.analyze.measures.masses import ratio
from vla_attention.analyze.measures.selected import SelectedEpisode
from vla_attention.analyze.statistics.bootstrap import DEFAULT_LEVEL, POSITIVE, bootstrap_interval, mean_over_episodes
from vla_attention.analyze.stores.parallel import map_episodes
from vla_attention.analyze.stores.selection import Selection
from vla_attention.schemas.segments import Segment
from vla_attention.schemas.stores.reader import StoredEpisode
from vla_attention.schemas.stores.store_format import RootAttributes

#: Roles of the keys on each side of the ratio: the images that the policy sees now, and the text.
VISUAL_ROLES = ("image",)
LINGUISTIC_ROLES = ("bos", "template", "instruction", "text")


def joint_norm(gram: NDArray[np.floating], chosen: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Norm of the chosen parts' summed contribution (root mean square over the queries): sqrt(wᵀ G w).

    gram: (..., part, part); chosen: (part,) bool. Returns (...). Rounding may leave tiny negative squares: they are 0.
    """
    part = np.flatnonzero(chosen)
    squared = gram[..., part[:, None], part].sum(axis=(-2, -1), dtype=np.float64)
    norm: NDArray[np.float64] = np.sqrt(np.clip(squared, 0.0, None))
    return norm


def contribution_table(selected: Sequence[SelectedEpisode], selection: Selection) -> pl.DataFrame | None:
    """Norms of both sides for every (episode, replan, layer, denoise step); None without recorded contributions.

    Columns: suite, task_id, episode_index, replan, env_step, layer, block, denoise_step, visual_norm, linguistic_norm,
    contribution_ratio (visual / linguistic; infinite or null where the denominator is 0). A side is read at the site
    that has such keys: both at `joint` for pi, `self` and `cross` for Cosmos. None also when a run has no such keys.
    """
    if not all(item.store.attributes.recording.contributions for item in selected):
        return None

    def measure(item: SelectedEpisode) -> pl.DataFrame | None:
        root, episode = item.store.attributes, item.episode
        sides = [_parts_of_side(root, episode, roles) for roles in (VISUAL_ROLES, LINGUISTIC_ROLES)]
        grams = {site: selected_gram(episode, site, selection) for site in {side[0] for side in sides if side}}
        norms = [joint_norm(grams[side[0]], side[1]) for side in sides if side is not None]
        if len(norms) < len(sides):
            return None
        visual, linguistic = norms
        values = {"visual_norm": visual, "linguistic_norm": linguistic, "contribution_ratio": ratio(visual, linguistic)}
        return long_table(item, [replan_axis(item), layer_axis(selection), denoise_axis(selection)], values)

    frames = [frame for frame in map_episodes(measure, selected) if frame is not None]
    return pl.concat(frames) if len(frames) == len(selected) else None


def selected_gram(episode: StoredEpisode, site: str, selection: Selection) -> NDArray[np.float32]:
    """The Gram matrices (replan, layer, denoise, part, part) of the selected layers and denoise steps."""
    gram: NDArray[np.float32] = episode.read(f"{site}/contribution")
    return gram[:, list(selection.layers)][:, :, list(selection.denoise)]


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


def contribution_rows(table: pl.DataFrame, seed: int, level: float = DEFAULT_LEVEL) -> pl.DataFrame:
    """Norms and their ratio of every layer and over all of them ("layers_avg"): means over episodes.

    The ratio has a two-level interval. Columns: layer, layer_number, visual_norm, linguistic_norm, ratio (mean over
    episodes of the mean ratio of norms), ratio_low, ratio_high.
    """
    rows = [
        _summary_row(table.filter(layer=layer), str(layer), layer, seed, level)
        for layer in table["layer"].unique(maintain_order=True)
    ]
    once = table.unique(["suite", "task_id", "episode_index", "replan", "block", "denoise_step"], maintain_order=True)
    rows.append(_summary_row(once, LAYERS_AVG, None, seed, level))
    numbers = ("visual_norm", "linguistic_norm", "ratio", "ratio_low", "ratio_high")
    types = {"layer": pl.String, "layer_number": pl.Int64, **dict.fromkeys(numbers, pl.Float64)}
    return pl.DataFrame(rows, schema=types, orient="row")


def _summary_row(part: pl.DataFrame, label: str, number: int | None, seed: int, level: float) -> tuple[object, ...]:
    finite = pl.col("contribution_ratio").filter(pl.col("contribution_ratio").is_finite())
    episodes = part.group_by("suite", "task_id", "episode_index", maintain_order=True).agg(
        pl.col("visual_norm", "linguistic_norm").mean(), finite.mean().alias("ratio")
    )
    values = mean_over_episodes(float_values(episodes["ratio"]), POSITIVE)
    tasks = episodes.select(pl.struct("suite", "task_id").rank("dense")).to_series().to_numpy()
    interval = bootstrap_interval(values, tasks, level=level, seed=seed)
    norms = [episodes[f"{side}_norm"].cast(pl.Float64).mean() for side in ("visual", "linguistic")]
    bounds = (None, None) if interval is None else (interval.low, interval.high)
    return (label, number, *norms, values.value, *bounds)
