"""The kinds of selectors, one entry of `SELECTOR_KINDS` each: its description, its keys, and what makes a name wrong.

To add a kind, write its two functions and its entry in the table at the end. The parser, the checks, the errors and
`--list` use the table. The grammar that joins selectors (`&`, `|`, `-`, parentheses) is in `selector_parser`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vla_attention.schemas.errors import UserError, did_you_mean, listing
from vla_attention.schemas.groupings.vocabulary import NO_COVERAGE, NO_WORDS, EpisodeTokens, Vocabulary
from vla_attention.schemas.groupings.words import Word, find_phrase, has_phrase, split_words, word_class
from vla_attention.schemas.layout import Role, find_role

#: The (key, cell) pairs that a selector takes, axes (replan or 1, key, cell or 1). `resolve` says what a cell is.
Membership = NDArray[np.bool_]

_NUMBER = r"[0-9]{0,9}(?:\.[0-9]{1,20})?"
_PATCH = re.compile(
    rf"(?P<camera>[^\[]+)\[(?P<r0>{_NUMBER}):(?P<r1>{_NUMBER})\s*,\s*(?P<c0>{_NUMBER}):(?P<c1>{_NUMBER})\]"
)
_KEYS = re.compile(r"([0-9]{1,9})(?:-([0-9]{1,9}))?")
_OBJECT_CLASSES = ("@interest", "@robot", "@background")
_WORD_CLASSES = ("content", "stop", "all")


class SelectorError(UserError, ValueError):
    """A selector that cannot be read, or that names something that does not exist."""


@dataclass(frozen=True)
class SelectorKind:
    """One kind of selector, `kind:argument`.

    Attributes:
        takes: what it selects, in words, for errors and `--list`.
        keys: a function of the argument and an episode's tokens; returns the keys that it takes.
        problem: a function of the argument and the names in all selected episodes; returns what is wrong with the
            argument, as the end of a sentence, or None.
        has_keys: a function of those names: whether the site has keys of this kind at all.
    """

    takes: str
    keys: Callable[[str, EpisodeTokens], Membership]
    problem: Callable[[str, Vocabulary], str | None]
    has_keys: Callable[[Vocabulary], bool] = lambda names: True


def quoted(name: str) -> str:
    """A name as selectors have it; names that need quotes have one kind of them at most (`check_name`)."""
    return f"'{name}'" if '"' in name else f'"{name}"'


def num_cells(tokens: EpisodeTokens) -> int:
    """Cells of a key: what no object covers, one for each object, and what of a patch shows no picture."""
    return 1 + len(tokens.objects) + (tokens.border is not None)


def no_keys(tokens: EpisodeTokens) -> Membership:
    """No key at all, axes (1, key, 1)."""
    return np.zeros((1, tokens.layout.num_keys, 1), dtype=bool)


def _key_range(tokens: EpisodeTokens, start: int, stop: int) -> Membership:
    member = no_keys(tokens)
    member[0, start:stop] = True
    return member


def _missing(kind: str, name: str, existing: Sequence[str]) -> str | None:
    """The problem of a name that is not among the existing ones."""
    if name in existing:
        return None
    return f"there is no {kind} '{name}'.{did_you_mean(name, existing)} Existing: {listing(existing, 40)}."


# camera, span, frame: spans of the layout.


def _camera_keys(argument: str, tokens: EpisodeTokens) -> Membership:
    member = no_keys(tokens)
    for span in tokens.layout.camera_spans(argument):
        member[0, span.start : span.stop] = True
    return member


def _camera_problem(argument: str, vocabulary: Vocabulary) -> str | None:
    return _missing("camera", argument, vocabulary.layout.cameras)


def _span_keys(argument: str, tokens: EpisodeTokens) -> Membership:
    span = tokens.layout.span(argument)
    return _key_range(tokens, span.start, span.stop)


def _span_problem(argument: str, vocabulary: Vocabulary) -> str | None:
    return _missing("span", argument, [span.name for span in vocabulary.layout.spans])


def _frame_keys(argument: str, tokens: EpisodeTokens) -> Membership:
    span = tokens.layout.frame(argument)
    return _key_range(tokens, span.start, span.stop)


def _frame_problem(argument: str, vocabulary: Vocabulary) -> str | None:
    vocabulary.layout.frame(argument)  # raises the error that lists the frames
    return None


# role: what a key is at each replan.


def _role_keys(argument: str, tokens: EpisodeTokens) -> Membership:
    role = find_role(argument)
    member: Membership = (tokens.static_roles == int(role))[:, :, None]
    if tokens.border is None or not tokens.has_cut_patches or role not in (Role.IMAGE, Role.BORDER):
        return member
    # Of a patch that shows a picture in part, the last cell is the rest.
    is_rest = np.zeros(num_cells(tokens), dtype=bool)
    is_rest[-1] = True
    if role == Role.IMAGE:
        shown: Membership = member & ~is_rest
        return shown
    cut = (tokens.static_roles == int(Role.IMAGE)) & (tokens.border > 0)
    hidden: Membership = member | (cut[:, :, None] & is_rest)
    return hidden


def _role_problem(argument: str, vocabulary: Vocabulary) -> str | None:
    find_role(argument)  # raises the error that lists the roles
    return None


# word, words: pieces of the instruction.


def _word_keys(argument: str, tokens: EpisodeTokens) -> Membership:
    # Prompts that differ in their state share their words (`words_of`): the phrase is looked for once.
    by_identity = {id(words): words for words in tokens.words}
    places = {of: find_phrase(words, argument) for of, words in by_identity.items()}
    return _keys_of_words(tokens, [places[id(words)] for words in tokens.words])


def _word_problem(argument: str, vocabulary: Vocabulary) -> str | None:
    if not vocabulary.words:
        return f"{NO_WORDS}."
    words = [argument[start:stop] for start, stop in split_words(argument)]
    if not words:
        return f"'{argument}' has no letter or digit, so it is no word."
    for word in words:
        if word.casefold() not in vocabulary.words:
            near = did_you_mean(word, vocabulary.words)
            return f"no instruction has the word '{word}'.{near} Words: {listing(vocabulary.words, 40)}."
    if not any(has_phrase(sentence, argument) for sentence in vocabulary.sentences):
        nearest = max(vocabulary.sentences, key=lambda sentence: sum(word.casefold() in sentence for word in words))
        return (
            f"no instruction has the words '{argument}' one after the other. Nearest: '{' '.join(nearest)}'; a list of "
            "word: selectors takes single words."
        )
    return None


def _words_keys(argument: str, tokens: EpisodeTokens) -> Membership:
    wanted = argument.casefold()
    problem = _missing("word class", argument, _WORD_CLASSES) if wanted not in _WORD_CLASSES else None
    if problem:
        raise SelectorError(problem[0].upper() + problem[1:])
    chosen = [[word for word in words if wanted in ("all", word_class(word.text))] for words in tokens.words]
    return _keys_of_words(tokens, chosen)


def _words_problem(argument: str, vocabulary: Vocabulary) -> str | None:
    if argument.casefold() not in _WORD_CLASSES:
        return _missing("word class", argument, _WORD_CLASSES)
    return None if vocabulary.words else f"{NO_WORDS}."


def _keys_of_words(tokens: EpisodeTokens, chosen: Sequence[Sequence[Word]]) -> Membership:
    """The keys of the words that were chosen from each of the episode's prompts."""
    by_prompt = np.zeros((max(1, len(tokens.prompts)), tokens.layout.num_keys), dtype=bool)
    for row, words in zip(by_prompt, chosen, strict=False):
        for word in words:
            row[list(word.keys)] = True
    if len(by_prompt) == 1 or tokens.prompt_index is None:
        return by_prompt[:1, :, None]
    return by_prompt[tokens.prompt_index, :, None]


