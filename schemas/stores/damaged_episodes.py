"""Which committed episodes of a store are damaged: a cheap look, or a look at every byte."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from pathlib import Path

from vla_attention.schemas.errors import listing, plural
from vla_attention.schemas.stores.episode_files import check_presence
from vla_attention.schemas.stores.reader import Store, StoredEpisode, open_store
from vla_attention.schemas.stores.store_format import StoreError
from vla_attention.schemas.stores.verify import episode_report


class DamagedEpisodesLeft(StoreError):
    """A capture is over, and episodes that it was asked for are in the store, but damaged."""


@dataclass(frozen=True)
class DamagedEpisode:
    """An episode that is in the store and cannot be used; `problems` are sentences, at least one."""

    name: str
    problems: tuple[str, ...]

    def describe(self) -> str:
        """Return the first problem and the number of others as one sentence, which names the episode."""
        first = self.problems[0].rstrip(".")
        first = first if self.name in first else f"Episode {self.name} is damaged: {first}"
        others = len(self.problems) - 1
        more = f" (and {plural(others, 'more fault')})" if others else ""
        return f"{first}{more}."


def look_at(store: Store, episode: StoredEpisode, verify: bool = False) -> DamagedEpisode | None:
    """Return what is wrong with an episode, or None.

    verify: compare every byte with the seal, as `vla-attention store verify` does.
    """
    problems = [problem.text for problem in check_presence(replace(episode))]
    if verify and not problems:
        problems = [*episode_report(store, episode, "files").problems]
    return DamagedEpisode(episode.name, tuple(problems)) if problems else None


def find_damaged(path: Path, names: Collection[str], verify: bool = False) -> list[DamagedEpisode]:
    """Return the damaged episodes among those named. An episode that the store lacks is not damaged."""
    store = open_store(path)
    looks = (look_at(store, episode, verify) for episode in store.episodes if episode.name in names)
    return [damaged for damaged in looks if damaged is not None]


def what_to_do(path: Path, damaged: Collection[DamagedEpisode]) -> str:
    """Return the sentences for a user whose capture cannot record these episodes again."""
    count = len(damaged)
    described = " ".join(episode.describe() for episode in list(damaged)[:3])
    others = listing((episode.name for episode in list(damaged)[3:]), 20)
    return (
        f"{count} of the episodes asked for {'is' if count == 1 else 'are'} damaged: {described}"
        f"{f' Damaged too: {others}.' if count > 3 else ''} A capture moves no data; run vla-attention capture verify "
        f"{path} "
        "--repair, which moves damaged episodes aside, and then this capture again with --resume."
    )
