"""The part of the stores that an analysis uses: tasks, layers, denoise steps, heads."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TypeVar

from vla_attention.schemas.errors import BadArgument, listing, unknown_name
from vla_attention.schemas.layers import LayerSelection, block_of_labels, select_layers
from vla_attention.schemas.layout import SiteLayout
from vla_attention.schemas.options import resolve_tasks
from vla_attention.schemas.stores.reader import Store, StoredEpisode
from vla_attention.schemas.stores.store_format import CorruptEpisode, RootAttributes, StoreError, parse_episode_name

Read = TypeVar("Read")


@dataclass(frozen=True)
class Selection:
    """Positions along the stored axes, and the numbers they stand for.

    `layers`, `denoise` and `heads` are positions in the stored arrays; `layer_labels` and `blocks` are the number that
    the user typed and the block index of each layer; `head_numbers` and `denoise_steps` likewise. `per_head`: keep
    heads apart instead of averaging over the selected ones.
    """

    layers: tuple[int, ...]
    layer_labels: tuple[int, ...]
    blocks: tuple[int, ...]
    denoise: tuple[int, ...]
    denoise_steps: tuple[int, ...]
    heads: tuple[int, ...]
    head_numbers: tuple[int, ...]
    per_head: bool
    note: str | None = None

    @property
    def once(self) -> tuple[int, ...]:
        """Positions of the layers, without those that name a block again: sums and means count a block once."""
        return tuple(i for i, block in enumerate(self.blocks) if self.blocks.index(block) == i)


def select(
    root: RootAttributes,
    layers: Sequence[int] | None = None,
    denoise: Sequence[str] | None = None,
    heads: Sequence[int] | None = None,
    per_head: bool = False,
    site: str | None = None,
) -> Selection:
    """Check the wanted layers, denoise steps and heads against what was recorded of a site; None means all of it.

    site: the first one unless it is given.
    """
    site = choose_site(root, site)
    recording = root.recording_of(site)
    if layers is None:
        blocks = block_of_labels(recording.layer_labels, root.policy.num_layers)
        wanted = LayerSelection(blocks, recording.layer_labels)
    else:
        wanted = select_layers(layers, root.policy.num_layers, root.policy.family)
    missing = [
        label for block, label in zip(wanted.blocks, wanted.labels, strict=True) if block not in recording.layers
    ]
    if missing:
        raise BadArgument(
            f"Layers {listing(missing)} were not recorded{_at_site(root, site)}; recorded blocks: "
            f"{listing(recording.layers, 40)}{_other_sites(root, site)}."
        )
    steps = parse_denoise_steps(denoise, recording.denoise_steps)
    head_numbers = recording.heads if heads is None else tuple(heads)
    for head in head_numbers:
        if head not in recording.heads:
            raise BadArgument(
                f"Head {head} was not recorded{_at_site(root, site)}; recorded heads: {listing(recording.heads, 40)}."
            )
    for what, numbers in (("Denoise steps", steps), ("Heads", head_numbers)):
        if len(set(numbers)) != len(numbers):
            raise BadArgument(f"{what} {listing(numbers)} name one of them twice.")
    return Selection(
        layers=tuple(recording.layers.index(block) for block in wanted.blocks),
        layer_labels=wanted.labels,
        blocks=wanted.blocks,
        denoise=tuple(recording.denoise_steps.index(step) for step in steps),
        denoise_steps=steps,
        heads=tuple(recording.heads.index(head) for head in head_numbers),
        head_numbers=head_numbers,
        per_head=per_head,
        note=wanted.note,
    )


def _at_site(root: RootAttributes, site: str) -> str:
    """Which site is meant, where sites have layers of their own."""
    return f" at site '{site}'" if any(layout.layers or layout.heads for layout in root.sites) else ""


def _other_sites(root: RootAttributes, site: str) -> str:
    """The layers of the other sites, where sites have layers of their own."""
    if not any(layout.layers for layout in root.sites):
        return ""
    others = [
        f"'{other.name}' {listing(root.recording_of(other.name).layers, 40)}"
        for other in root.sites
        if other.name != site
    ]
    return f"; other sites (--site) have {'; '.join(others)}" if others else ""


def denoise_text(steps: Sequence[int], num_steps: int) -> str:
    """Denoise steps in words; `num_steps` is how many the policy has."""
    if len(steps) == 1:
        which = {0: " (the first)", num_steps - 1: " (the last)"}.get(steps[0], "") if num_steps > 1 else ""
        return f"denoise step {steps[0]}{which} of {num_steps}"
    return f"denoise steps {listing(steps, 40)} of {num_steps}"


def choose_site(root: RootAttributes, name: str | None) -> str:
    """The wanted site, or the first one. Sites are normalised separately: one analysis never mixes them."""
    names = [site.name for site in root.sites]
    if name is None:
        return names[0]
    if name not in names:
        raise unknown_name("site", name, names)
    return name


def site_that(root: RootAttributes, wanted: str | None, fits: Callable[[SiteLayout], bool]) -> str | None:
    """The wanted site, or the first one that fits; None when none does, or the wanted one does not.

    A wanted name that does not exist is returned as it is: `choose_site` refuses it, with the names that exist.
    """
    fitting = [site.name for site in root.sites if fits(site)]
    if wanted is None:
        return fitting[0] if fitting else None
    return wanted if wanted in fitting or wanted not in [site.name for site in root.sites] else None


def parse_denoise_steps(words: Sequence[str] | None, recorded: Sequence[int]) -> tuple[int, ...]:
    """Read `--denoise`: numbers of recorded denoise steps, `first`, `last` or `all`; also with commas."""
    if words is None or list(words) == ["all"]:
        return tuple(recorded)
    named = {"first": min(recorded), "last": max(recorded)}
    steps = []
    for word in (part.strip() for given in words for part in given.split(",") if part.strip()):
        if word in named:
            steps.append(named[word])
        elif word.isdigit() and int(word) in recorded:
            steps.append(int(word))
        else:
            raise BadArgument(
                f"Denoise step '{word}' was not recorded; recorded: {listing(recorded, 40)}; 'first', 'last' and 'all' "
                "also work."
            )
    return tuple(steps)


def select_episodes(store: Store, tasks: Sequence[int | str] | None) -> tuple[StoredEpisode, ...]:
    """The store's episodes of the wanted tasks (numbers or instructions), in order; no episode is an error."""
    if not store.episodes:
        raise StoreError(
            f"The store {store.path} holds no complete episode yet: vla-attention capture status {store.path} "
            "says what is being written, and the command that makes it goes on with --resume."
        )
    if tasks is None:
        return store.episodes
    instructions: dict[int, str] = {}
    if not all(isinstance(task, int) for task in tasks):
        instructions = {one.attributes.task_id: one.attributes.instruction for one in store.episodes}
    numbers = resolve_tasks(tasks, instructions, str(store.path))
    for task in numbers:
        if task not in store.task_ids:
            raise BadArgument(
                f"Store {store.path} has no episode of task {task}; it has tasks {listing(store.task_ids, 40)}."
            )
    return tuple(episode for episode in store.episodes if parse_episode_name(episode.name)[0] in numbers)


