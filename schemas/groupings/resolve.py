"""From a grouping and an episode's tokens to a weight per key and group, with the checks of names and overlaps.

An object covers a fraction of a patch, and a letterbox cuts some, so sets of keys are not enough. Every key is divided
into cells, one per scene object (a key without object coverage has one cell). A selector is a set of (key, cell) pairs,
so that union, intersection and difference are exact. A key's weight is the covered area of its chosen cells.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vla_attention.schemas.errors import plural, shortened
from vla_attention.schemas.groupings.grouping import REST, Grouping, GroupingError
from vla_attention.schemas.groupings.selector_parser import (
    Atom,
    Everything,
    Selector,
    atoms_of,
    folded,
    parse_selector,
)
from vla_attention.schemas.groupings.selectors import SELECTOR_KINDS, Membership, SelectorError, no_keys, num_cells
from vla_attention.schemas.groupings.vocabulary import EpisodeTokens, Vocabulary


class OverlappingGroups(GroupingError):
    """Two groups of a grouping that must be disjoint share keys."""


class EmptyGroup(GroupingError):
    """A group that has no key in anything that is analysed."""


@dataclass(frozen=True)
class ResolvedGrouping:
    """A grouping on one episode's keys.

    Attributes:
        names: group names, in the order of the group axis.
        weights: weight of each key in each group, shape (replan or 1, key, group) float32, 0..1.
        num_keys: number of keys of each group (the sum of its weights over keys that exist), shape (replan or 1, group)
            float64.
        num_valid: number of keys that can hold information, shape (replan or 1,).
    """

    names: tuple[str, ...]
    weights: NDArray[np.float32]
    num_keys: NDArray[np.float64]
    num_valid: NDArray[np.int64]


def check_names(grouping: Grouping, vocabulary: Vocabulary) -> None:
    """Raise `SelectorError` or `UnknownName` for the first selector with a name that no selected episode has."""
    for group, selectors in grouping.groups.items():
        for text in selectors:
            for atom in dict.fromkeys(atoms_of(parse_selector(text))):
                problem = SELECTOR_KINDS[atom.kind].problem(atom.argument, vocabulary)
                if problem:
                    raise SelectorError(f"Group '{group}', selector '{shortened(text)}': {problem}")


def resolve(grouping: Grouping, tokens: EpisodeTokens) -> ResolvedGrouping:
    """Turn a grouping into weights on one episode's keys.

    A word or an object that this episode lacks gives a group without keys here (`check_names` has checked that another
    episode has it). Raises `OverlappingGroups` unless the grouping allows overlap.
    """
    members = memberships(grouping, tokens)
    cells = cell_coverage(tokens) if any(member.shape[2] > 1 for member in members.values()) else None
    stacked = stack_over_keys([_weights(member, cells) for member in members.values()])
    return ResolvedGrouping(
        names=grouping.names,
        weights=stacked,
        num_keys=counted_keys(stacked, tokens.existing),
        num_valid=tokens.valid.sum(axis=1),
    )


def stack_over_keys(weights: Sequence[NDArray[np.float32]]) -> NDArray[np.float32]:
    """Weights (replan or 1, key) side by side: (replan or 1, key, group).

    Where they are the same at all replans, one of these is in memory, and the result must not be written to: weights of
    a word in hundreds of episodes then take little, and stay in the processor's cache.
    """
    replans = max(len(weight) for weight in weights)
    each = [once_if_unchanged(weight) for weight in weights]
    kept = max(len(weight) for weight in each)
    keys = weights[0].shape[1]
    stacked = np.stack([np.broadcast_to(weight, (kept, keys)) for weight in each], axis=-1, dtype=np.float32)
    return np.broadcast_to(stacked, (replans, keys, len(weights)))


def once_if_unchanged(weights: NDArray[np.float32]) -> NDArray[np.float32]:
    """Weights (replan or 1, key, ...), of the first replan alone where they are the same at all."""
    return weights[:1] if (weights[1:] == weights[:-1]).all() else weights


def counted_keys(weights: NDArray[np.float32], existing: NDArray[np.bool_] | None) -> NDArray[np.float64]:
    """Numbers of keys (replan or 1, group) from weights (replan or 1, key, group) and `EpisodeTokens.existing`."""
    if existing is None and weights.strides[0] == 0:  # the same at all replans, see `stack_over_keys`
        return np.repeat(weights[:1].sum(axis=1, dtype=np.float64), len(weights), axis=0)
    counted = weights if existing is None else weights * existing[:, :, None]
    numbers: NDArray[np.float64] = counted.sum(axis=1, dtype=np.float64)
    return numbers


def memberships(grouping: Grouping, tokens: EpisodeTokens) -> dict[str, Membership]:
    """Which (key, cell) pairs each group takes, shape (replan or 1, key, cell or 1); disjointness is checked here."""
    members: dict[str, Membership] = {}
    taken = no_keys(tokens)
    for group, selectors in grouping.groups.items():
        if selectors[0].strip() == REST:
            members[group] = taken  # keeps the order; replaced below
            continue
        member = no_keys(tokens)
        for selector in selectors:
            try:
                member = member | _evaluate(parse_selector(selector), tokens)
            except SelectorError as error:
                raise SelectorError(f"Group '{group}': {error}") from None
        if not grouping.overlap and (taken & member).any():
            _raise_overlap(group, member, members, tokens)
        members[group] = member
        taken = taken | member
    for group, selectors in grouping.groups.items():
        if selectors[0].strip() == REST:
            members[group] = ~taken
    return members


def shared_keys(grouping: Grouping, tokens: EpisodeTokens) -> NDArray[np.float64]:
    """Number of keys that two groups share, shape (replan or 1, group, group); each group's own on the diagonal.

    Exact for objects too: two halves of one patch that do not touch share nothing.
    """
    members = list(memberships(grouping, tokens).values())
    cells = cell_coverage(tokens) if any(member.shape[2] > 1 for member in members) else None
    counts = {
        (i, j): _weights(first & second, cells).sum(axis=1, dtype=np.float64)
        for i, first in enumerate(members)
        for j, second in enumerate(members[: i + 1])
    }
    replans = max(len(count) for count in counts.values())
    shared = np.zeros((replans, len(members), len(members)))
    for (i, j), count in counts.items():
        shared[:, i, j] = shared[:, j, i] = count
    return shared


def _raise_overlap(group: str, member: Membership, others: dict[str, Membership], tokens: EpisodeTokens) -> None:
    for other, theirs in others.items():
        shared = (member & theirs).any(axis=(0, 2))
        if shared.any():
            key = int(np.flatnonzero(shared)[0])
            raise OverlappingGroups(
                f"Groups '{other}' and '{group}' share {plural(int(shared.sum()), 'token')} "
                f"(the first is {describe_key(key, tokens)}); "
                "take them out of one group with ' - ', or write the groups into a file with overlap = true."
            )


def describe_key(key: int, tokens: EpisodeTokens) -> str:
    """A key in words, for messages: its number, its span, and its piece of text if it has one."""
    span = next(span for span in tokens.layout.spans if span.start <= key < span.stop)
    text = next((piece.text for prompt in tokens.prompts for piece in prompt.pieces if piece.key == key), None)
    return f"key {key} of span '{span.name}'" + (f", {text!r}" if text is not None else "")


def cell_coverage(tokens: EpisodeTokens) -> NDArray[np.float32]:
    """Area of each key's cells (`num_cells`), shape (replan, key, cell); they sum to 1."""
    replans, keys, things = tokens.num_replans, tokens.layout.num_keys, len(tokens.objects)
    area = np.zeros((replans, keys, num_cells(tokens)), dtype=np.float32)
    for camera, coverage in (tokens.coverage or {}).items():
        area[:, tokens.layout.patch_keys(camera), 1 : 1 + things] = coverage
    if tokens.border is not None:
        # Objects are in what shows a picture, of which they cover the same shares.
        area *= 1.0 - tokens.border[:, None]
        area[:, :, -1] = tokens.border
    area[:, :, 0] = np.clip(1.0 - area[:, :, 1:].sum(axis=2), 0.0, 1.0)
    return area


