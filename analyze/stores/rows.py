"""Rows of one episode, one layer and denoise step at a time: no analysis holds all rows of an episode."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vla_attention.analyze.stores.selection import Selection
from vla_attention.schemas.stores.reader import StoredEpisode


@dataclass(frozen=True)
class LayerRows:
    """Rows of one recorded layer at one recorded denoise step.

    Attributes:
        layer: position in the selection's layers.
        denoise: position in the selection's denoise steps.
        rows: probabilities (replan, head, key) float32, mean over the stored queries, of the selected heads; or their
            mean over these heads, (replan, 1, key).
    """

    layer: int
    denoise: int
    rows: NDArray[np.float32]


def layer_rows(
    episode: StoredEpisode, selection: Selection, site: str, per_head: bool | None = None
) -> Iterator[LayerRows]:
    """Read the selected layers and denoise steps of an episode one after the other.

    All are read into the same memory: each is gone when the next one is asked for.

    Args:
        episode: where the rows are.
        selection: which layers, denoise steps and heads.
        site: the softmax family.
        per_head: keep heads apart; as in the selection unless it is given.
    """
    name = f"{site}/rows"
    # A slice where it can be one: picking heads by their numbers copies every row.
    replans, *_, stored, queries, keys = episode.shape_of(name)
    heads = slice(None) if selection.heads == tuple(range(stored)) else list(selection.heads)
    apart = selection.per_head if per_head is None else per_head
    # Means too are written into memory that stays: new memory for each would be asked of the system again and again.
    of_queries = np.empty((replans, len(selection.heads), keys), np.float32) if queries > 1 else None
    of_heads = None if apart else np.empty((replans, keys), np.float32)
    cells = [(i, j) for i in range(len(selection.layers)) for j in range(len(selection.denoise))]
    places = [(selection.layers[i], selection.denoise[j]) for i, j in cells]
    for (i, j), whole in zip(cells, episode.read_layers(name, places), strict=True):
        rows = whole[:, heads]
        rows = rows[:, :, 0] if of_queries is None else _mean_into(of_queries, rows, 2)
        if of_heads is not None:
            rows = _mean_into(of_heads, rows, 1)[:, None]
        episode.refuse_missing(name, rows)
        yield LayerRows(i, j, rows)


def _mean_into(memory: NDArray[np.float32], values: NDArray[np.float32], axis: int) -> NDArray[np.float32]:
    """The mean over one axis: to the last bit that of `values.mean`, which divides in float64 and is slower."""
    np.add.reduce(values, axis=axis, out=memory)
    return np.divide(memory, np.float32(values.shape[axis]), out=memory)
