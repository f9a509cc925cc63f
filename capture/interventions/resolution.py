"""From interventions and the keys of one replan to the edits of each site's attention."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from vla_attention.capture.interventions.factors import SiteEdit, SiteEditor
from vla_attention.capture.policies.policy import Policy
from vla_attention.schemas.errors import BadArgument, unknown_name
from vla_attention.schemas.groupings.resolve import EmptyGroup
from vla_attention.schemas.groupings.selector_weights import check_selector, selector_weights
from vla_attention.schemas.groupings.vocabulary import EpisodeTokens, SceneObject, Vocabulary, collect_vocabulary
from vla_attention.schemas.groupings.words import folded_words
from vla_attention.schemas.interventions import AttentionScale, AttentionUniform, Interventions, KeyKnockout
from vla_attention.schemas.layers import select_layers
from vla_attention.schemas.layout import Prompt, Role, SiteLayout
from vla_attention.schemas.stores.store_format import PolicyIdentity, episode_name

_Edit = KeyKnockout | AttentionScale | AttentionUniform
_AnyEdit = TypeVar("_AnyEdit", bound=_Edit)


class TooFewKeys(BadArgument):
    """A random control that needs more keys than there are outside of its group."""


@dataclass(frozen=True)
class ReplanPlace:
    """Which replan of which episode; random controls are drawn for it."""

    task_id: int
    episode_index: int
    replan: int

    def __str__(self) -> str:
        return f"replan {self.replan} of {episode_name(self.task_id, self.episode_index)}"


def check_places(interventions: Interventions, policy: Policy | PolicyIdentity) -> None:
    """Raise `BadArgument` for layers, heads, denoise steps and cameras that a policy, or a store's policy, lacks."""
    for edit in (*interventions.keys, *interventions.attention):
        select_layers(edit.layers, policy.num_layers, policy.family)
        _check_numbers(edit, "head", edit.heads, policy.num_heads)
        _check_numbers(edit, "denoise step", edit.denoise_steps, policy.num_denoise_steps)
    for change in interventions.images:
        if change.camera not in (names := [camera.name for camera in policy.cameras]):
            raise unknown_name("camera", change.camera, names)


def interventions_for(interventions: Interventions, policy: Policy) -> Interventions:
    """Return the interventions with block indices for layer numbers; raise `BadArgument` for what the policy lacks."""
    check_places(interventions, policy)

    def placed(edit: _AnyEdit) -> _AnyEdit:
        if edit.layers is not None:
            blocks = select_layers(edit.layers, policy.num_layers, policy.family).blocks
            edit = replace(edit, layers=tuple(sorted(set(blocks))))
        if edit.queries == "prefix" and not policy.has_prefix:
            raise BadArgument(
                f"The intervention on '{edit.selector}' is on the queries of a prefix, and the policy '{policy.name}' "
                "has none; use the queries 'action' or 'all'."
            )
        if edit.denoise_steps is not None and policy.has_prefix and edit.queries != "action":
            raise BadArgument(
                f"The intervention on '{edit.selector}' is limited to denoise steps, but the prefix, whose queries it "
                f"changes too, runs once before all of them; use the queries 'action', or all denoise steps."
            )
        return edit

    return replace(
        interventions,
        keys=tuple(placed(edit) for edit in interventions.keys),
        attention=tuple(placed(edit) for edit in interventions.attention),
    )


def _check_numbers(edit: _Edit, what: str, numbers: Sequence[int] | None, count: int) -> None:
    for number in numbers or ():
        if not 0 <= number < count:
            raise BadArgument(
                f"There is no {what} {number} for the intervention on '{edit.selector}'; expected 0 to {count - 1}."
            )


def selectors_of(interventions: Interventions) -> tuple[str, ...]:
    """Every selector of the interventions once, in order."""
    edits = (*interventions.keys, *interventions.attention)
    readers = [edit.query_selector for edit in interventions.keys if edit.query_selector]
    return tuple(dict.fromkeys([*(edit.selector for edit in edits), *readers]))


def site_tokens(
    sites: Sequence[SiteLayout],
    key_role: Mapping[str, NDArray[np.uint8]],
    prompt: Prompt,
    objects: Sequence[SceneObject],
    coverage: Mapping[str, NDArray[np.float32]],
) -> dict[str, EpisodeTokens]:
    """Return what selectors need of one replan's keys, by site.

    Args:
        key_role: site -> (key,) role codes.
        objects: the scene's objects, in the order of the coverage's last axis.
        coverage: camera -> (patch, object), 0..1.
    """
    tokens: dict[str, EpisodeTokens] = {}
    for layout in sites:
        # A prompt's pieces are keys of the site that reads it.
        reads = any(span.kind == "text" for span in layout.spans)
        tokens[layout.name] = EpisodeTokens(
            layout=layout,
            key_role=key_role[layout.name][None],
            prompts=(prompt,) if reads else (),
            objects=tuple(objects),
            coverage={camera: values[None] for camera, values in coverage.items() if camera in layout.pictured},
        )
    return tokens


def run_vocabularies(
    sites: Sequence[SiteLayout], instructions: Sequence[str], objects: Sequence[SceneObject]
) -> dict[str, Vocabulary]:
    """Return the names that selectors may use in a run of these instructions in a scene, by site."""
    sentences = tuple(dict.fromkeys(folded_words(text) for text in instructions))
    vocabularies: dict[str, Vocabulary] = {}
    for layout in sites:
        reads = any(span.kind == "text" for span in layout.spans)
        vocabularies[layout.name] = Vocabulary(
            layout=layout,
            cameras=layout.cameras,
            roles=tuple(role.label for role in Role),
            words=tuple(dict.fromkeys(word for sentence in sentences for word in sentence)) if reads else (),
            objects=tuple(thing.name for thing in objects) if layout.pictured else (),
            sentences=sentences if reads else (),
        )
    return vocabularies


