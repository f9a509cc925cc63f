"""Errors that a user can cause, and the sentence each of them ends with: names, numbers, control characters in it.

Every class is also the builtin that fits, so library callers may catch either. The command lines print the message
of a `UserError` as one sentence and exit with code 2; anything else is a defect and keeps its traceback.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from typing import TypeVar

T = TypeVar("T")
#: Characters of an error's sentence; what is longer repeats what was given.
SENTENCE_CHARACTERS = 4000
#: Characters of one given value or name in a sentence.
SHOWN_CHARACTERS = 300


class UserError(Exception):
    """A mistake in what was given: arguments, files, selections. Never a defect of the program.

    Its text is one line: names from files are part of it, and Python prints it in tracebacks as it is. `has_lines` is
    for errors that end with a table.
    """

    has_lines = False

    def __str__(self) -> str:
        # KeyError and FileNotFoundError format their arguments in their own ways; this class always gives the sentence
        # itself.
        if not self.args:
            return type(self).__name__
        return visible(shortened(str(self.args[0]), SENTENCE_CHARACTERS), keep="\n" if self.has_lines else "")


class BadArgument(UserError, ValueError):
    """An argument has a value outside what is accepted."""


class UnknownName(UserError, LookupError):
    """A name (suite, group, selector, camera, word, object ...) that does not exist here."""


class MissingDependency(UserError, ImportError):
    """An optional part of the installation is needed and absent."""


class Note(UserWarning):
    """Something that a user should know and that stops nothing. Command lines print it as a line on stderr."""


def shortened(text: str, most: int = SHOWN_CHARACTERS) -> str:
    """A text of at most about `most` characters: a longer one without its middle, and how much that is."""
    if len(text) <= most:
        return text
    first, last = most * 2 // 3, most // 3
    return f"{text[:first]} [... {len(text) - first - last:,} characters ...] {text[-last:]}"


def listing(names: Iterable[object], limit: int = 12) -> str:
    """Join names for a message: at most `limit` of them, then how many more there are."""
    items = [shortened(str(name)) for name in names]
    if not items:
        return "none"
    shown = ", ".join(items[:limit])
    return shown if len(items) <= limit else f"{shown} and {len(items) - limit} more"


def runs_of(numbers: Iterable[int]) -> list[list[int]]:
    """Return ascending numbers in runs of those that follow each other, for a message."""
    runs: list[list[int]] = []
    for number in numbers:
        if runs and number == runs[-1][-1] + 1:
            runs[-1].append(number)
        else:
            runs.append([number])
    return runs


def did_you_mean(given: str, existing: Iterable[str]) -> str:
    """Return " Did you mean 'x'?" for the nearest existing name, or an empty string when nothing is near."""
    by_folded = {name.casefold(): name for name in existing}
    folded = given.casefold()
    # The most frequent mistake is half a name ('base' for 'base_0_rgb'), which is too short for the similarity measure.
    near = [name for name in by_folded if len(folded) > 2 and name.startswith(folded)]
    near = near or difflib.get_close_matches(folded, list(by_folded), n=1, cutoff=0.6)
    near = near or [name for name in by_folded if len(folded) > 2 and folded in name]
    return f" Did you mean '{by_folded[near[0]]}'?" if near else ""


def unknown_name(kind: str, given: str, existing: Iterable[str]) -> UnknownName:
    """Build the error for a name that does not exist: what was given, the nearest name, and what exists."""
    names = list(existing)
    return UnknownName(f"Unknown {kind} '{shortened(given)}'.{did_you_mean(given, names)} Existing: {listing(names)}.")


def look_up(kind: str, name: str, existing: Mapping[str, T]) -> T:
    """Return what a name stands for; `UnknownName` with the names that exist."""
    if name not in existing:
        raise unknown_name(kind, name, existing)
    return existing[name]


def plural(count: int, noun: str) -> str:
    """`1 task`, `2 tasks`, `2 quantities`."""
    if count == 1:
        return f"1 {noun}"
    return f"{count} {noun[:-1]}ies" if noun.endswith("ty") else f"{count} {noun}s"


def visible(text: str, keep: str = "") -> str:
    r"""Text with its unprintable characters as escapes, for instance \x1b, \n or \u202e.

    Unprintable are control and format characters, line and paragraph separators, spaces other than the plain one, and
    code points without a character (`str.isprintable`). Characters in `keep` stay as they are.
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or c in keep else c.encode("unicode_escape").decode("ascii") for c in text)
