"""Selected episodes: an episode with its store, tokens and timing, and a grouping resolved on every one of them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from msgspec import structs
from numpy.typing import NDArray

from vla_attention.analyze.stores.contents import read_one_by_one
from vla_attention.schemas.errors import BadArgument, listing
from vla_attention.schemas.groupings.grouping import Grouping
from vla_attention.schemas.groupings.resolve import EmptyGroup, ResolvedGrouping, check_names, counted_keys, resolve
from vla_attention.schemas.groupings.vocabulary import EpisodeTokens, Vocabulary, collect_vocabulary
from vla_attention.schemas.layout import Prompt
from vla_attention.schemas.stores.reader import Store, StoredEpisode
from vla_attention.schemas.stores.store_format import RootAttributes, StoreError
from vla_attention.schemas.stores.store_url import StoreUrl


@dataclass(frozen=True)
class SelectedEpisode:
    """An episode together with its store and its tokens.

    `without`: keys that are taken out of every group and of the valid keys (sinks; see
    `vla_attention.analyze.core.sinks`).
    """

    store: Store
    episode: StoredEpisode
    tokens: EpisodeTokens
    without: tuple[int, ...] = ()

    @classmethod
    def brief(cls, store: Store, episode: StoredEpisode, tokens: EpisodeTokens) -> SelectedEpisode:
        """An episode that was read, without what it keeps of that: of thousands it would fill the memory.

        Prompts, which change with the robot's state and are most of it, are read again when they are asked for. Of a
        store that is elsewhere all is kept, since each reading is a request.
        """
        if isinstance(episode.folder, StoreUrl):
            return cls(store, episode, tokens)
        kept, number, site = replace(episode), len(episode.attributes.prompts), tokens.layout.name
        brief = _Prompts(replace(episode), number) if number else ()
        vars(kept)["attributes"] = structs.replace(episode.attributes, prompts=brief)
        prompts = _Prompts(replace(episode), number, store.attributes, site) if tokens.prompts else ()
        return cls(store, kept, _with_words(replace(tokens, prompts=prompts), tokens)).fresh()

    def fresh(self) -> SelectedEpisode:
        """The same, with nothing that was read of it since it was selected."""
        if isinstance(self.episode.folder, StoreUrl):
            return self
        episode = replace(self.episode)
        vars(episode)["attributes"] = self.episode.attributes
        coverage = episode.coverage(self.store.attributes, self.tokens.layout.name)
        return replace(self, episode=episode, tokens=_with_words(replace(self.tokens, coverage=coverage), self.tokens))

    @property
    def task(self) -> tuple[str, int]:
        """Its suite and the number of its task."""
        return self.store.suite, self.episode.attributes.task_id

    @property
    def key(self) -> tuple[str, int, int]:
        """Its suite, the number of its task, and its own: the values of `tables.EPISODE_ID`."""
        return (*self.task, self.episode.attributes.episode_index)

    @property
    def valid(self) -> NDArray[np.bool_]:
        """Keys that can hold information and were not taken out, shape (replan or 1, key)."""
        valid = self.tokens.valid.copy()
        valid[:, list(self.without)] = False
        return valid

    @property
    def num_valid(self) -> NDArray[np.int64]:
        """Number of keys that can hold information and were not taken out, shape (replan or 1,)."""
        number: NDArray[np.int64] = self.valid.sum(axis=1)
        return number

    def timing(self, env_step: NDArray[np.int64]) -> tuple[NDArray[np.int64], int]:
        """Policy steps (replan,) executed before each replan, and those of the whole episode.

        In a loop that is not ours (`Protocol.of_other_loop`) nothing is known of waiting steps: the first replan is the
        beginning, and where the number of steps is not known (0) or not beyond the last replan, this one lasts as long
        as the median one.

        Args:
            env_step: environment step of each replan, (replan,).

        Raises:
            StoreError: the steps do not increase from 0, or the episode ended before its last replan.
        """
        num_steps, protocol = self.episode.attributes.num_steps, self.store.attributes.protocol
        if protocol.of_other_loop:
            starts = env_step - env_step[0]
            if num_steps > starts[-1]:
                return starts, num_steps
            lasts = int(np.median(np.diff(starts))) if len(starts) > 1 else max(1, protocol.replan_steps)
            return starts, int(starts[-1]) + lasts
        starts = env_step - protocol.wait_steps
        if len(starts) == 0 or starts[0] != 0 or (np.diff(starts) <= 0).any() or starts[-1] >= num_steps:
            raise StoreError(
                f"The replans of {self.episode.name} do not fit into its {num_steps} steps after "
                f"{protocol.wait_steps} steps of waiting; check the store with vla-attention store verify."
            )
        return starts, num_steps


def _with_words(tokens: EpisodeTokens, known: EpisodeTokens) -> EpisodeTokens:
    """The tokens, with the words that others of the episode know: its prompts are not read again for them."""
    if "words" in vars(known):
        vars(tokens)["words"] = known.words
    return tokens


@dataclass(frozen=True)
class _Prompts(Sequence[Prompt]):
    """The prompts of an episode, as the keys of a site if one is given: read whenever one is asked for."""

    episode: StoredEpisode
    number: int
    root: RootAttributes | None = None
    site: str = ""

    def __len__(self) -> int:
        return self.number

    def __iter__(self) -> Iterator[Prompt]:
        episode = replace(self.episode)
        return iter(episode.attributes.prompts if self.root is None else episode.prompts(self.root, self.site))

    def __getitem__(self, index: Any) -> Any:
        return tuple(self)[index]


def positions_by_task(selected: Sequence[SelectedEpisode]) -> dict[tuple[str, int], list[int]]:
    """Positions of each task's episodes, tasks in order of appearance."""
    positions: dict[tuple[str, int], list[int]] = {}
    for i, item in enumerate(selected):
        positions.setdefault(item.task, []).append(i)
    return positions


