"""Checking whole episodes, several at once or by the workers that `parallel` knows of."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

from vla_attention.analyze.stores.parallel import each_episode
from vla_attention.schemas.stores.reader import Store, StoredEpisode
from vla_attention.schemas.stores.verify import Fault, episode_faults


def faults_of_each(
    episodes: Iterable[tuple[Store, StoredEpisode]], progress: Callable[[int], object] | None = None
) -> Iterator[list[Fault]]:
    """Everything that is wrong with each episode, in their order; reads all of it, and keeps nothing that was read."""
    return each_episode(_faults, ((store, replace(episode)) for store, episode in episodes), progress)


def _faults(pair: tuple[Store, StoredEpisode]) -> list[Fault]:
    return episode_faults(*pair)
