"""`vla-capture rerun --series`: every group of a grouping is taken out, kept alone, and as many random keys taken out.

All conditions are made in one process, each into a store of its own.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from vla_attention.capture.effects.arguments import EffectSettings, effect_settings
from vla_attention.capture.engine.progress import duration, say
from vla_attention.capture.interventions.arguments import InterventionSettings, interventions_of
from vla_attention.capture.interventions.attention_edits import QueryWithoutKeys
from vla_attention.capture.interventions.condition_name import knockout_of_group
from vla_attention.capture.interventions.resolution import (
    TooFewKeys,
    check_places,
    episode_vocabularies,
    interventions_for,
)
from vla_attention.capture.rerun.arguments import RerunOutput, RerunSettings
from vla_attention.capture.rerun.base_store import check_may_change
from vla_attention.capture.rerun.rerun_store import Rerun
from vla_attention.schemas.errors import BadArgument, UserError, listing
from vla_attention.schemas.groupings.builtin_groupings import find_grouping
from vla_attention.schemas.groupings.grouping import REST
from vla_attention.schemas.groupings.selector_weights import selector_weights
from vla_attention.schemas.groupings.vocabulary import EpisodeTokens, Vocabulary
from vla_attention.schemas.interventions import Interventions, KeyKnockout, NoiseChange, readers
from vla_attention.schemas.layout import Role
from vla_attention.schemas.options import read_options
from vla_attention.schemas.safe_text import file_part
from vla_attention.schemas.stores.reader import Store
from vla_attention.schemas.stores.store_format import STORE_SUFFIX
from vla_attention.schemas.stores.store_place import check_writable
from vla_attention.schemas.stores.store_url import local_path

#: Site -> an episode's tokens.
TokensOfSites = Mapping[str, EpisodeTokens]


@dataclass(frozen=True)
class SeriesCondition:
    """One rerun of a series: what is changed, and in which episodes (all those whose calls have the group)."""

    interventions: Interventions
    episodes: frozenset[str]

    @property
    def name(self) -> str:
        """The condition's name, which is that of its store."""
        return self.interventions.name


@dataclass(frozen=True)
class Series:
    """The reruns of a series in the order in which they are made, and lines: for whom keys are cut, what is missing."""

    conditions: tuple[SeriesCondition, ...]
    notes: tuple[str, ...]


@dataclass(frozen=True)
class _GroupKeys:
    """Where a group has keys: whole episodes, and those in which a random control finds enough other keys."""

    episodes: frozenset[str]
    with_control: frozenset[str]


def plan_series(
    base: Store,
    grouping: str,
    template: KeyKnockout,
    noise_seed: int,
    *,
    words: KeyKnockout | None = None,
    objects: bool = False,
) -> Series:
    """Plan the reruns of a store.

    A group that some call of an episode has no key for is left out in that episode, and a group without any whole
    episode altogether. Keys that hold nothing (padding, masked cameras) and action keys do not count.

    Args:
        base: the store.
        grouping: name or file of a grouping; groups that take the rest (`*`) are left out.
        template: places, queries, weight and seed of all knockouts but those of words; its selector is not used.
        noise_seed: of the condition `noise`.
        words: the same for further groups, one for every word of the instructions; None for no such groups.
        objects: whether there are further groups, one for every object of the scenes.
    """
    sites = [site.name for site in base.attributes.sites]
    tokens: dict[str, TokensOfSites] = {
        episode.name: {site: episode.tokens(base.attributes, site) for site in sites} for episode in base.episodes
    }
    vocabularies = episode_vocabularies(list(tokens.values()))
    groups = {
        name: replace(template, selector=selector) for name, selector in _groups_of(grouping, vocabularies).items()
    }
    if words is not None:
        groups |= {name: replace(words, selector=selector) for name, selector in _words(vocabularies).items()}
    if objects:
        groups |= {name: replace(template, selector=selector) for name, selector in _objects(vocabularies).items()}
    everywhere = frozenset(tokens)
    conditions = [SeriesCondition(Interventions("noise", noise=NoiseChange(noise_seed)), everywhere)]
    absent, notes = [], [_for_whom(template, words)]
    for name, given in groups.items():
        keys = _keys_of(given.selector, tokens, vocabularies)
        if not keys.episodes:
            absent.append(name)
            continue
        if keys.episodes != everywhere:
            notes.append(
                f"Group '{name}': {len(everywhere) - len(keys.episodes)} of {len(everywhere)} episodes are left out, "
                "in which some replan has no key of it."
            )
        knockout = replace(given, keep=False, random_seed=None)
        conditions.append(SeriesCondition(knockout_of_group("without", name, knockout), keys.episodes))
        alone = knockout_of_group("only", name, replace(knockout, keep=True))
        conditions.append(SeriesCondition(alone, keys.episodes))
        if keys.with_control:
            random = knockout_of_group("random", name, replace(knockout, random_seed=given.random_seed or 0))
            conditions.append(SeriesCondition(random, keys.with_control))
        if keys.with_control != keys.episodes:
            notes.append(
                f"Group '{name}' has a random control in {len(keys.with_control)} of {len(keys.episodes)} episodes: in "
                "the others some replan has fewer keys outside of it than inside."
            )
    if absent:
        notes.insert(1, f"Left out, as no episode has valid keys of them in all of its replans: {listing(absent, 40)}.")
    return Series(tuple(conditions), tuple(notes))


