"""The grammar of selectors: a pure parser from text to a small tree. The kinds themselves are in `selectors`.

    selector   = term { ("|" | "-") term }          left to right
    term       = factor { "&" factor }              binds tighter than | and -
    factor     = "(" selector ")" | "*" | kind ":" argument
    argument   = "quoted text" | 'quoted text' | a run without spaces, &, |, ( and ) | name[r0:r1,c0:c1]

`-` is an operator only with spaces around it, so that names and ranges (`keys:3-9`) may contain it. `*` is every key.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

from vla_attention.schemas.errors import did_you_mean, listing, shortened
from vla_attention.schemas.groupings.selectors import SELECTOR_KINDS, SelectorError


@dataclass(frozen=True)
class Atom:
    """One `kind:argument`."""

    kind: str
    argument: str


@dataclass(frozen=True)
class Everything:
    """`*`: every key."""


@dataclass(frozen=True)
class Operation:
    """Two selectors joined by `&`, `|` or `-`."""

    operator: str
    left: Selector
    right: Selector


Selector = Atom | Everything | Operation

#: Parentheses in one another: each is a call of the parser.
_MOST_PARENTHESES = 100
Value = TypeVar("Value")

_TOKEN = re.compile(
    r"""\s*(?:
      (?P<open>\() | (?P<close>\)) | (?P<and>&) | (?P<or>\|) | (?P<minus>-(?=\s|\Z)) | (?P<star>\*)
      | (?P<kind>[A-Za-z_]+):(?P<argument>"[^"]*" | '[^']*' | [^\s&|()\[\]"']+[^\s&|()\[\]"]*(?:\[[^\]]*\])? | )
    )""",
    re.VERBOSE,
)


@functools.lru_cache(maxsize=1024)  # a grouping is looked at when it is read, and in every episode
def parse_selector(text: str) -> Selector:
    """Parse one selector in linear time; raises `SelectorError` that quotes it and says what was expected where."""
    return _Parser(text).parse()


def folded(
    selector: Selector,
    leaf: Callable[[Atom | Everything], Value],
    join: Callable[[str, Value, Value], Value],
) -> Value:
    """The value of a selector from those of its parts, left to right.

    A union of a hundred thousand words is a tree as deep, so that no function of it may call itself.

    Args:
        selector: the tree.
        leaf: the value of a part.
        join: the value of an operator and the values on its left and right.
    """
    pending: list[Selector | str] = [selector]
    values: list[Value] = []
    while pending:
        part = pending.pop()
        if isinstance(part, Operation):
            pending += [part.operator, part.right, part.left]
        elif isinstance(part, str):
            right = values.pop()
            values.append(join(part, values.pop(), right))
        else:
            values.append(leaf(part))
    return values.pop()


def atoms_of(selector: Selector) -> tuple[Atom, ...]:
    """All `kind:argument` parts of a selector, left to right."""
    atoms: list[Atom] = []

    def note(part: Atom | Everything) -> None:
        if isinstance(part, Atom):
            atoms.append(part)

    folded(selector, note, lambda operator, left, right: None)
    return tuple(atoms)


_SPACE = re.compile(r"\s*")


def _unquoted(argument: str) -> str:
    return argument[1:-1] if argument[:1] in ('"', "'") else argument


class _Parser:
    def __init__(self, text: str) -> None:
        self.text = text
        self.tokens = self._tokenise()
        self.next = 0
        self.depth = 0

    def _fail(self, position: int, problem: str) -> SelectorError:
        return SelectorError(f"Cannot read selector '{shortened(self.text)}' at character {position + 1}: {problem}.")

    def _tokenise(self) -> list[tuple[str, str, int]]:
        tokens: list[tuple[str, str, int]] = []
        position, end = 0, len(self.text.rstrip())
        while position < end:
            match = _TOKEN.match(self.text, position)
            space = _SPACE.match(self.text, position)
            start = position if space is None else space.end()
            if match is None:
                raise self._fail(start, f"expected KIND:NAME, where KIND is one of {listing(SELECTOR_KINDS)}")
            kind = match.lastgroup or ""
            if kind == "argument":
                self._check_atom(match, start)
                tokens.append(("atom", match["kind"] + ":" + _unquoted(match["argument"]), start))
            else:
                tokens.append((kind, match[kind], start))
            position = match.end()
        return tokens

    def _check_atom(self, match: re.Match[str], start: int) -> None:
        if match["kind"] not in SELECTOR_KINDS:
            raise self._fail(
                start,
                f"unknown kind '{shortened(match['kind'])}:';{did_you_mean(match['kind'], SELECTOR_KINDS).lower()} "
                f"existing kinds: {listing(SELECTOR_KINDS)}",
            )
        if not _unquoted(match["argument"]).strip():
            raise self._fail(start, f"expected a name after '{match['kind']}:'")

    def _peek(self) -> tuple[str, str, int]:
        return self.tokens[self.next] if self.next < len(self.tokens) else ("end", "", len(self.text))

    def parse(self) -> Selector:
        tree = self._selector()
        kind, word, position = self._peek()
        if kind != "end":
            raise self._fail(position, f"expected '&', '|' or ' - ' before '{word}'")
        return tree

    def _selector(self) -> Selector:
        tree = self._term()
        while self._peek()[0] in ("or", "minus"):
            operator = self._peek()[1]
            self.next += 1
            tree = Operation(operator, tree, self._term())
        return tree

    def _term(self) -> Selector:
        tree = self._factor()
        while self._peek()[0] == "and":
            self.next += 1
            tree = Operation("&", tree, self._factor())
        return tree

    def _factor(self) -> Selector:
        kind, word, position = self._peek()
        self.next += 1
        if kind == "open":
            self.depth += 1
            if self.depth > _MOST_PARENTHESES:
                raise self._fail(position, f"it has more than {_MOST_PARENTHESES} parentheses in one another")
            tree = self._selector()
            self.depth -= 1
            if self._peek()[0] != "close":
                raise self._fail(self._peek()[2], "expected ')'")
            self.next += 1
            return tree
        if kind == "star":
            return Everything()
        if kind == "atom":
            name, _, argument = word.partition(":")
            return Atom(name, argument)
        raise self._fail(position, "expected a selector such as camera:NAME, '(' or '*'")
