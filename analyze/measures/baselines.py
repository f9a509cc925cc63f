"""What uniform attention gives keys and groups of an episode: stored from version 2 on, made from roles before."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from vla_attention.analyze.measures.selected import SelectedEpisode
from vla_attention.analyze.stores.selection import Selection
from vla_attention.schemas.errors import listing
from vla_attention.schemas.groupings.key_counts import uniform_of_version_1
from vla_attention.schemas.stores.reader import Store
from vla_attention.schemas.stores.store_format import CALLERS_MODULES

Array = NDArray[np.float64]


def uniform_keys(item: SelectedEpisode, selection: Selection) -> Array:
    """What uniform attention gives every key, see `schemas/groupings/key_counts.py`.

    Returns:
        (replan, layer, denoise, head, key) of the selection, mean over the stored queries and, unless heads are kept
        apart, over heads; an axis along which nothing changes may have length 1.
    """
    tokens, episode = item.tokens, item.episode
    name = f"{tokens.layout.name}/uniform"
    if item.store.attributes.store_version == 1:
        roles = tokens.static_roles
        return uniform_of_version_1(tokens.layout, roles, item.valid, tokens.num_queries)[:, None, None, None]
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


def baseline_notes(stores: Sequence[Store]) -> tuple[str, ...]:
    """The line about stores of version 1 whose baseline may be that of too many keys; empty where there are none.

    In policies that `vla-capture` builds all queries of a replan see the same keys, but for a growing span, which is
    counted; in other policies of torch nobody noted who sees what.
    """
    names = [store.path.name for store in stores if _is_recorded_in_version_1(store)]
    if not names:
        return ()
    return (
        f"Baselines of {listing(names)} (version 1) are of the keys that any query of any layer sees; where queries or "
        "layers see different keys, lifts are off. A new recording has baselines by query and layer.",
    )


def contribution_notes(stores: Sequence[Store]) -> tuple[str, ...]:
    """The line about stores of version 1 whose contributions may not be what keys add; empty where there are none."""
    names = [
        store.path.name
        for store in stores
        if _is_recorded_in_version_1(store) and store.attributes.recording.contributions
    ]
    if not names:
        return ()
    return (
        f"Contributions of {listing(names)} (version 1) end at the output projection; where the policy has a gate or a "
        "norm behind it, they are off. A new recording follows them to the residual stream.",
    )


def _is_recorded_in_version_1(store: Store) -> bool:
    attributes = store.attributes
    return attributes.store_version == 1 and attributes.policy.checkpoint_format == CALLERS_MODULES
