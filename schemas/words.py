"""Words of an instruction and the keys (token pieces) that spell them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from schemas.layout import Piece, Prompt

_WORD = re.compile(r"\w+(?:['\u2019-]\w+)*")


@dataclass(frozen=True)
class Word:
    """One word of the instruction: its text, its characters in the prompt, and the keys of all its pieces."""

    text: str
    start: int
    stop: int
    keys: tuple[int, ...]


def split_words(text: str) -> list[tuple[int, int]]:
    """Character ranges [start, stop) of the words of a text; underscores separate words as they do for the policies."""
    return [match.span() for match in _WORD.finditer(text.replace("_", " "))]


def words_of(prompt: Prompt) -> tuple[Word, ...]:
    """The words of the prompt's instruction, in order. A piece that touches a word's characters belongs to it."""
    first, last = prompt.instruction
    words = []
    for start, stop in split_words(prompt.text[first:last]):
        begin, end = first + start, first + stop
        words.append(Word(prompt.text[begin:end], begin, end, _keys_between(prompt.pieces, begin, end)))
    return tuple(words)


def find_phrase(words: Sequence[Word], phrase: str) -> tuple[Word, ...]:
    """Every word that takes part in an occurrence of the phrase (case-insensitive, whole words, in sequence)."""
    wanted = [phrase[start:stop].casefold() for start, stop in split_words(phrase)]
    if not wanted:
        return ()
    given = [word.text.casefold() for word in words]
    found: dict[int, Word] = {}
    for first in range(len(given) - len(wanted) + 1):
        if given[first : first + len(wanted)] == wanted:
            found.update({i: words[i] for i in range(first, first + len(wanted))})
    return tuple(found.values())


def _keys_between(pieces: Sequence[Piece], begin: int, end: int) -> tuple[int, ...]:
    return tuple(piece.key for piece in pieces if piece.start < end and piece.stop > begin)