def _for_whom(template: KeyKnockout, words: KeyKnockout | None) -> str:
    of_groups = readers(template.queries, template.query_selector)
    of_words = "" if words is None else readers(words.queries, words.query_selector)
    if of_words in ("", of_groups):
        return f"Keys are cut for {of_groups}; --knockout-queries chooses others."
    return (
        f"Keys of words are cut for {of_words}, those of other groups for {of_groups}; --knockout-queries chooses one "
        "for both."
    )


def _groups_of(grouping: str, vocabularies: Mapping[str, Vocabulary]) -> dict[str, str]:
    """Return group -> selector of a grouping at all sites that it exists at, without the groups of the rest."""
    groups: dict[str, str] = {}
    problems: list[UserError] = []
    for vocabulary in vocabularies.values():
        try:
            known = find_grouping(grouping, vocabulary)
        except UserError as error:
            problems.append(error)
            continue
        for name, selectors in known.groups.items():
            if not any(selector.strip() == REST for selector in selectors):
                joined = " | ".join(f"({selector})" for selector in selectors) if len(selectors) > 1 else selectors[0]
                groups.setdefault(name, joined)
    if not groups and problems:
        raise problems[0]
    return groups


def _words(vocabularies: Mapping[str, Vocabulary]) -> dict[str, str]:
    words = dict.fromkeys(word for vocabulary in vocabularies.values() for word in vocabulary.words)
    return {f"word_{word}": f'word:"{word}"' for word in words}


def _objects(vocabularies: Mapping[str, Vocabulary]) -> dict[str, str]:
    names = dict.fromkeys(name for vocabulary in vocabularies.values() for name in vocabulary.objects)
    return {f"object_{name}": f'object:"{name}"' for name in names}


def _keys_of(selector: str, tokens: Mapping[str, TokensOfSites], vocabularies: Mapping[str, Vocabulary]) -> _GroupKeys:
    episodes, with_control = set(), set()
    for name, of_sites in tokens.items():
        counts = list(_counts(selector, of_sites, vocabularies))
        if (np.sum([inside for inside, _ in counts], axis=0) > 0).all():
            episodes.add(name)
            if all((np.round(inside) <= outside).all() for inside, outside in counts):
                with_control.add(name)
    return _GroupKeys(frozenset(episodes), frozenset(with_control))


def _counts(
    selector: str, tokens: TokensOfSites, vocabularies: Mapping[str, Vocabulary]
) -> Iterator[tuple[NDArray[np.float64], NDArray[np.int64]]]:
    """Return for every site the number of the group's keys, and of the other keys, each (replan,).

    Valid keys that are no action keys count.
    """
    for site, weights in selector_weights(selector, tokens, vocabularies).items():
        of_site = tokens[site]
        countable = of_site.valid & (of_site.static_roles != int(Role.ACTION))
        shape = (of_site.num_replans,)
        inside = np.broadcast_to((weights * countable).sum(axis=1), shape)
        yield inside, np.broadcast_to((countable & (weights == 0)).sum(axis=1), shape)


