"""The names that selectors can use: the tokens of one episode, and the union over a selection of episodes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from vla_attention.schemas.cached_property import cached_property
from vla_attention.schemas.errors import BadArgument, listing, shortened
from vla_attention.schemas.groupings.words import Word, words_of
from vla_attention.schemas.jsonable import Document
from vla_attention.schemas.layout import INVALID_ROLES, Prompt, Role, SiteLayout
from vla_attention.schemas.safe_text import check_name, visible

ObjectKind = Literal["object", "fixture", "robot", "background"]

#: Why a site has no words to name, or no objects, and what to do about it.
NO_WORDS = (
    "the keys of this site spell no words; choose a site with text by --site (Cosmos: cross); a text that was captured "
    "without its tokenizer needs a capture with --t5-tokenizer, va.record with tokenizer=..."
)
NO_COVERAGE = (
    "no selected episode has object coverage at this site: captures take it from the simulator's segmentation, "
    "va.record from the masks or coverage that replan() is given, and replays of data sets have none; choose a site "
    "with pictures by --site (Cosmos: self), or a store that is no copy without objects"
)


class SceneObject(Document, frozen=True):
    """One thing a pixel can belong to, named as in the task files (`akita_black_bowl_1`).

    `of_interest`: whether the task itself names it as its subject.
    """

    name: str
    kind: ObjectKind
    of_interest: bool

    def __post_init__(self) -> None:
        """Check the name."""
        check_name("object", self.name)


@dataclass(frozen=True)
class EpisodeTokens:
    """What selectors need of one episode's keys at one site.

    Attributes:
        layout: the site's spans.
        key_role: role codes, shape (replan, key) uint8.
        prompts: the different prompts of the episode.
        prompt_index: which prompt each replan had, shape (replan,).
        objects: the scene's objects, in the order of the coverage's last axis.
        coverage: per camera the area of each patch that each object covers, shape (replan, patch, object), 0..1.
        border: the part of each key's patch that shows no picture, shape (key,), 0..1; None where all show one.
    """

    layout: SiteLayout
    key_role: NDArray[np.uint8]
    prompts: Sequence[Prompt] = ()
    prompt_index: NDArray[np.integer] | None = None
    objects: tuple[SceneObject, ...] = ()
    coverage: Mapping[str, NDArray[np.float32]] | None = None
    border: NDArray[np.float32] | None = None

    @property
    def num_replans(self) -> int:
        """Number of replans."""
        return int(self.key_role.shape[0])

    @cached_property
    def static_roles(self) -> NDArray[np.uint8]:
        """`key_role` as (1, key) when it never changes in the episode, else as stored."""
        return self.key_role[:1] if (self.key_role == self.key_role[:1]).all() else self.key_role

    @cached_property
    def has_cut_patches(self) -> bool:
        """Whether there are patches of which a part shows a picture, and a part shows none."""
        return self.border is not None and bool(((self.border > 0) & (self.border < 1)).any())

    @cached_property
    def words(self) -> tuple[tuple[Word, ...], ...]:
        """The instruction's words for each of `prompts`; raises `BadArgument` for words at keys that do not exist."""
        words = tuple(words_of(prompt) for prompt in self.prompts)
        for line in {id(line): line for line in words}.values():  # prompts that differ in their state share them
            for word in line:
                if word.keys and not 0 <= min(word.keys) <= max(word.keys) < self.layout.num_keys:
                    raise BadArgument(
                        f"The word '{visible(shortened(word.text))}' has the keys {listing(word.keys)}; the site has "
                        f"{self.layout.num_keys}."
                    )
        return words

    @cached_property
    def valid(self) -> NDArray[np.bool_]:
        """Keys that can hold information, shape (replan or 1, key)."""
        return ~np.isin(self.static_roles, [int(role) for role in INVALID_ROLES])

    @cached_property
    def existing(self) -> NDArray[np.bool_] | None:
        """Keys that exist, shape (replan or 1, key); None where all do."""
        absent = self.static_roles == Role.ABSENT
        return ~absent if absent.any() else None


@dataclass(frozen=True)
class Vocabulary:
    """The names that selectors may use over a selection of episodes, for validation and for "did you mean".

    `layout` is the site's, the same for all episodes of a selection. `words` are case-folded, and `sentences` are the
    instructions as such words.
    """

    layout: SiteLayout
    cameras: tuple[str, ...]
    roles: tuple[str, ...]
    words: tuple[str, ...]
    objects: tuple[str, ...]
    sentences: tuple[tuple[str, ...], ...] = ()


def collect_vocabulary(episodes: Iterable[EpisodeTokens]) -> Vocabulary:
    """Union of the names in at least one episode in order of appearance, without cameras that are always masked."""
    given = iter(episodes)
    first = next(given)
    names = Names(first.layout)
    for tokens in chain([first], given):
        names.add(tokens)
    return names.vocabulary()


class Names:
    """The names at one site in episodes that come one after the other; none of the episodes is kept."""

    def __init__(self, layout: SiteLayout) -> None:
        self._layout = layout
        self._cameras: dict[str, None] = {}
        self._roles: dict[str, None] = {}
        self._words: dict[str, None] = {}
        self._objects: dict[str, None] = {}
        self._sentences: dict[tuple[str, ...], None] = {}

    def add(self, tokens: EpisodeTokens) -> None:
        """Add the names in one episode."""
        for span in self._layout.spans:
            if span.camera is None or span.camera in self._cameras:
                continue
            if (tokens.static_roles[:, span.start : span.stop] != Role.MASKED_IMAGE).any():
                self._cameras[span.camera] = None
        self._roles.update({Role(code).label: None for code in np.unique(tokens.static_roles)})
        if tokens.has_cut_patches:
            self._roles[Role.BORDER.label] = None
        self.add_words(tokens.words)
        if tokens.coverage:
            self.add_objects(tokens.objects)

    def add_words(self, lines: Iterable[tuple[Word, ...]]) -> None:
        """Add the words of prompts."""
        for line in lines:
            if not any(word.keys for word in line):
                continue  # a text that was captured without its tokenizer
            sentence = tuple(word.text.casefold() for word in line)
            self._sentences[sentence] = None
            self._words.update(dict.fromkeys(sentence))

    def add_objects(self, objects: Iterable[SceneObject]) -> None:
        """Add the objects of a scene that have coverage."""
        self._objects.update({thing.name: None for thing in objects})

    def vocabulary(self) -> Vocabulary:
        """The union of what was added, in order of appearance."""
        return Vocabulary(
            self._layout,
            tuple(self._cameras),
            tuple(self._roles),
            tuple(self._words),
            tuple(self._objects),
            tuple(self._sentences),
        )
