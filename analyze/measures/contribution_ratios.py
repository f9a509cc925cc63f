"""Ratios of contribution norms over episodes, beside what uniform attention would give.

The baseline. A part i of the keys (a segment) adds the vector c_i, which attention has weighted; its mass is m_i, the
mean over heads and queries. Uniform attention would give it the part s_i of what it gives all valid keys of the site
(`schemas/groupings/key_counts.py`; n_i / N where all queries see the same N keys), and it would then add about

    s_i / m_i * c_i

so that the norm of a side is sqrt(uᵀ G u) with u_i = s_i / m_i for its parts. For uniform attention this is the
norm itself, and lift = ratio / uniform ratio is 1. Between parts it is exact where attention is even inside each of
them. Otherwise the mean value of a part as attention weights it stands for the plain mean of its values, and the mean
over heads for each head: the store has no values of single keys. So the lift tells how attention is shared out between
parts, as that of masses does, while the uniform ratio tells what the values alone make of a ratio: how long and how
much of one direction they are. Unlike masses, both may be given for sides at different sites.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.measures.baselines import uniform_keys, uniform_masses
from vla_attention.analyze.measures.frames import EPISODE_ID, LAYERS_AVG, in_larger_parts
from vla_attention.analyze.measures.masses import ratio
from vla_attention.analyze.measures.selected import SelectedEpisode
from vla_attention.analyze.statistics.episode_intervals import Sampling, means_with_intervals
from vla_attention.analyze.statistics.intervals import DEFAULT_LEVEL, NO_LIMITS, POSITIVE
from vla_attention.analyze.stores.selection import Selection
from vla_attention.schemas.segments import segment_members
from vla_attention.schemas.stores.store_format import RootAttributes

Array = NDArray[np.float64]


def selected_gram(item: SelectedEpisode, site: str, selection: Selection) -> NDArray[np.float32]:
    """The Gram matrices (replan, layer, denoise, part, part) of the selected layers and denoise steps."""
    gram: NDArray[np.float32] = item.episode.read(f"{site}/contribution")
    return gram[:, list(selection.layers)][:, :, list(selection.denoise)]


def has_all_heads(root: RootAttributes, site: str) -> bool:
    """Whether all heads of a site were recorded."""
    return len(root.recording_of(site).heads) == (root.site(site).heads or root.policy.num_heads)


def joint_norm(gram: NDArray[np.floating], chosen: NDArray[np.bool_], weights: Array | None = None) -> Array:
    """Norm of the chosen parts' summed contribution (root mean square over the queries): sqrt(wᵀ G w).

    gram: (..., part, part); chosen: (part,) bool; weights: (..., part) of the parts, 1 without. Returns (...). Rounding
    may leave tiny negative squares: they are 0.
    """
    part = np.flatnonzero(chosen)
    inner = gram[..., part[:, None], part]
    if weights is not None:
        inner = inner * weights[..., part, None] * weights[..., None, part]
    norm: Array = np.sqrt(np.clip(inner.sum(axis=(-2, -1), dtype=np.float64), 0.0, None))
    return norm


def segment_masses(item: SelectedEpisode, site: str, selection: Selection) -> Array:
    """Masses (replan, layer, denoise, segment) of the selected layers and denoise steps, mean over all stored heads."""
    atoms = item.episode.read(f"{site}/atoms")[:, list(selection.layers)][:, :, list(selection.denoise)]
    return np.asarray(atoms.mean(axis=(3, 4), dtype=np.float64))


def uniform_weights(item: SelectedEpisode, site: str, selection: Selection) -> Array:
    """u_i of every part (replan, layer, denoise, part): its mass under uniform attention / its mass.

    0 for keys that are not valid, NaN for a valid part without mass, and NaN everywhere where not all heads were
    recorded, because contributions are of all heads. The block's whole update, the last part, is in no side: NaN.
    """
    root = item.store.attributes
    segments, tokens = item.episode.attributes.segments[site], item.episode.tokens(root, site)
    members = segment_members(tokens.layout, tokens.static_roles, segments) & tokens.valid[:, :, None]
    # All stored heads and all keys, also where some were taken out: contributions are of all.
    whole = replace(selection, heads=tuple(range(len(root.recording_of(site).heads))), per_head=False)
    here = replace(item, tokens=tokens, without=())
    uniform = uniform_masses(uniform_keys(here, whole), members.astype(np.float32))[:, :, :, 0]
    share = uniform / uniform.sum(axis=-1, keepdims=True)
    mass = segment_masses(item, site, selection)
    if not has_all_heads(root, site):
        mass = np.full_like(mass, np.nan)
    with np.errstate(divide="ignore", invalid="ignore"):
        weights = np.where(share > 0, np.where(mass > 0, share / mass, np.nan), 0.0)
    return np.concatenate([weights, np.full((*weights.shape[:-1], 1), np.nan)], axis=-1)


def ratio_columns(above: tuple[Array, Array], below: tuple[Array, Array]) -> dict[str, Array]:
    """`contribution_ratio`, `uniform_ratio`, `ratio_lift`; each side is its norm and its norm of uniform attention."""
    value, uniform = ratio(above[0], below[0]), ratio(above[1], below[1])
    return {"contribution_ratio": value, "uniform_ratio": uniform, "ratio_lift": ratio(value, uniform)}


def episode_means(table: pl.DataFrame, *measures: pl.Expr, by: tuple[str, ...] = ()) -> pl.DataFrame:
    """Means over replans and denoise steps, one row per (episode, layer or "layers_avg", `by`); `layer` is a string.

    A block that was named by two layer numbers counts once in "layers_avg".
    """
    once = table.select("layer", "block").unique(maintain_order=True).unique("block", keep="first")["layer"]
    layers = table.group_by(*EPISODE_ID, "layer", *by, maintain_order=True).agg(*measures)
    average = table.filter(pl.col("layer").is_in(once.implode())).group_by(*EPISODE_ID, *by, maintain_order=True)
    return pl.concat(
        [
            layers.with_columns(pl.col("layer").cast(pl.String)),
            average.agg(*measures).with_columns(pl.lit(LAYERS_AVG).alias("layer")).select(layers.columns),
        ]
    )


def _with_ratio_over_blocks(
    episodes: pl.DataFrame, table: pl.DataFrame, above: str, below: str, logs: dict[str, pl.Expr]
) -> pl.DataFrame:
    """The rows of `episode_means` with ratios of each side's mean over its blocks in "layers_avg"."""
    once = table.unique([*EPISODE_ID, "replan", "denoise_step", "block"], keep="first", maintain_order=True)
    sides = (above, below, f"{above}_of_uniform", f"{below}_of_uniform")
    steps = once.group_by(*EPISODE_ID, "replan", "denoise_step", maintain_order=True).agg(pl.col(sides).mean())
    steps = steps.with_columns(
        (pl.col(above) / pl.col(below)).alias("contribution_ratio"),
        (pl.col(sides[2]) / pl.col(sides[3])).alias("uniform_ratio"),
    ).with_columns((pl.col("contribution_ratio") / pl.col("uniform_ratio")).alias("ratio_lift"))
    ratios = steps.group_by(*EPISODE_ID, maintain_order=True).agg(
        pl.col("contribution_ratio").filter(pl.col("contribution_ratio").is_finite()).mean().alias("ratio_mean"),
        *(log.filter(log.is_finite()).mean().alias(name) for name, log in logs.items()),
    )
    average = pl.col("layer") == LAYERS_AVG
    whole = (
        episodes.filter(average)
        .drop("ratio_mean", *logs)
        .join(ratios, on=EPISODE_ID, how="left", maintain_order="left")
    )
    return pl.concat([episodes.filter(~average), whole.select(episodes.columns)])