# object, patch: parts of pictures.


def _object_keys(argument: str, tokens: EpisodeTokens) -> Membership:
    chosen = np.zeros(num_cells(tokens), dtype=bool)
    for i, thing in enumerate(tokens.objects, start=1):
        chosen[i] = {
            "@interest": thing.of_interest,
            "@robot": thing.kind == "robot",
            "@background": thing.kind == "background",
        }.get(argument, thing.name == argument)
    covered = np.zeros(tokens.layout.num_keys, dtype=bool)
    for camera in tokens.coverage or {}:
        covered[tokens.layout.patch_keys(camera)] = True
    if tokens.border is not None:
        covered &= tokens.border < 1
    member: Membership = (covered[:, None] & chosen)[None]
    return member


def _object_problem(argument: str, vocabulary: Vocabulary) -> str | None:
    if argument.startswith("@") and argument not in _OBJECT_CLASSES:
        return _missing("object class", argument, _OBJECT_CLASSES)
    if not vocabulary.objects:
        return f"{NO_COVERAGE}."
    return None if argument in _OBJECT_CLASSES else _missing("object", argument, vocabulary.objects)


def _patch_keys(argument: str, tokens: EpisodeTokens) -> Membership:
    match = _PATCH.fullmatch(argument)
    if match is None:
        raise SelectorError(
            f"Cannot read selector 'patch:{argument}'; expected patch:CAMERA[r0:r1,c0:c1] with rows and columns of "
            "patches, or with fractions of the picture such as 0.5."
        )
    camera, ends = match["camera"], [match[name] for name in ("r0", "r1", "c0", "c1")]
    grids = tokens.layout.grids(camera)
    if not grids:
        raise SelectorError(f"Camera '{camera}' has no patch grid.")
    given = [end for end in ends if end]
    fractions = any("." in end for end in given) or not given
    if len(grids) > 1 and not fractions:
        raise SelectorError(
            f"Selector 'patch:{argument}' counts patches, and camera '{camera}' has {len(grids)} grids "
            f"({listing(grid.describe() for grid in grids)}); expected fractions of the whole picture, which take "
            f"patches of all of them, such as patch:{camera}[0.0:0.5,0.25:1.0]; & span:NAME takes one grid's."
        )
    rows, columns = (1, 1) if fractions else (grids[0].rows, grids[0].columns)
    r0, r1, c0, c1 = (float(end) if end else last for end, last in zip(ends, (0, rows, 0, columns), strict=True))
    if not (0 <= r0 < r1 <= rows and 0 <= c0 < c1 <= columns):
        raise SelectorError(
            f"Selector 'patch:{argument}' leaves the picture of camera '{camera}', whose sides are 1 in fractions; "
            "expected 0 <= r0 < r1 <= 1 and 0 <= c0 < c1 <= 1."
            if fractions
            else f"Selector 'patch:{argument}' leaves the grid of camera '{camera}', which has {rows} rows and "
            f"{columns} columns of patches; expected 0 <= r0 < r1 <= {rows} and 0 <= c0 < c1 <= {columns}."
        )
    chosen = []
    for grid in grids:
        centres = grid.centres() if fractions else (np.arange(rows), np.arange(columns))
        inside = [(first <= at) & (at < stop) for at, first, stop in zip(centres, (r0, c0), (r1, c1), strict=True)]
        chosen.append(np.outer(*inside).ravel())
    member = no_keys(tokens)
    member[0, tokens.layout.patch_keys(camera), 0] = np.concatenate(chosen)
    return member


