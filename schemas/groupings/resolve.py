"""From a grouping and an episode's tokens to a weight per key: the arithmetic of regrouping, and its checks.

Objects cover patches by fractions, so sets of keys are not enough. Every key is therefore seen as split into cells, one
per scene object (for keys without object coverage: a single cell). A selector is a set of (key, cell) pairs, so that union,
intersection and difference are exact, and a key's weight is the covered area of its chosen cells.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vla_attention.schemas.errors import did_you_mean, listing
from vla_attention.schemas.groupings.grouping import REST, Grouping, GroupingError
from vla_attention.schemas.groupings.selectors import (
    Atom,
    Everything,
    Selector,
    SelectorError,
    atoms_of,
    parse_selector,
)
from vla_attention.schemas.groupings.vocabulary import EpisodeTokens, Vocabulary
from vla_attention.schemas.groupings.words import Word, find_phrase, has_phrase, split_words, word_class
from vla_attention.schemas.layout import SiteLayout, find_role

#: Axes (replan or 1, key, cell or 1).
Membership = NDArray[np.bool_]

_PATCH = re.compile(r"(?P<camera>.+?)\[(?P<r0>\d*):(?P<r1>\d*)\s*,\s*(?P<c0>\d*):(?P<c1>\d*)\]$")
_KEYS = re.compile(r"(\d+)(?:-(\d+))?$")


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
        num_keys: number of keys of each group (the sum of its weights), shape (replan or 1, group) float64.
        num_valid: number of keys that can hold information, shape (replan or 1,).
    """

    names: tuple[str, ...]
    weights: NDArray[np.float32]
    num_keys: NDArray[np.float64]
    num_valid: NDArray[np.int64]


def check_names(grouping: Grouping, vocabulary: Vocabulary, layout: SiteLayout) -> None:
    """Raise `SelectorError` for the first selector that names something which exists nowhere in the selection."""
    known = {
        "camera": layout.cameras,
        "patch": layout.cameras,
        "span": vocabulary.spans,
    }
    for group, selectors in grouping.groups.items():
        for text in selectors:
            for atom in atoms_of(parse_selector(text)):
                if atom.kind == "frame":
                    layout.frame(atom.argument)
                problem = _unknown(atom, known, vocabulary)
                if problem:
                    raise SelectorError(f"Group '{group}', selector '{text}': {problem}")


def _unknown(atom: Atom, known: dict[str, tuple[str, ...]], vocabulary: Vocabulary) -> str | None:
    name = atom.argument
    if atom.kind == "role":
        find_role(name)
        return None
    if atom.kind in ("word", "words"):
        return _unknown_words(atom, vocabulary)
    if atom.kind == "object":
        if name.startswith("@") and name not in _SPECIAL_OBJECTS:
            return _no_such("object class", name, _SPECIAL_OBJECTS)
        if not vocabulary.objects:
            return f"{NO_COVERAGE}."
        return (
            None if name in (*vocabulary.objects, *_SPECIAL_OBJECTS) else _no_such("object", name, vocabulary.objects)
        )
    if atom.kind in known:
        if atom.kind == "patch":
            name = name.partition("[")[0]
        return (
            None if name in known[atom.kind] else _no_such(atom.kind.replace("patch", "camera"), name, known[atom.kind])
        )
    return None


def _unknown_words(atom: Atom, vocabulary: Vocabulary) -> str | None:
    if atom.kind == "words" and atom.argument.casefold() not in _WORD_CLASSES:
        return _no_such("word class", atom.argument, _WORD_CLASSES)
    if not vocabulary.words:
        return f"{NO_WORDS}."
    if atom.kind == "words":
        return None
    words = [atom.argument[start:stop] for start, stop in split_words(atom.argument)]
    if not words:
        return f"'{atom.argument}' has no letter or digit, so it is no word."
    for word in words:
        if word.casefold() not in vocabulary.words:
            near = did_you_mean(word, vocabulary.words)
            return f"no instruction has the word '{word}'.{near} Words: {listing(vocabulary.words, 40)}."
    if not any(has_phrase(sentence, atom.argument) for sentence in vocabulary.sentences):
        nearest = max(vocabulary.sentences, key=lambda sentence: sum(word.casefold() in sentence for word in words))
        return (
            f"no instruction has the words '{atom.argument}' one after the other. Nearest: '{' '.join(nearest)}'; a list of "
            "word: selectors takes single words."
        )
    return None


def _no_such(kind: str, name: str, existing: tuple[str, ...]) -> str:
    return f"there is no {kind} '{name}'.{did_you_mean(name, existing)} Existing: {listing(existing, 40)}."


