"""Checking whole episodes, several at once or by the workers that `parallel` knows of."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

from vla_attention.analyze.stores.parallel import each_episode
from vla_attention.schemas.stores.reader import Store, StoredEpisode
from vla_attention.schemas.stores.verify import EpisodeReport, Fault, episode_report


def faults_of_each(
    episodes: Iterable[tuple[Store, StoredEpisode]], progress: Callable[[int], object] | None = None
) -> Iterator[list[Fault]]:
    """Everything that is wrong with each episode, in their order; reads all of it, and keeps nothing that was read."""
    for report in each_episode(_read, ((store, replace(episode)) for store, episode in episodes), progress):
        yield report.faults


def reports_of_store(store: Store, quick: bool) -> Iterator[EpisodeReport]:
    """Reports of a store's episodes, in their order; see `run_verify`."""
    return each_episode(_look if quick else _read, ((store, replace(episode)) for episode in store.episodes))


def _read(pair: tuple[Store, StoredEpisode]) -> EpisodeReport:
    return episode_report(*pair)


def _look(pair: tuple[Store, StoredEpisode]) -> EpisodeReport:
    return episode_report(*pair, quick=True)
