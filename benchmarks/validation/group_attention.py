"""Attention to groups of keys in some layers and heads, replan by replan."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vla_attention.analyze.core.contributions import joint_norm, selected_gram, whole_segments
from vla_attention.analyze.core.levels import levels_of
from vla_attention.analyze.core.measure import Measured
from vla_attention.analyze.measures.question import Question, select_again
from vla_attention.analyze.measures.selected import SelectedEpisode, load_tokens, resolve_all, vocabulary_of
from vla_attention.schemas.errors import BadArgument, UserError
from vla_attention.schemas.groupings.grouping import Grouping
from vla_attention.schemas.groupings.resolve import ResolvedGrouping, check_names
from vla_attention.schemas.safe_text import visible

Array = NDArray[np.float64]

#: The columns of `GroupAttention.values`.
MEASURES = ("mass", "lift", "norm", "keys")


@dataclass(frozen=True)
class Place:
    """Where attention is measured; None is everywhere."""

    layers: tuple[int, ...] | None = None
    heads: tuple[int, ...] | None = None
    denoise_steps: tuple[int, ...] | None = None


@dataclass(frozen=True)
class GroupOfKeys:
    """The union of selectors of the grouping language, and where it counts."""

    selectors: tuple[str, ...]
    place: Place = Place()

    @property
    def text(self) -> str:
        """The selectors as one."""
        return visible(" | ".join(self.selectors))


@dataclass(frozen=True)
class GroupAttention:
    """The base's attention to one group of keys.

    Attributes:
        site: the softmax family whose rows it is of; None where no site has such keys.
        values: by the name of an episode, (replan, measure) in the order of `MEASURES`; NaN where there is none. Of a
            group that has no key in any selected episode, the keys are 0.
        note: why there is no attention, or nothing.
    """

    site: str | None
    values: dict[str, Array]
    note: str = ""


def group_attention(
    question: Question, groups: Sequence[GroupOfKeys], everything: Sequence[SelectedEpisode] | None = None
) -> dict[GroupOfKeys, GroupAttention]:
    """Attention of a question's episodes to groups, each in the layers, heads and denoise steps where it was changed.

    `everything`: all of the base's episodes, whose words and objects are the names that exist; those of the question
    unless given.

    A group is read at the question's site, or where it has no keys there and the user chose no site, at the next one
    that has. `lift` is that of `core.measure.means`, `norm` that of the group's contribution where the group is
    made of whole segments and contributions were recorded.
    """
    names = [site.name for site in question.stores[0].attributes.sites]
    others = [name for name in names if name != question.site]
    attention: dict[GroupOfKeys, GroupAttention] = {}
    known: set[GroupOfKeys] = set()
    left = list(dict.fromkeys(groups))
    for site in (question.site, *others):
        if not left:
            break
        try:
            here = _at_site(question, site, question.selected if everything is None else everything)
        except BadArgument as error:  # the chosen layers are none of that site's
            attention |= {group: GroupAttention(None, {}, str(error)) for group in left if group not in attention}
            continue
        fitting, empty, notes = _fitting(here, left)
        attention |= {group: GroupAttention(None, {}, note) for group, note in notes.items() if group not in attention}
        if fitting and (site == question.site or question.settings.site is None):
            attention |= _measured(here, fitting)
        known.update(empty)
        left = [group for group in left if group not in fitting]
    # A name that exists in the base, and has no key in the selected episodes: there, nothing was changed.
    nothing = {item.episode.name: _without_keys(item) for item in question.selected}
    return attention | {group: replace(attention[group], values=nothing) for group in left if group in known}


def _at_site(question: Question, site: str, everything: Sequence[SelectedEpisode]) -> Question:
    if site == question.site:
        return replace(question, vocabulary=vocabulary_of(everything))
    selected = tuple(load_tokens(question.episodes, site))
    tokens_of_site = load_tokens([(item.store, item.episode) for item in everything], site)
    selection = select_again(question, site)
    return replace(
        question, site=site, selected=selected, vocabulary=vocabulary_of(tokens_of_site), selection=selection
    )


def _without_keys(item: SelectedEpisode) -> Array:
    values = np.full((item.episode.attributes.num_replans, len(MEASURES)), np.nan)
    values[:, MEASURES.index("keys")] = 0.0
    return values


def _grouping(groups: Sequence[GroupOfKeys]) -> Grouping:
    """One grouping of all groups. A selector alone in its group would mean the rest where it is '*': it gets brackets.

    Groups share keys: each is measured by itself.
    """
    members = {f"g{i}": tuple(f"({text})" for text in group.selectors) for i, group in enumerate(groups)}
    return Grouping("conditions", members, overlap=True, allow_empty=tuple(members))


def _fitting(
    question: Question, groups: Sequence[GroupOfKeys]
) -> tuple[list[GroupOfKeys], list[GroupOfKeys], dict[GroupOfKeys, str]]:
    """The groups that have keys at a site, those whose names exist without any key, and why the others have none."""
    fitting, empty, notes = [], [], {}
    for group in groups:
        try:
            grouping = _grouping([group])
            check_names(grouping, question.vocabulary)
            resolved = resolve_all(grouping, question.selected, question.vocabulary)
        except UserError as error:
            notes[group] = str(error)
            continue
        if any(one.num_keys.any() for one in resolved):
            fitting.append(group)
        else:
            empty.append(group)
            notes[group] = f"'{group.text}' has no key at site '{question.site}'."
    return fitting, empty, notes


def _measured(question: Question, groups: Sequence[GroupOfKeys]) -> dict[GroupOfKeys, GroupAttention]:
    grouping = _grouping(groups)
    resolved = resolve_all(grouping, question.selected, question.vocabulary)
    per_head = any(group.place.heads is not None for group in groups)
    measured = levels_of(replace(question, grouping=grouping), per_head).measured
    with_norms = all(store.attributes.recording.contributions for store in question.stores)
    values: dict[GroupOfKeys, dict[str, Array]] = {group: {} for group in groups}
    for item, weights, one in zip(question.selected, resolved, measured, strict=True):
        parts = whole_segments(item, weights, question.site) if with_norms else {}
        for i, group in enumerate(groups):
            norm = _norm(item, one, group, parts[f"g{i}"], question.site) if f"g{i}" in parts else None
            values[group][item.episode.name] = _of_group(one, weights, group, i, norm)
    return {group: GroupAttention(question.site, values[group]) for group in groups}


def _places(chosen: Sequence[int], wanted: Sequence[int] | None) -> list[int]:
    """Positions of the wanted numbers among the chosen ones; all positions where all are wanted."""
    return [i for i, number in enumerate(chosen) if wanted is None or number in wanted]


def _of_group(
    measured: Measured, resolved: ResolvedGrouping, group: GroupOfKeys, number: int, norm: Array | None
) -> Array:
    """`MEASURES` of one group (replan, measure). Masses are averaged over layers, denoise steps and heads first."""
    selection, place = measured.selection, group.place
    layers = [i for i in _places(selection.blocks, place.layers) if i in selection.once]
    denoise = _places(selection.denoise_steps, place.denoise_steps)
    # Heads are apart only where a group asks for some of them.
    apart = selection.per_head
    heads = _places(selection.head_numbers, place.heads) if apart else [0]
    replans = len(measured.mass)
    if not (layers and denoise and heads):
        return np.full((replans, len(MEASURES)), np.nan)
    cells = np.ix_(range(replans), layers, denoise, heads)
    mass, valid, uniform_mass, uniform_valid = (
        np.broadcast_to(values, measured.valid.shape)[cells].mean(axis=(1, 2, 3))
        for values in (
            measured.mass[..., number],
            measured.valid,
            measured.uniform[..., number],
            measured.uniform_valid,
        )
    )
    keys = resolved.num_keys[:, number : number + 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        lift = np.where(uniform_mass > 0, mass / uniform_mass, np.nan) / (valid / uniform_valid)
    columns = (
        mass,
        lift,
        np.full(replans, np.nan) if norm is None else norm,
        np.broadcast_to(keys[:, 0], replans),
    )
    return np.stack(columns, axis=1)


def _norm(
    item: SelectedEpisode, measured: Measured, group: GroupOfKeys, taken: NDArray[np.bool_], site: str
) -> Array | None:
    """Norm of the group's contribution (replan,), mean over its layers and denoise steps; contributions have no heads.

    None where the intervention was at some heads only, or at nothing that is selected.
    """
    selection, place = measured.selection, group.place
    layers = [i for i in _places(selection.blocks, place.layers) if i in selection.once]
    denoise = _places(selection.denoise_steps, place.denoise_steps)
    if place.heads is not None or not (layers and denoise):
        return None
    gram = selected_gram(item, site, selection)[:, layers][:, :, denoise]
    return np.asarray(joint_norm(gram, taken).mean(axis=(1, 2)))
