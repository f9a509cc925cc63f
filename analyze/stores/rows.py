"""Rows of one episode, one layer and denoise step at a time: no analysis holds all rows of an episode.

What is read is held against its stored sums.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from vla_attention.analyze.stores.selection import Selection
from vla_attention.schemas.stores.content_rules import add_up, row_problems
from vla_attention.schemas.stores.reader import StoredEpisode
from vla_attention.schemas.stores.store_format import CorruptEpisode, Recording, RootAttributes


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
    root: RootAttributes, episode: StoredEpisode, selection: Selection, site: str, per_head: bool | None = None
) -> Iterator[LayerRows]:
    """Read the selected layers and denoise steps of an episode one after the other.

    All are read into the same memory: each is gone when the next one is asked for.

    Args:
        root: of the episode's store.
        episode: where the rows are.
        selection: which layers, denoise steps and heads.
        site: the softmax family.
        per_head: keep heads apart; as in the selection unless it is given.

    Raises:
        CorruptEpisode: a chunk is not the one that was sealed, or rows do not add up to their stored sums.
    """
    name, recording = f"{site}/rows", root.recording_of(site)
    sums = episode.read(f"{site}/row_sum")  # (replan, layer, denoise, head, query)
    # A slice where it can be one: picking heads by their numbers copies every row.
    replans, *_, stored, queries, keys = episode.shape_of(name)
    heads = slice(None) if selection.heads == tuple(range(stored)) else list(selection.heads)
    apart = selection.per_head if per_head is None else per_head
    of_mean = queries if apart else queries * len(selection.heads)
    share = np.full((1, of_mean), 1 / of_mean, np.float32)
    # Means too are written into memory that stays: new memory for each would be asked of the system again and again.
    mean = np.empty((replans, len(selection.heads) if apart else 1, 1, keys), np.float32) if of_mean > 1 else None
    cells = [(i, j) for i in range(len(selection.layers)) for j in range(len(selection.denoise))]
    places = [(selection.layers[i], selection.denoise[j]) for i, j in cells]
    for (i, j), (layer, step), whole in zip(cells, places, episode.read_layers(name, places), strict=True):
        # (replan, head or 1, of which the mean is taken, key): a product with the shares, which is a BLAS call.
        parts = whole[:, heads].reshape(replans, -1, of_mean, keys)
        rows = (parts if mean is None else np.matmul(share, parts, out=mean))[:, :, 0]
        expected = sums[:, layer, step][:, heads].reshape(replans, -1, of_mean).mean(axis=-1)
        if not add_up(rows, expected, recording.mantissa_bits):
            here = replace(recording, layers=(recording.layers[layer],), denoise_steps=(recording.denoise_steps[step],))
            _refuse(episode, name, whole, sums[:, layer, step], here)
        yield LayerRows(i, j, rows)


def _refuse(
    episode: StoredEpisode, name: str, rows: NDArray[np.float32], sums: NDArray[np.float32], recording: Recording
) -> None:
    """Raise `CorruptEpisode` if rows (replan, head, query, key) of one layer and denoise step break the rules.

    sums: (replan, head, query). recording: of the site, with this layer and denoise step alone.
    """
    episode.refuse_missing(name, rows)
    for problem in row_problems(name, rows[:, None, None], sums[:, None, None], recording, recording.mantissa_bits):
        raise CorruptEpisode(f"Episode {episode.name} is damaged: {problem}.")