def check_selectors(interventions: Interventions, vocabularies: Mapping[str, Vocabulary]) -> None:
    """Raise `SelectorError` for the first selector that cannot be read, or that has a name that no site has."""
    for selector in selectors_of(interventions):
        check_selector(selector, vocabularies)


def empty_replans(
    interventions: Interventions, tokens: Mapping[str, EpisodeTokens], vocabularies: Mapping[str, Vocabulary]
) -> dict[str, NDArray[np.bool_]]:
    """Return for every selector the replans in which its group has no valid key at any site, (replan,) bool.

    tokens: site -> the tokens of an episode or of one replan.
    """
    empty = {}
    replans = next(iter(tokens.values())).num_replans
    for selector in selectors_of(interventions):
        weights = selector_weights(selector, tokens, vocabularies)
        # Keys that are masked, such as those of a camera that the suite has not, are none.
        counts = [
            np.broadcast_to((weight * tokens[site].valid).sum(axis=1), replans) for site, weight in weights.items()
        ]
        empty[selector] = np.asarray(sum(counts) == 0)
    return empty


def has_empty_group(
    interventions: Interventions,
    tokens: Mapping[str, EpisodeTokens],
    vocabularies: Mapping[str, Vocabulary],
    place: ReplanPlace,
    *,
    allow_empty: bool = False,
) -> bool:
    """Return whether the group of some selector has no key in one replan; raise `EmptyGroup` unless `allow_empty`."""
    empty = [selector for selector, empty in empty_replans(interventions, tokens, vocabularies).items() if empty.any()]
    if empty and not allow_empty:
        raise EmptyGroup(
            f"The group '{empty[0]}' of an intervention has no key at {place}: an object may be out of view, or the "
            "instruction lacks the word; add --allow-empty to leave such replans unchanged."
        )
    return bool(empty)


def make_editors(
    interventions: Interventions,
    tokens: Mapping[str, EpisodeTokens],
    vocabularies: Mapping[str, Vocabulary],
    place: ReplanPlace,
) -> dict[str, SiteEditor]:
    """Return the editors of one replan, by site; sites whose attention does not change have none.

    An intervention whose group has no valid key changes nothing.

    Args:
        tokens: site -> the replan's tokens, from `site_tokens`.
        vocabularies: site -> the names that exist in the run.
        place: the replan, for random controls.
    """
    edits: dict[str, list[SiteEdit]] = {site: [] for site in tokens}
    for number, edit in enumerate((*interventions.keys, *interventions.attention)):
        weights = selector_weights(edit.selector, tokens, vocabularies)
        readers = None
        if isinstance(edit, KeyKnockout) and edit.query_selector:
            readers = selector_weights(edit.query_selector, tokens, vocabularies)
        for site_number, (site, group) in enumerate(weights.items()):
            if not (group[0] * tokens[site].valid[0]).any():
                continue
            seed = (place.task_id, place.episode_index, place.replan, number, site_number)
            values = _values(edit, group[0], tokens[site], seed, place)
            edits[site].append(
                SiteEdit(
                    group=edit.describe(),
                    kind="uniform" if isinstance(edit, AttentionUniform) else "factor",
                    values=values,
                    queries=edit.queries,
                    readers=None if readers is None else readers[site][0] > 0,
                    layers=edit.layers,
                    heads=edit.heads,
                    denoise_steps=edit.denoise_steps,
                )
            )
    return {
        site: SiteEditor(site, changes)
        for site, changes in edits.items()
        if not all(change.changes_nothing for change in changes)
    }


def _values(
    edit: _Edit, group: NDArray[np.float64], tokens: EpisodeTokens, seed: tuple[int, ...], place: ReplanPlace
) -> NDArray[np.float64]:
    """Return the values of one edit at one site, (key,), see `SiteEdit`; `group` has the keys' weights."""
    if isinstance(edit, AttentionUniform):
        return group
    if isinstance(edit, AttentionScale):
        return 1 - group + group * edit.factor
    others = tokens.valid[0] & (tokens.static_roles[0] != Role.ACTION)
    if edit.keep:
        group = np.where(others, 1 - group, 0.0)
    if edit.random_seed is not None:
        size = float(group[tokens.valid[0]].sum())
        # An object that covers less than half of a patch has a control, too: one of no keys would change nothing.
        count = max(1, round(size)) if size > 0 else 0
        keys = np.flatnonzero(others & (group == 0))
        if len(keys) < count:
            raise TooFewKeys(
                f"The random control of '{edit.selector}' needs {count} keys outside of the group at {place}, and "
                f"there are {len(keys)}; choose a smaller group."
            )
        chosen = np.random.default_rng((edit.random_seed, *seed)).choice(keys, count, replace=False)
        group = np.zeros_like(group)
        group[chosen] = 1.0
    return 1 - edit.weight * group


def episode_vocabularies(episodes: Sequence[Mapping[str, EpisodeTokens]]) -> dict[str, Vocabulary]:
    """Return the names in stored episodes, by site."""

    def of_site(site: str) -> Iterator[EpisodeTokens]:
        return (tokens[site] for tokens in episodes)

    return {site: collect_vocabulary(of_site(site)) for site in (episodes[0] if episodes else ())}