def _patch_problem(argument: str, vocabulary: Vocabulary) -> str | None:
    return _camera_problem(argument.partition("[")[0], vocabulary)


# keys: numbers.


def _number_keys(argument: str, tokens: EpisodeTokens) -> Membership:
    match = _KEYS.fullmatch(argument)
    if match is None:
        raise SelectorError(f"Cannot read selector 'keys:{argument}'; expected keys:a or keys:a-b.")
    first, last = int(match[1]), int(match[2] or match[1])
    if not first <= last < tokens.layout.num_keys:
        raise SelectorError(
            f"Selector 'keys:{argument}' leaves the site's keys; expected a <= b <= {tokens.layout.num_keys - 1}."
        )
    return _key_range(tokens, first, last + 1)


SELECTOR_KINDS: dict[str, SelectorKind] = {
    "camera": SelectorKind(
        "every key of one camera", _camera_keys, _camera_problem, lambda names: bool(names.layout.cameras)
    ),
    "role": SelectorKind("every key with one role", _role_keys, _role_problem),
    "span": SelectorKind("every key of one span", _span_keys, _span_problem),
    "frame": SelectorKind(
        "every key of one latent frame",
        _frame_keys,
        _frame_problem,
        lambda names: any(span.kind == "latent" for span in names.layout.spans),
    ),
    "word": SelectorKind(
        "every piece of a word of the instruction; a phrase in quotes",
        _word_keys,
        _word_problem,
        lambda names: bool(names.words),
    ),
    "words": SelectorKind(
        "the words of the instruction by class: content, stop (a shipped list of function words) or all",
        _words_keys,
        _words_problem,
        lambda names: bool(names.words),
    ),
    "object": SelectorKind(
        "the patches that an object covers, by covered area; @interest, @robot or @background",
        _object_keys,
        _object_problem,
        lambda names: bool(names.objects),
    ),
    "patch": SelectorKind(
        "a region of a camera's picture: camera[r0:r1,c0:c1], rows and columns of its patch grid from the top left, "
        "r1 and c1 excluded, or fractions of the picture, such as 0.5, by the patches' centres",
        _patch_keys,
        _patch_problem,
        lambda names: bool(names.layout.cameras),
    ),
    # A range that leaves the site is found when the keys are taken.
    "keys": SelectorKind("keys by number, a-b with both ends", _number_keys, lambda argument, names: None),
}
