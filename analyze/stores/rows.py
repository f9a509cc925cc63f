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
        rows: probabilities (replan, head, key) float32, mean over the stored queries, of the selected heads.
    """

    layer: int
    denoise: int
    rows: NDArray[np.float32]

    def of_heads(self, selection: Selection) -> NDArray[np.float32]:
        """The rows (replan, head or 1, key): their mean over heads unless the selection keeps heads apart."""
        return self.rows if selection.per_head else self.rows.mean(axis=1, keepdims=True)


def layer_rows(episode: StoredEpisode, selection: Selection, site: str) -> Iterator[LayerRows]:
    """Read the selected layers and denoise steps of an episode one after the other."""
    stored = episode.array(f"{site}/rows").shape[3]
    # A slice where it can be one: picking heads by their numbers copies every row.
    heads = slice(None) if selection.heads == tuple(range(stored)) else list(selection.heads)
    for i, layer in enumerate(selection.layers):
        for j, step in enumerate(selection.denoise):
            rows = episode.read_layer(f"{site}/rows", layer, step)[:, heads]
            yield LayerRows(i, j, rows.mean(axis=2) if rows.shape[2] > 1 else rows[:, :, 0])