_SPECIAL_OBJECTS = ("@interest", "@robot", "@background")
_WORD_CLASSES = ("content", "stop", "all")
#: Why there is nothing to name, and what to do about it.
NO_WORDS = (
    "the keys of this site spell no words; choose a site with text by --site (Cosmos: cross); a text that was captured without "
    "its tokenizer needs a capture with --t5-tokenizer"
)
NO_COVERAGE = (
    "no selected episode has object coverage at this site, which is recorded from the simulator's segmentation; choose a site "
    "with pictures by --site (Cosmos: self), or use a store as vla-capture wrote it, not a copy without objects"
)


def resolve(grouping: Grouping, tokens: EpisodeTokens) -> ResolvedGrouping:
    """Turn a grouping into weights on one episode's keys.

    A word or an object that this episode does not have gives a group without keys here (`check_names` has made sure that it
    exists somewhere). Raises `OverlappingGroups` unless the grouping allows overlap.
    """
    members = memberships(grouping, tokens)
    cells = cell_coverage(tokens) if any(member.shape[2] > 1 for member in members.values()) else None
    weights = [_weights(member, cells) for member in members.values()]
    replans = max(weight.shape[0] for weight in weights)
    shape = (replans, tokens.layout.num_keys)
    stacked = np.stack([np.broadcast_to(weight, shape) for weight in weights], axis=-1).astype(np.float32)
    return ResolvedGrouping(
        names=grouping.names,
        weights=stacked,
        num_keys=stacked.sum(axis=1, dtype=np.float64),
        num_valid=tokens.valid.sum(axis=1),
    )


def memberships(grouping: Grouping, tokens: EpisodeTokens) -> dict[str, Membership]:
    """Which (key, cell) pairs each group takes, shape (replan or 1, key, cell or 1); disjointness is checked here."""
    members: dict[str, Membership] = {}
    taken: Membership = np.zeros((1, tokens.layout.num_keys, 1), dtype=bool)
    for group, selectors in grouping.groups.items():
        if selectors[0].strip() == REST:
            members[group] = taken  # replaced below, when everything else is known
            continue
        member: Membership = np.zeros((1, tokens.layout.num_keys, 1), dtype=bool)
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
    """How many keys two groups have in common, shape (replan or 1, group, group); the diagonal is each group's own number.

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
                f"Groups '{other}' and '{group}' share {int(shared.sum())} keys (the first is {describe_key(key, tokens)}); "
                "take them out of one group with ' - ', or set overlap = true."
            )


def describe_key(key: int, tokens: EpisodeTokens) -> str:
    """Say in words what a key is, for messages: its number, its span, and its piece of text if it has one."""
    span = next(span for span in tokens.layout.spans if span.start <= key < span.stop)
    text = next((piece.text for prompt in tokens.prompts for piece in prompt.pieces if piece.key == key), None)
    return f"key {key} of span '{span.name}'" + (f", {text!r}" if text is not None else "")


def cell_coverage(tokens: EpisodeTokens) -> NDArray[np.float32]:
    """Area of each key's cells, shape (replan, key, 1 + object). Cell 0 is what no object accounts for; a key's cells sum to 1."""
    replans, keys, things = tokens.num_replans, tokens.layout.num_keys, len(tokens.objects)
    area = np.zeros((replans, keys, 1 + things), dtype=np.float32)
    for camera, coverage in (tokens.coverage or {}).items():
        span = tokens.layout.camera_span(camera)
        area[:, span.start : span.stop, 1:] = coverage
    area[:, :, 0] = np.clip(1.0 - area[:, :, 1:].sum(axis=2), 0.0, 1.0)
    return area


def _weights(member: Membership, cells: NDArray[np.float32] | None) -> NDArray[np.float32]:
    if member.shape[2] == 1 or cells is None:
        return member[:, :, 0].astype(np.float32)
    # A sum of area fractions may exceed 1 by rounding; a weight may not.
    return np.minimum((cells * member).sum(axis=2, dtype=np.float32), np.float32(1.0))


def _evaluate(selector: Selector, tokens: EpisodeTokens) -> Membership:
    if isinstance(selector, Everything):
        return np.ones((1, tokens.layout.num_keys, 1), dtype=bool)
    if isinstance(selector, Atom):
        return _ATOMS[selector.kind](selector.argument, tokens)
    left, right = _evaluate(selector.left, tokens), _evaluate(selector.right, tokens)
    if selector.operator == "&":
        return left & right
    return left | right if selector.operator == "|" else left & ~right


def _key_range(tokens: EpisodeTokens, start: int, stop: int) -> Membership:
    member = np.zeros((1, tokens.layout.num_keys, 1), dtype=bool)
    member[0, start:stop] = True
    return member


def _camera(argument: str, tokens: EpisodeTokens) -> Membership:
    span = tokens.layout.camera_span(argument)
    return _key_range(tokens, span.start, span.stop)


def _role(argument: str, tokens: EpisodeTokens) -> Membership:
    return (tokens.static_roles == int(find_role(argument)))[:, :, None]


def _span(argument: str, tokens: EpisodeTokens) -> Membership:
    span = tokens.layout.span(argument)
    return _key_range(tokens, span.start, span.stop)


def _frame(argument: str, tokens: EpisodeTokens) -> Membership:
    span = tokens.layout.frame(argument)
    return _key_range(tokens, span.start, span.stop)


def _word(argument: str, tokens: EpisodeTokens) -> Membership:
    return _keys_of_words(tokens, [find_phrase(words, argument) for words in tokens.words])


def _words(argument: str, tokens: EpisodeTokens) -> Membership:
    wanted = argument.casefold()
    if wanted not in _WORD_CLASSES:
        raise SelectorError("T" + _no_such("word class", argument, _WORD_CLASSES)[1:])
    chosen = [[word for word in words if wanted in ("all", word_class(word.text))] for words in tokens.words]
    return _keys_of_words(tokens, chosen)


def _keys_of_words(tokens: EpisodeTokens, chosen: Sequence[Sequence[Word]]) -> Membership:
    """The keys of the words that were chosen from each of the episode's prompts."""
    by_prompt = np.zeros((max(1, len(tokens.prompts)), tokens.layout.num_keys), dtype=bool)
    for row, words in zip(by_prompt, chosen, strict=False):
        for word in words:
            row[list(word.keys)] = True
    if len(by_prompt) == 1 or tokens.prompt_index is None:
        return by_prompt[:1, :, None]
    return by_prompt[tokens.prompt_index, :, None]


