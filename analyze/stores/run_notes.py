"""What every answer says of a run with other scenes, of one that was changed, or told something else."""

from __future__ import annotations

import re
from collections.abc import Iterable

from msgspec.structs import replace

from vla_attention.schemas.errors import listing, plural
from vla_attention.schemas.layout import Prompt
from vla_attention.schemas.libero_physics import SimulatedScenes
from vla_attention.schemas.safe_text import visible
from vla_attention.schemas.stores.reader import Store
from vla_attention.schemas.stores.store_format import EpisodeAttributes


class RunNotes:
    """Collects, of episodes one after the other, what is said of runs that were changed or told something else."""

    def __init__(self) -> None:
        self._stores: dict[str, Store] = {}
        self._told: dict[str, list[str]] = {}
        self._lost: dict[str, list[str]] = {}
        self._scenes: dict[str, SimulatedScenes] = {}

    def add(self, store: Store, attributes: EpisodeAttributes) -> None:
        """Look at an episode."""
        self._stores[str(store.path)] = store
        self._scenes.setdefault(store.path.name, SimulatedScenes()).add(store.attributes.protocol, attributes)
        given, instruction = told_instruction(store, attributes), attributes.instruction
        if not same_words(given, instruction):
            said = f"'{visible(given)}' where the task is '{visible(instruction)}'"
            self._told.setdefault(store.path.name, []).append(said)
        if end := _never_read(attributes.prompts):
            self._lost.setdefault(store.path.name, []).append(end)

    @property
    def of_prompts(self) -> tuple[str, ...]:
        """A line on each store whose policy was told another sentence than its task's, and where prompts were cut."""
        others = [
            f"The prompt is not the task's instruction in {plural(len(pairs), 'episode')} of {name}: the policy was "
            f"told {listing(dict.fromkeys(pairs), 2)}."
            for name, pairs in self._told.items()
        ]
        cut = [
            f"Prompts were cut in {name}: in {plural(len(ends), 'episode')} the policy never read the end of its "
            f"prompt ({listing([f'{end!r}' for end in dict.fromkeys(ends)], 3)})."
            for name, ends in self._lost.items()
        ]
        return (*others, *cut)

    @property
    def of_scenes(self) -> tuple[str, ...]:
        """A line on each store whose scenes are not those of LIBERO's published evaluations; see `libero_physics`."""
        return tuple(filter(None, (scenes.describe(name) for name, scenes in self._scenes.items())))

    @property
    def lines(self) -> tuple[str, ...]:
        """`of_scenes`, a line on each store whose run was changed, and `of_prompts`; empty without any."""
        # Of a run that differs in its prompt alone, the lines on prompts say more.
        told, every = self.of_prompts, self._stores.values()
        more = [store for store in every if not replace(store.attributes.interventions, prompt=None).is_none]
        return (*self.of_scenes, *change_notes(more if told else every), *told)


def episode_notes(episodes: Iterable[tuple[Store, EpisodeAttributes]]) -> tuple[str, ...]:
    """`RunNotes.of_scenes` and `RunNotes.of_prompts` of episodes."""
    notes = RunNotes()
    for store, attributes in episodes:
        notes.add(store, attributes)
    return (*notes.of_scenes, *notes.of_prompts)


def change_notes(stores: Iterable[Store]) -> tuple[str, ...]:
    """A line on each store whose run was changed, from its root alone; empty without any."""
    return tuple(
        f"The run in {store.path.name} was changed: {visible(store.attributes.interventions.describe())}."
        for store in stores
        if not store.attributes.interventions.is_none
    )


def told_instruction(store: Store, attributes: EpisodeAttributes) -> str:
    """The sentence that the policy was given: the prompt's, or the task's where the prompt says nothing of one."""
    known = [prompt.instruction_text for prompt in attributes.prompts[:1]]
    if known and (known[0].strip() or store.attributes.interventions.prompt is not None):
        return known[0]
    return attributes.instruction


def same_words(one: str, other: str) -> bool:
    """Whether two sentences have the same words: tokenizers change case, underscores and line ends."""
    first, second = (re.findall(r"\w+", text.casefold().replace("_", " ")) for text in (one, other))
    return first == second


def _never_read(prompts: Iterable[Prompt]) -> str:
    """The end of a prompt behind its last piece; empty where all of it was read, or where nobody knows."""
    for prompt in prompts:
        lost = prompt.text[prompt.pieces[-1].stop :] if prompt.pieces else ""
        if lost.strip():
            return visible(lost.strip())
    return ""
