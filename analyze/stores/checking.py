"""Checking whole episodes, several at once or by the workers that `parallel` knows of."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import partial

from vla_attention.analyze.stores.parallel import each_episode
from vla_attention.schemas.stores.reader import Store, StoredEpisode
from vla_attention.schemas.stores.verify import Depth, EpisodeReport, Fault, episode_report


def faults_of_each(
    episodes: Iterable[tuple[Store, StoredEpisode]], progress: Callable[[int], object] | None = None
) -> Iterator[list[Fault]]:
    """Everything that is wrong with each episode, in their order; reads all of it, and keeps nothing that was read."""
    read = partial(_report, depth="values")
    for report in each_episode(read, ((store, replace(episode)) for store, episode in episodes), progress):
        yield report.faults


def reports_of_store(store: Store, depth: Depth) -> Iterator[EpisodeReport]:
    """Reports of a store's episodes, in their order; see `run_verify`."""
    return each_episode(partial(_report, depth=depth), ((store, replace(episode)) for episode in store.episodes))


def _report(pair: tuple[Store, StoredEpisode], depth: Depth) -> EpisodeReport:
    return episode_report(*pair, depth)
