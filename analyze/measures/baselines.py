"""What uniform attention gives keys and groups of an episode, as it is stored."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vla_attention.analyze.measures.selected import SelectedEpisode
from vla_attention.analyze.stores.selection import Selection

Array = NDArray[np.float64]


def uniform_keys(item: SelectedEpisode, selection: Selection) -> Array:
    """What uniform attention gives every key, see `schemas/groupings/key_counts.py`.

    Returns:
        (replan, layer, denoise, head, key) of the selection, mean over the stored queries and, unless heads are kept
        apart, over heads; an axis along which nothing changes may have length 1.
    """
    episode, name = item.episode, f"{item.tokens.layout.name}/uniform"
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


def uniform_masses(uniform: Array, weights: NDArray[np.float32]) -> Array:
    """What uniform attention gives groups: (replan or 1, layer, denoise, head, group).

    Args:
        uniform: of every key, see `uniform_keys`.
        weights: (replan or 1, key, group), in 0..1.
    """
    if weights.strides[0] == 0:  # the same at all replans, see `stack_over_keys`
        weights = weights[:1]
    replans, *cells, keys = uniform.shape
    masses: Array = np.matmul(uniform.reshape(replans, -1, keys), weights.astype(np.float64))
    return masses.reshape(len(masses), *cells, weights.shape[2])
