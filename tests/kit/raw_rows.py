"""Rows of a made-up store as plain arrays, read by zarr alone, from which the tests of metrics compute."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import zarr
from hypothesis import HealthCheck, Phase, settings

from tests.kit.examples import examples
from tests.kit.stores import StoreSpec
from tests.kit.tokens import valid_keys
from vla_attention.schemas.groupings.grouping import Grouping
from vla_attention.schemas.groupings.resolve import resolve
from vla_attention.schemas.groupings.vocabulary import EpisodeTokens

#: Every example writes a store: shrinking one would take minutes.
FEW = settings(
    max_examples=examples(4),
    phases=[Phase.explicit, Phase.generate],
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow],
)


def probabilities(array: zarr.Array) -> np.ndarray:
    """What an array of rows holds, float32: its numbers times its `scale_factor`, where it has one."""
    return array[:].astype(np.float32) * np.float32(array.attrs.get("scale_factor", 1))


def put_probabilities(array: zarr.Array, rows: np.ndarray) -> None:
    """Write rows into an array that is there, with another program; nothing is rounded or checked."""
    with np.errstate(over="ignore"):
        array[...] = (rows / np.float32(array.attrs.get("scale_factor", 1))).astype(array.dtype)


@dataclass(frozen=True)
class RawEpisode:
    """An episode's rows (replan, layer, denoise, head, key) float64, mean over queries, one layer for each label.

    `valid`: (replan, key) bool. `order`: (task, episode).
    """

    order: tuple[int, int]
    rows: np.ndarray
    valid: np.ndarray

    def held(self, without: Sequence[int] = ()) -> tuple[np.ndarray, np.ndarray]:
        """Rows with 0 on keys that are not valid or left out, and which keys remain (replan, key)."""
        keys = self.valid.copy()
        keys[:, list(without)] = False
        return self.rows * keys[:, None, None, None, :], keys


def raw_episodes(path: Path, spec: StoreSpec) -> list[RawEpisode]:
    """The rows of every episode, in the order of (task, episode)."""
    labels = spec.layer_labels or spec.layers
    layers = [spec.layers.index(label % spec.num_layers) for label in labels]
    found = []
    for task, episode in spec.names:
        site = zarr.open_group(path / f"episodes/task{task:03d}_episode{episode:03d}", mode="r")["joint"]
        rows = probabilities(site["rows"]).astype(np.float64).mean(axis=4)[:, layers]
        found.append(RawEpisode((task, episode), rows, valid_keys(site["key_role"][:])))
    return found


def weights_of(grouping: Grouping, tokens: EpisodeTokens) -> np.ndarray:
    """Weights (replan, key, group) of a grouping; that they are right is shown elsewhere."""
    weights = resolve(grouping, tokens).weights
    return np.broadcast_to(weights, (tokens.num_replans, *weights.shape[1:])).astype(np.float64)


def leaky(task: int, episode: int, tokens: EpisodeTokens, rows: np.ndarray) -> np.ndarray:
    """Rows in which keys that hold no information take a part, as Cosmos's null keys do: for `StoreSpec.plant_rows`."""
    leaked = rows + np.random.default_rng([task, episode]).random(rows.shape) * 0.01
    return leaked / leaked.sum(axis=-1, keepdims=True)