def _object(argument: str, tokens: EpisodeTokens) -> Membership:
    chosen = np.zeros(1 + len(tokens.objects), dtype=bool)
    for i, thing in enumerate(tokens.objects, start=1):
        chosen[i] = {
            "@interest": thing.of_interest,
            "@robot": thing.kind == "robot",
            "@background": thing.kind == "background",
        }.get(argument, thing.name == argument)
    covered = np.zeros(tokens.layout.num_keys, dtype=bool)
    for camera in tokens.coverage or {}:
        span = tokens.layout.camera_span(camera)
        covered[span.start : span.stop] = True
    return (covered[:, None] & chosen)[None]


def _patch(argument: str, tokens: EpisodeTokens) -> Membership:
    match = _PATCH.match(argument)
    if match is None:
        raise SelectorError(f"Cannot read selector 'patch:{argument}'; expected patch:CAMERA[r0:r1,c0:c1].")
    span = tokens.layout.camera_span(match["camera"])
    if span.grid is None:
        raise SelectorError(f"Camera '{match['camera']}' has no patch grid.")
    rows, columns = span.grid.rows, span.grid.columns
    r0, r1 = int(match["r0"] or 0), int(match["r1"] or rows)
    c0, c1 = int(match["c0"] or 0), int(match["c1"] or columns)
    if not (0 <= r0 < r1 <= rows and 0 <= c0 < c1 <= columns):
        raise SelectorError(
            f"Selector 'patch:{argument}' leaves the grid of camera '{match['camera']}', which has {rows} rows and "
            f"{columns} columns of patches; expected 0 <= r0 < r1 <= {rows} and 0 <= c0 < c1 <= {columns}."
        )
    grid = np.zeros((rows, columns), dtype=bool)
    grid[r0:r1, c0:c1] = True
    member = np.zeros((1, tokens.layout.num_keys, 1), dtype=bool)
    member[0, span.start : span.stop, 0] = grid.ravel()
    return member


def _keys(argument: str, tokens: EpisodeTokens) -> Membership:
    match = _KEYS.match(argument)
    if match is None:
        raise SelectorError(f"Cannot read selector 'keys:{argument}'; expected keys:a or keys:a-b.")
    first, last = int(match[1]), int(match[2] or match[1])
    if not first <= last < tokens.layout.num_keys:
        raise SelectorError(
            f"Selector 'keys:{argument}' leaves the site's keys; expected a <= b <= {tokens.layout.num_keys - 1}."
        )
    return _key_range(tokens, first, last + 1)


_ATOMS = {
    "camera": _camera,
    "role": _role,
    "span": _span,
    "frame": _frame,
    "word": _word,
    "words": _words,
    "object": _object,
    "patch": _patch,
    "keys": _keys,
}