def weights_of(selector: Selector, tokens: EpisodeTokens) -> NDArray[np.float32]:
    """Weight of each key in the group of one selector, shape (replan or 1, key), 0..1."""
    member = _evaluate(selector, tokens)
    return _weights(member, cell_coverage(tokens) if member.shape[2] > 1 else None)


def _weights(member: Membership, cells: NDArray[np.float32] | None) -> NDArray[np.float32]:
    if member.shape[2] == 1 or cells is None:
        return member[:, :, 0].astype(np.float32)
    # A sum of area fractions may exceed 1 by rounding; a weight may not.
    area: NDArray[np.float32] = (cells * member).sum(axis=2, dtype=np.float32)
    return np.minimum(area, np.float32(1.0))


def _evaluate(selector: Selector, tokens: EpisodeTokens) -> Membership:
    memberships: dict[Atom, Membership] = {}  # long unions say the same more than once

    def keys(part: Atom | Everything) -> Membership:
        if isinstance(part, Everything):
            return np.ones((1, tokens.layout.num_keys, 1), dtype=bool)
        if part not in memberships:
            memberships[part] = SELECTOR_KINDS[part.kind].keys(part.argument, tokens)
        return memberships[part]

    def join(operator: str, left: Membership, right: Membership) -> Membership:
        if operator == "&":
            return left & right
        return left | right if operator == "|" else left & ~right

    return folded(selector, keys, join)