@dataclass(frozen=True)
class SeriesRun:
    """A planned series and the folder of its stores."""

    base: Store
    series: Series
    folder: Path

    @classmethod
    def planned(cls, arguments: argparse.Namespace, base: Store) -> SeriesRun:
        """Plan the series of the arguments. Needs no policy; errors come before the minutes for loading one."""
        settings, output = read_options(RerunSettings, arguments), read_options(RerunOutput, arguments)
        changes = read_options(InterventionSettings, arguments)
        _refuse_own_interventions(output, changes, effect_settings(arguments))
        # Any selector: the plan replaces it.
        template = interventions_of(dataclasses.replace(changes, knockout=("role:image",), noise_seed=None)).keys[0]
        # A word acts through the pictures that have read it: cut for the action queries alone, it seems to do nothing.
        words = template if changes.knockout_queries is not None else replace(template, queries="all")
        check_places(Interventions(keys=(template,)), base.attributes.policy)
        series = plan_series(
            base,
            str(settings.series),
            template,
            base.attributes.protocol.seed + 1 if changes.noise_seed is None else changes.noise_seed,
            words=words if settings.words else None,
            objects=settings.objects,
        )
        check_may_change(base, series.conditions[0].interventions)
        folder = output.output_dir or local_path(base.path).with_name(f"{base.path.stem}_reruns")
        check_writable(folder, "--output-dir")
        return cls(base, series, folder)

    def write(self, rerun: Rerun, seconds_of_call: float | None) -> None:
        """Make all reruns that are not whole yet. seconds_of_call: for an estimate of the time; None: no estimate."""
        for note in self.series.notes:
            say(note)
        calls_of = {episode.name: episode.attributes.num_replans for episode in self.base.episodes}
        conditions = self.series.conditions
        changes = [interventions_for(condition.interventions, rerun.policy) for condition in conditions]
        calls = [calls_of[name] for condition in conditions for name in condition.episodes]
        time = "" if seconds_of_call is None else f", about {duration(sum(calls) * seconds_of_call)} if none is there"
        say(f"Series: {len(conditions)} conditions, {sum(calls)} policy calls{time}. Folder: {self.folder}")
        say(rerun.describe_disk(self.folder, calls))
        impossible = []
        for number, (condition, changed) in enumerate(zip(conditions, changes, strict=True), start=1):
            say(f"[{number}/{len(conditions)}] {condition.name}: {changed.describe()}")
            try:
                self._write(rerun, condition, changed)
            except (QueryWithoutKeys, TooFewKeys) as error:
                say(f"{condition.name} is left out: {error}")
                impossible.append(condition.name)
        if impossible:
            say(f"Not possible: {listing(impossible, 40)}; the reasons are above.")
        say(f"Next: vla-attention compare {self.base.path} {self.folder}/*{STORE_SUFFIX}")

    def _write(self, rerun: Rerun, condition: SeriesCondition, changed: Interventions) -> None:
        target = self.folder / f"{file_part(condition.name)}{STORE_SUFFIX}"
        rerun.write(target, "resume", changed, lambda episode: episode.name in condition.episodes)


def _refuse_own_interventions(
    output: RerunOutput, changes: InterventionSettings, effects: EffectSettings | None
) -> None:
    for option, given in (
        ("--knockout", changes.knockout),
        ("--keep", changes.keep),
        ("--attention", changes.attention),
        ("--prompt", changes.prompt),
        ("--image", changes.image),
        ("--allow-empty", changes.allow_empty),
        ("--name", output.name),
        ("--output NAME.zarr", output.store),
        ("--overwrite", output.overwrite),
        ("--effects", effects),
    ):
        if given:
            raise BadArgument(
                f"Cannot use {option} with --series, which makes its own interventions and stores; run vla-attention "
                "capture rerun once more for others."
            )
