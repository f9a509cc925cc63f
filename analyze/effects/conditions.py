"""What each rerun changed, which group of keys that is about, and which other rerun is its control."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Literal

from vla_attention.schemas.errors import UserError
from vla_attention.schemas.groupings.selector_parser import atoms_of, parse_selector
from vla_attention.schemas.interventions import Interventions, KeyKnockout, queries_suffix, readers
from vla_attention.schemas.safe_text import visible
from vla_attention.schemas.stores.reader import Store


class Kind(StrEnum):
    """The one thing that a run changed."""

    WITHOUT = "without"  # a group of keys is knocked out
    ONLY = "only"  # all but a group is knocked out
    RANDOM = "random"  # equally many random keys are knocked out
    NOISE = "noise"  # another noise seed
    ATTENTION = "attention"  # attention to a group is scaled or made uniform
    PROMPT = "prompt"
    IMAGE = "image"
    SEVERAL = "several"  # more than one of these
    NOTHING = "nothing"


#: Names of a series' conditions begin with these; what follows is the name of the group.
_PREFIXES = ("without_", "only_", "random_")
#: Kinds that others are measured against.
FLOORS = (Kind.NOISE, Kind.RANDOM)


#: Who no longer reads an item. `total`: nobody reads it. `direct`: the action queries alone do not.
Reader = Literal["total", "direct", "pictures", "text"]
READERS: tuple[Reader, ...] = ("total", "direct", "pictures", "text")


@dataclass(frozen=True)
class Place:
    """Where attention was changed; None is everywhere."""

    layers: tuple[int, ...] | None = None
    heads: tuple[int, ...] | None = None
    denoise_steps: tuple[int, ...] | None = None


@dataclass(frozen=True)
class GroupOfKeys:
    """The keys that an intervention is about: the union of selectors of the grouping language, and where they count."""

    selectors: tuple[str, ...]
    place: Place = Place()

    @property
    def text(self) -> str:
        """The selectors as one."""
        return visible(" | ".join(self.selectors))


@dataclass(frozen=True)
class Condition:
    """A run with interventions: its name in tables, its store, and what it changed.

    `recorded`: no run of its own, but an effect that the base measured beside its calls; the store is the base.
    """

    name: str
    store: Store
    interventions: Interventions
    recorded: bool = False

    @property
    def kind(self) -> Kind:
        """The one thing that was changed."""
        return kind_of(self.interventions)

    @property
    def description(self) -> str:
        """What was changed, in words."""
        return visible(self.interventions.describe())

    @property
    def group(self) -> GroupOfKeys | None:
        """The keys that were knocked out, kept or changed; None where it is no group."""
        return group_of(self.interventions)

    @property
    def group_name(self) -> str:
        """The group's name: `visual` of `without_visual` or `without_visual_queries_all`, else its selectors.

        For whom keys were cut is `readers`, and no part of the group's name.
        """
        for prefix in _PREFIXES:
            if self.name.startswith(prefix) and len(self.name) > len(prefix):
                return self._without_queries(self.name.removeprefix(prefix))
        return self.group.text if self.group is not None else self.name

    def _without_queries(self, name: str) -> str:
        for suffix in {queries_suffix(knockout.queries) for knockout in self.interventions.keys} - {""}:
            stem, separator, rest = name.rpartition(suffix)
            if separator and stem and (not rest or rest.startswith("_of_")):
                return stem
        return name

    @property
    def readers(self) -> str:
        """Whose attention was changed, in words; empty where that of nobody was."""
        words = [readers(knockout.queries, knockout.query_selector) for knockout in self.interventions.keys]
        words += [readers(change.queries) for change in self.interventions.attention]
        return visible(" and ".join(dict.fromkeys(words)))

    def is_control_of(self, other: Condition) -> bool:
        """Whether this run knocked out random keys, as many as the other one, and is like it in all else."""
        return (
            self.kind == Kind.RANDOM
            and other.kind in (Kind.WITHOUT, Kind.ONLY)
            and _not_random(self.interventions) == _not_random(other.interventions)
        )

    def is_reverse_of(self, other: Condition) -> bool:
        """Whether one run knocked out what the other one kept, both being alike in all else."""
        return {self.kind, other.kind} == {Kind.WITHOUT, Kind.ONLY} and (
            _not_kept(self.interventions) == _not_kept(other.interventions)
        )


def reader_of(condition: Condition) -> Reader | None:
    """Who no longer reads the keys of a condition; None where it is nobody, or somebody else."""
    if len(condition.interventions.keys) != 1:
        return None
    knockout = condition.interventions.keys[0]
    if knockout.queries == "prefix":
        return "pictures" if knockout.query_selector == "role:image" else "text" if knockout.query_selector else None
    return "total" if knockout.queries == "all" else "direct"


def selector_kind(condition: Condition) -> str:
    """The kind of the one selector that a condition's group is made of: `word`, `camera`; empty for a composed one."""
    if condition.group is None:
        return ""
    try:
        atoms = [atom for text in condition.group.selectors for atom in atoms_of(parse_selector(text))]
    except UserError:
        return ""
    return atoms[0].kind if len(atoms) == 1 else ""