def load_tokens(
    chosen: Sequence[tuple[Store, StoredEpisode]],
    site: str,
    look: Callable[[Store, StoredEpisode, EpisodeTokens], object] = lambda _store, _episode, _tokens: None,
) -> list[SelectedEpisode]:
    """Read the tokens of every episode; reads no rows.

    look: called with each episode while it is read whole.

    Raises:
        StoreError: an episode holds no replan.
    """
    found, empty = [], []
    opened = read_one_by_one(episode for _, episode in chosen)
    for (store, _), episode in zip(chosen, opened, strict=True):
        if not episode.attributes.num_replans:
            empty.append(f"{episode.name} of {store.path}")
            continue
        tokens = episode.tokens(store.attributes, site)
        look(store, episode, tokens)
        found.append(SelectedEpisode.brief(store, episode, tokens))
    if empty:
        raise StoreError(
            f"{listing(empty)} hold{'s' if len(empty) == 1 else ''} no replan, so there is no attention to measure; "
            "leave such episodes out with --skip-corrupt."
        )
    return found


def find_episode(selected: Sequence[SelectedEpisode], task: int | None, episode: int | None) -> SelectedEpisode:
    """The first selected episode of that task and number, None standing for any.

    Raises:
        BadArgument: no selected episode has them; the sentence lists the episodes.
    """
    for item in selected:
        attributes = item.episode.attributes
        if task in (None, attributes.task_id) and episode in (None, attributes.episode_index):
            return item
    wanted = " ".join(
        f"{what} {number}" for what, number in (("task", task), ("episode", episode)) if number is not None
    )
    raise BadArgument(
        f"There is no {wanted} among the {len(selected)} selected episodes: "
        f"{listing([item.episode.name for item in selected], 20)}."
    )


def check_replan(item: SelectedEpisode, replan: int) -> int:
    """The replan's number; `BadArgument` unless the episode has it."""
    if not 0 <= replan < item.tokens.num_replans:
        raise BadArgument(
            f"There is no replan {replan} in {item.episode.name}; it has replans 0 to {item.tokens.num_replans - 1}."
        )
    return replan


def vocabulary_of(selected: Sequence[SelectedEpisode]) -> Vocabulary:
    """The names that selectors may use over the selected episodes."""
    return collect_vocabulary(item.tokens for item in selected)


def resolve_all(
    grouping: Grouping, selected: Sequence[SelectedEpisode], vocabulary: Vocabulary
) -> list[ResolvedGrouping]:
    """Resolve a grouping on every episode, with the checks that need all of them.

    Raises:
        SelectorError: a name exists in no selected episode.
        OverlappingGroups: groups share keys and the grouping does not allow it.
        EmptyGroup: a group has no key in any selected episode.
    """
    check_names(grouping, vocabulary)
    resolved = [resolve_episode(grouping, item) for item in selected]
    check_not_empty(grouping, [item.num_keys for item in resolved])
    return resolved


def resolve_episode(grouping: Grouping, item: SelectedEpisode) -> ResolvedGrouping:
    """The grouping on one episode, without the checks that need all of them.

    Keys that were taken out of the episode are in no group, not valid and not counted.
    """
    resolved = resolve(grouping, item.tokens)
    if not item.without:
        return resolved
    weights = resolved.weights.copy()
    weights[:, list(item.without)] = 0.0
    return ResolvedGrouping(resolved.names, weights, counted_keys(weights, item.tokens.existing), item.num_valid)


def check_not_empty(grouping: Grouping, num_keys: Sequence[NDArray[np.float64]]) -> None:
    """Raise `EmptyGroup` for a group without a key in any episode; numbers of keys (replan or 1, group) of each."""
    for i, name in enumerate(grouping.names):
        if name not in grouping.allow_empty and not any(item[:, i].any() for item in num_keys):
            selectors = " | ".join(grouping.groups[name])
            raise EmptyGroup(
                f"Group '{name}' ({selectors}) has no key in any of the {len(num_keys)} selected episodes; change its "
                f'selector, or add allow_empty = ["{name}"] to the grouping.'
            )
