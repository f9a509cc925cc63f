"""Verification: read everything back and hold it against what the episodes promise of themselves."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from analyze.reader import Store, StoredEpisode
from schemas.digest import ArrayDigest
from schemas.precision import mass_error_bound
from schemas.store import CorruptEpisode, RootAttributes


@dataclass(frozen=True)
class Fault:
    """Something wrong with one episode."""

    episode: str
    problem: str


def verify_store(store: Store, progress: Callable[[int], object] | None = None) -> list[Fault]:
    """Check every episode; `progress` is called with 1 after each. An empty list means the store is whole."""
    faults = []
    for episode in store.episodes:
        faults += [Fault(episode.name, problem) for problem in _problems(store.attributes, episode)]
        if progress is not None:
            progress(1)
    return faults


def _problems(root: RootAttributes, episode: StoredEpisode) -> Iterator[str]:
    try:
        attributes = episode.attributes
    except CorruptEpisode as error:
        yield str(error)
        return
    expected = {f"{site.name}/{name}" for site in root.sites for name in ("rows", "row_sum", "atoms", "key_role")}
    for name in sorted(expected - set(attributes.arrays)):
        yield f"the array {name} is not in the episode"
    for name, record in attributes.arrays.items():
        try:
            yield from _array_problems(episode, name, record.sha256)
        except CorruptEpisode as error:
            yield str(error)
    for site in root.sites:
        if f"{site.name}/rows" in attributes.arrays:
            try:
                yield from _row_sum_problems(episode, site.name, mass_error_bound(root.recording.mantissa_bits))
            except CorruptEpisode as error:
                yield str(error)


def _array_problems(episode: StoredEpisode, name: str, sha256: str) -> Iterator[str]:
    array = episode.array(name)
    digest = ArrayDigest()
    step = max(1, (array.shards or array.chunks)[0])
    for first in range(0, array.shape[0], step):
        digest.update(episode.read(name, slice(first, first + step)))
    if digest.hexdigest() != sha256:
        yield f"the values of {name} are not those that were written (digest differs)"


def _row_sum_problems(episode: StoredEpisode, site: str, bound: float) -> Iterator[str]:
    """Stored rows must add up to the exact sums within what rounding allows (and float32 summation, 1e-5)."""
    sums = episode.read(f"{site}/row_sum").astype(np.float64)
    array = episode.array(f"{site}/rows")
    step = max(1, (array.shards or array.chunks)[0])
    for first in range(0, array.shape[0], step):
        rows = episode.read(f"{site}/rows", slice(first, first + step))
        if (rows < 0).any():
            yield f"{site}/rows holds negative numbers"
        error = np.abs(rows.sum(axis=-1, dtype=np.float64) - sums[first : first + step])
        if (error > (bound + 1e-5) * sums[first : first + step]).any():
            yield f"{site}/rows does not add up to {site}/row_sum (largest difference {error.max():.2g})"