def item_name(condition: Condition) -> str:
    """`'red'` for a word's group, `agentview` for a camera's: the name without the kind that stands before it."""
    kind, name = selector_kind(condition), condition.group_name
    bare = name.removeprefix(f"{kind}_") if kind else name
    return f"'{bare}'" if kind == "word" else bare


def change_name(condition: Condition) -> str:
    """A short name of a change of words or pictures that was recorded; that of the condition for everything else."""
    given = condition.interventions
    if not condition.recorded:
        return condition.name
    if given.prompt is not None and given.prompt.kind == "synonyms":
        return visible(", ".join(f"'{word}' as '{other}'" for word, other in given.prompt.synonyms.items()))
    how = {"blank": "grey", "mean": "as the task's mean"}
    named = [f"{change.camera} {how[change.kind]}" for change in given.images if change.kind in how]
    return visible(named[0]) if len(named) == len(given.images) == 1 else condition.name


def kind_of(interventions: Interventions) -> Kind:
    """The one thing that interventions change."""
    given = {
        Kind.ATTENTION: bool(interventions.attention),
        Kind.PROMPT: interventions.prompt is not None,
        Kind.IMAGE: bool(interventions.images),
        Kind.NOISE: interventions.noise is not None,
    }
    changed = [kind for kind, is_given in given.items() if is_given]
    if not interventions.keys:
        return Kind.NOTHING if not changed else changed[0] if len(changed) == 1 else Kind.SEVERAL
    kinds = {_kind_of_knockout(knockout) for knockout in interventions.keys}
    return kinds.pop() if not changed and len(kinds) == 1 else Kind.SEVERAL


def _kind_of_knockout(knockout: KeyKnockout) -> Kind:
    if knockout.random_seed is not None:
        return Kind.RANDOM
    return Kind.ONLY if knockout.keep else Kind.WITHOUT


def group_of(interventions: Interventions) -> GroupOfKeys | None:
    """The keys that interventions are about: one union of selectors in one place, else None."""
    if kind_of(interventions) not in (Kind.WITHOUT, Kind.ONLY, Kind.RANDOM, Kind.ATTENTION):
        return None
    changes = (*interventions.keys, *interventions.attention)
    places = {Place(change.layers, change.heads, change.denoise_steps) for change in changes}
    if len(places) > 1 or (kind_of(interventions) == Kind.ONLY and len(changes) > 1):
        return None
    return GroupOfKeys(tuple(change.selector for change in changes), places.pop())


def _not_random(interventions: Interventions) -> Interventions:
    keys = tuple(replace(knockout, random_seed=None) for knockout in interventions.keys)
    return replace(interventions, name="", keys=keys)


def _not_kept(interventions: Interventions) -> Interventions:
    keys = tuple(replace(knockout, keep=False) for knockout in interventions.keys)
    return replace(interventions, name="", keys=keys)