def contribution_rows(
    parts: Iterable[pl.DataFrame], above: str, below: str, sampling: Sampling, level: float = DEFAULT_LEVEL
) -> pl.DataFrame:
    """Norms and their ratio of every layer and over all of them ("layers_avg"), over episodes, with intervals.

    Args:
        parts: one row per (episode, replan, layer, denoise step), with the norms and `ratio_columns`; a part holds
            whole episodes.
        above: the column of the numerator's norm.
        below: the column of the denominator's norm.
        sampling: what the intervals are about, and which tasks are related.
        level: of the intervals.

    Returns:
        layer, layer_number (null for the average); means of `above` and `below`, geometric mean uniform_ratio; and with
        `_low` and `_high`
            geometric_mean    exp of the mean log ratio
            ratio_lift        geometric mean of ratio / uniform ratio
            ratio_mean        mean of the episodes' mean ratios of norms
            ratio_of_means    mean `above` / mean `below`
        Ratios that are infinite or undefined are in no mean but `ratio_of_means`.

        Where the sides are in different blocks (the columns `..._of_uniform`, see `contributions`), single layers have
        norms and no ratio. The ratios over all of them are, at every replan and denoise step, of the means of each
        side's norm over its blocks.
    """
    logs = {
        name: pl.col(column).log()
        for name, column in (
            ("geometric_mean", "contribution_ratio"),
            ("uniform_ratio", "uniform_ratio"),
            ("ratio_lift", "ratio_lift"),
        )
    }
    means = [
        pl.col(above, below).mean(),
        pl.col("contribution_ratio").filter(pl.col("contribution_ratio").is_finite()).mean().alias("ratio_mean"),
        *(log.filter(log.is_finite()).mean().alias(name) for name, log in logs.items()),
    ]
    of_parts = []
    for table in in_larger_parts(parts):
        of_part = episode_means(table, *means)
        if f"{above}_of_uniform" in table.columns:
            of_part = _with_ratio_over_blocks(of_part, table, above, below, logs)
        of_parts.append(of_part)
    episodes = pl.concat(of_parts)
    values = dict.fromkeys((above, below, "ratio_mean"), POSITIVE) | dict.fromkeys(logs, NO_LIMITS)
    quotients = {"ratio_of_means": (above, below)}
    rows = means_with_intervals(episodes, ["layer"], values, sampling, level, quotients=quotients)
    bounded = ("ratio_mean", "ratio_of_means", "geometric_mean", "ratio_lift")
    return rows.with_columns(pl.col(rf"^({'|'.join(logs)})(_low|_high)?$").exp()).select(
        "layer",
        pl.col("layer").cast(pl.Int64, strict=False).alias("layer_number"),
        above,
        below,
        "uniform_ratio",
        *(f"{name}{end}" for name in bounded for end in ("", "_low", "_high")),
    )