def check_combinable(stores: Sequence[Store]) -> None:
    """Raise unless several stores can be analysed as one: same policy and recording, and no episode twice."""
    for store in stores:
        _check_root(store)
    first = stores[0]
    seen: dict[tuple[str, str], Store] = {}
    for store in stores:
        for field, mine, theirs in (
            ("policy digest", store.attributes.policy.digest, first.attributes.policy.digest),
            ("recording", store.attributes.recording, first.attributes.recording),
            ("sites", store.attributes.sites, first.attributes.sites),
        ):
            if mine != theirs:
                raise StoreError(
                    f"Stores {first.path} and {store.path} differ in their {field}; analyse them one at a time."
                )
        for episode in store.episodes:
            other = seen.setdefault((store.suite, episode.name), store)
            if other is not store:
                raise StoreError(
                    f"Stores {other.path} and {store.path} both hold {episode.name} of {store.suite}; analyse them one "
                    "at a time."
                )


def read_usable(
    stores: Sequence[Store], skip_corrupt: bool, read: Callable[[StoredEpisode], Read]
) -> Iterator[tuple[Store, StoredEpisode, Read]]:
    """What is read of all episodes of stores with policy calls, whichever are selected: what all answers refer to.

    skip_corrupt: without those of which it cannot be read.

    Raises:
        CorruptEpisode: an episode is damaged.
    """
    for store in stores:
        for episode in store.episodes:
            try:
                if not episode.attributes.num_replans:
                    continue
                found = read(episode)
            except CorruptEpisode:
                if not skip_corrupt:
                    raise
                continue
            yield store, episode, found


def _check_root(store: Store) -> None:
    """Raise `CorruptEpisode` unless an episode is of the run that the store's root describes; one seal is enough."""
    problems = []
    for episode in store.episodes:
        try:
            _ = episode.seal
        except CorruptEpisode as error:
            problems.append(error)
        else:
            return
    if problems:
        raise problems[0]
