"""Words of an instruction and the keys (token pieces) that spell them."""

from __future__ import annotations

import functools
import re
from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib.resources import files
from typing import Literal
from unicodedata import category

from vla_attention.schemas.layout import Piece, Prompt

WordClass = Literal["content", "stop"]


@functools.cache
def _word() -> re.Pattern[str]:
    """A word: letters with the vowel signs and accents that stand on them, which Python's own \\w leaves out."""
    marks = "".join(letter for letter in map(chr, range(0x300, 0x10000)) if category(letter) in ("Mn", "Mc"))
    part = f"\\w[\\w{marks}]*"
    return re.compile(f"{part}(?:['\u2019-]{part})*")


@dataclass(frozen=True)
class Word:
    """One word of the instruction: its text, its characters in the prompt, and the keys of all its pieces."""

    text: str
    start: int
    stop: int
    keys: tuple[int, ...]


def split_words(text: str) -> list[tuple[int, int]]:
    """Character ranges [start, stop) of the words of a text; underscores separate words as they do for the policies."""
    return [match.span() for match in _word().finditer(text.replace("_", " "))]


def folded_words(text: str) -> tuple[str, ...]:
    """The words of a text in lower case: sentences with the same ones say the same."""
    return tuple(text[start:stop].casefold() for start, stop in split_words(text))


def words_of(prompt: Prompt) -> tuple[Word, ...]:
    """The words of the prompt's instruction, in order. A piece that touches a word's characters belongs to it."""
    first, last = prompt.instruction
    inside = tuple([piece for piece in prompt.pieces if piece.start < last and piece.stop > first])
    return _words_in(prompt.text[first:last], first, inside)


@functools.lru_cache(maxsize=4096)
def _words_in(text: str, first: int, pieces: tuple[Piece, ...]) -> tuple[Word, ...]:
    """The words of an instruction that begins at a character of its prompt. Prompts of a task differ in their state."""
    places = [(first + start, first + stop) for start, stop in split_words(text)]
    keys = _keys_between(pieces, places)
    return tuple(
        Word(text[start - first : stop - first], start, stop, tuple(word_keys))
        for (start, stop), word_keys in zip(places, keys, strict=True)
    )


def find_phrase(words: Sequence[Word], phrase: str) -> tuple[Word, ...]:
    """Every word that takes part in an occurrence of the phrase (case-insensitive, whole words, in sequence)."""
    wanted = folded_words(phrase)
    given = [word.text.casefold() for word in words]
    taken = {i for first in _occurrences(given, wanted) for i in range(first, first + len(wanted))}
    return tuple(words[i] for i in sorted(taken))


@functools.cache
def stop_words() -> frozenset[str]:
    """The shipped stop list (`word_lists/english_stop_words.txt`, which says what is in it and why), in lower case."""
    text = (
        files("vla_attention.schemas.groupings")
        .joinpath("word_lists", "english_stop_words.txt")
        .read_text(encoding="utf-8")
    )
    return frozenset(word for line in text.splitlines() for word in line.partition("#")[0].split())


def word_class(word: str) -> WordClass:
    """`stop` for a word of the stop list, else `content`; independent of the sentence."""
    return "stop" if word.casefold().replace("\u2019", "'") in stop_words() else "content"


def has_phrase(sentence: Sequence[str], phrase: str) -> bool:
    """Whether the words of a phrase follow each other in a sentence, both case-folded."""
    wanted = folded_words(phrase)
    return any(True for _ in _occurrences(sentence, wanted))


def _occurrences(given: Sequence[str], wanted: Sequence[str]) -> Iterator[int]:
    """Where the wanted words begin, one after the other, among the given ones."""
    if wanted:
        for first in range(len(given) - len(wanted) + 1):
            if list(given[first : first + len(wanted)]) == list(wanted):
                yield first


def _keys_between(pieces: Sequence[Piece], places: Sequence[tuple[int, int]]) -> list[list[int]]:
    """The keys of the pieces that touch each of the places, which are in order and do not overlap."""
    starts, stops = [start for start, _ in places], [stop for _, stop in places]
    keys: list[list[int]] = [[] for _ in places]
    for piece in pieces:
        for i in range(bisect_right(stops, piece.start), bisect_left(starts, piece.stop)):
            keys[i].append(piece.key)
    return keys
