"""From rows and weights to masses, and what uniform attention gives. Arithmetic on arrays, and the stored baseline."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vla_attention.analyze.measures.selected import SelectedEpisode
from vla_attention.analyze.stores.selection import Selection
from vla_attention.schemas.groupings.grouping import Grouping
from vla_attention.schemas.groupings.key_counts import stored_uniform_of_roles

Array = NDArray[np.float64]


def masses(rows: NDArray[np.float32], weights: NDArray[np.float32]) -> Array:
    """Mass of each group: the sum over keys of probability x weight.

    One product per replan, or a single one for weights that never change; float32 sums err by about 3e-7.

    Args:
        rows: (replan, ..., key), or segment masses (replan, ..., segment).
        weights: (replan or 1, key, group), in 0..1.

    Returns:
        (replan, ..., group).
    """
    flat = rows.reshape(rows.shape[0], -1, rows.shape[-1])
    product = flat.reshape(-1, flat.shape[-1]) @ weights[0] if len(weights) == 1 else np.matmul(flat, weights)
    return np.asarray(product.reshape(*rows.shape[:-1], weights.shape[2]), dtype=np.float64)


def uniform_keys(item: SelectedEpisode, selection: Selection) -> Array:
    """What uniform attention gives every key, see `schemas/groupings/key_counts.py`.

    Returns:
        (replan, layer, denoise, head, key) of the selection, mean over the stored queries and, unless heads are kept
        apart, over heads; an axis along which nothing changes may have length 1.
    """
    episode, name = item.episode, f"{item.tokens.layout.name}/uniform"
    if not episode.has(name):
        return stored_uniform_of_roles(item.tokens.static_roles)[:, 0].astype(np.float64)
    _, layers, denoise, heads, _, _ = episode.shape_of(name)
    places = [
        (layer, step)
        for layer in (selection.layers if layers > 1 else (0,))
        for step in (selection.denoise if denoise > 1 else (0,))
    ]
    parts = []
    for values in episode.read_layers(name, places):  # (replan or 1, head or 1, query or 1, key)
        episode.refuse_missing(name, values)
        of_heads = values[:, list(selection.heads)] if heads > 1 else values
        parts.append(of_heads.mean(axis=(2,) if selection.per_head else (1, 2), dtype=np.float64))
    stacked = np.stack(parts, axis=1)
    replans, _, *rest = stacked.shape
    rest = rest if selection.per_head else [1, *rest]
    return stacked.reshape(replans, len(selection.layers) if layers > 1 else 1, -1, *rest)


def mean_of_layers(values: Array, selection: Selection) -> Array:
    """Mean over the layers (axis 1); a block that two layer numbers name counts once, an axis of length 1 is all."""
    mean: Array = (values[:, list(selection.once)] if values.shape[1] > 1 else values).mean(axis=1)
    return mean


def uniform_masses(uniform: Array, weights: NDArray[np.float32]) -> Array:
    """What uniform attention gives groups: (replan or 1, layer, denoise, head, group).

    Args:
        uniform: of every key, see `uniform_keys`.
        weights: (replan or 1, key, group), in 0..1.
    """
    if weights.strides[0] == 0:  # the same at all replans, see `stack_over_keys`
        weights = weights[:1]
    replans, *cells, keys = uniform.shape
    found: Array = np.matmul(uniform.reshape(replans, -1, keys), weights.astype(np.float64))
    return found.reshape(len(found), *cells, weights.shape[2])


def uniform_ratio(uniform_mass: Array, grouping: Grouping) -> Array:
    """The ratio that uniform attention gives (...), from what it gives the groups (..., group); as in `ratio`."""
    assert grouping.ratio is not None
    sides = (grouping.ratio.numerator, grouping.ratio.denominator)
    above, below = (uniform_mass[..., [grouping.names.index(name) for name in side]].sum(axis=-1) for side in sides)
    return ratio(above, below)


def ratio(numerator: Array, denominator: Array) -> Array:
    """numerator / denominator: infinite where only the denominator is 0, NaN (undefined) where both are."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return numerator / denominator


def finite_mean(values: Array, axis: int | tuple[int, ...] = 0) -> Array:
    """Mean over the finite values along one axis or several; NaN where there is none."""
    finite = np.isfinite(values)
    count = finite.sum(axis=axis)
    with np.errstate(invalid="ignore"):
        mean: Array = np.where(finite, values, 0.0).sum(axis=axis) / np.where(count > 0, count, np.nan)
    return mean
