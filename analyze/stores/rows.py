"""Rows of one episode, one layer and denoise step at a time: no analysis holds all rows of an episode.

What is read is held against its stored sums: of all keys, or of the segments whose keys are read.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from vla_attention.analyze.stores.selection import Selection
from vla_attention.schemas.layout import SiteLayout
from vla_attention.schemas.stores.array_metadata import ArrayMetadata
from vla_attention.schemas.stores.content_rules import add_up, row_problems
from vla_attention.schemas.stores.reader import StoredEpisode
from vla_attention.schemas.stores.store_format import CorruptEpisode, Recording, RootAttributes


@dataclass(frozen=True)
class LayerRows:
    """Rows of one recorded layer at one recorded denoise step.

    Attributes:
        layer: position in the selection's layers.
        denoise: position in the selection's denoise steps.
        keys: which keys the rows have.
        rows: probabilities (replan, head, key) float32, mean over the stored queries, of the selected heads; or their
            mean over these heads, (replan, 1, key).
        stored: those of each query, (replan, head, query, key), where they are known.
    """

    layer: int
    denoise: int
    keys: range
    rows: NDArray[np.float32]
    stored: NDArray[np.float32] | None = None

    def of_heads(self, per_head: bool) -> NDArray[np.float32]:
        """The rows of each head, where they were read so, or their mean, to the bit as it is read without heads."""
        if per_head or self.rows.shape[1] == 1:
            return self.rows
        stored = self.rows[:, :, None] if self.stored is None else self.stored
        return _mean(stored.reshape(len(stored), 1, -1, stored.shape[-1]), None)


def whole_spans(layout: SiteLayout, chunks: ArrayMetadata, first: int, stop: int) -> range:
    """The keys of all spans and of all chunks that hold some from `first` to `stop`."""
    keys = chunks.whole_chunks(first, stop)
    spans = [span for span in layout.spans if span.start < keys.stop and span.stop > keys.start]
    whole = range(min(keys.start, spans[0].start), max(keys.stop, spans[-1].stop))
    return keys if whole == keys else whole_spans(layout, chunks, whole.start, whole.stop)


def layer_rows(
    root: RootAttributes,
    episode: StoredEpisode,
    selection: Selection,
    site: str,
    per_head: bool | None = None,
    keys: range | None = None,
) -> Iterator[LayerRows]:
    """Read the selected layers and denoise steps of an episode one after the other.

    All are read into the same memory: each is gone when the next one is asked for.

    Args:
        root: of the episode's store.
        episode: where the rows are.
        selection: which layers, denoise steps and heads.
        site: the softmax family.
        per_head: keep heads apart; as in the selection unless it is given.
        keys: those that are read, `whole_spans`; all unless given.

    Raises:
        CorruptEpisode: a chunk is not the one that was sealed, or rows do not add up to their stored sums.
    """
    name, recording, layout = f"{site}/rows", root.recording_of(site), root.site(site)
    every = range(layout.num_keys)
    keys = every if keys is None else keys
    sums = episode.row_sum(site) if keys == every else _sums_of_segments(episode, layout, keys)
    # A slice where it can be one: picking heads by their numbers copies every row.
    replans, *_, stored, queries, _ = episode.shape_of(name)
    heads = slice(None) if selection.heads == tuple(range(stored)) else list(selection.heads)
    apart = selection.per_head if per_head is None else per_head
    of_mean = queries if apart else queries * len(selection.heads)
    # Means too are written into memory that stays: new memory for each would be asked of the system again and again.
    mean = np.empty((replans, len(selection.heads) if apart else 1, 1, len(keys)), np.float32) if of_mean > 1 else None
    cells = [(i, j) for i in range(len(selection.layers)) for j in range(len(selection.denoise))]
    places = [(selection.layers[i], selection.denoise[j]) for i, j in cells]
    for (i, j), (layer, step), whole in zip(cells, places, episode.read_layers(name, places, keys), strict=True):
        chosen = whole[:, heads]
        parts = chosen.reshape(replans, -1, of_mean, len(keys))
        rows = parts[:, :, 0] if mean is None else _mean(parts, mean)
        # Sums in float32 (replan, head, query): of the rows that are given on, so that one pass suffices.
        expected = sums[:, layer, step][:, heads].reshape(replans, -1, of_mean).mean(axis=-1)
        if not add_up(rows, expected, recording.mantissa_bits):
            here = replace(recording, layers=(recording.layers[layer],), denoise_steps=(recording.denoise_steps[step],))
            _refuse(episode, name, whole, sums[:, layer, step], here)
        yield LayerRows(i, j, keys, rows, chosen)


def _mean(parts: NDArray[np.float32], into: NDArray[np.float32] | None) -> NDArray[np.float32]:
    """Mean of (replan, head, part, key) over the parts, a product with their shares, which is a BLAS call.

    into: memory (replan, head, 1, key) for it.
    """
    share = np.full((1, parts.shape[-2]), 1 / parts.shape[-2], np.float32)
    found: NDArray[np.float32] = np.matmul(share, parts, out=into)
    return found[:, :, 0]


def _sums_of_segments(episode: StoredEpisode, layout: SiteLayout, keys: range) -> NDArray[np.float32]:
    """What rows of the keys of whole spans add up to, from the stored masses: (replan, layer, denoise, head, query)."""
    inside = {span.name for span in layout.spans if span.start >= keys.start and span.stop <= keys.stop}
    segments = [i for i, one in enumerate(episode.attributes.segments[layout.name]) if one.span in inside]
    masses = episode.read_kept(f"{layout.name}/atoms")[..., segments]
    return np.asarray(masses.sum(axis=-1, dtype=np.float64), np.float32)


def _refuse(
    episode: StoredEpisode, name: str, rows: NDArray[np.float32], sums: NDArray[np.float32], recording: Recording
) -> None:
    """Raise `CorruptEpisode` if rows (replan, head, query, key) of one layer and denoise step break the rules.

    sums: (replan, head, query). recording: of the site, with this layer and denoise step alone.
    """
    episode.refuse_missing(name, rows)
    for problem in row_problems(name, rows[:, None, None], sums[:, None, None], recording, recording.mantissa_bits):
        raise CorruptEpisode(f"Episode {episode.name} is damaged: {problem}.")
