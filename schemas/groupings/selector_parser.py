"""The grammar of selectors: a pure parser from text to a small tree. The kinds themselves are in `selectors`.

    selector   = term { ("|" | "-") term }          left to right
    term       = factor { "&" factor }              binds tighter than | and -
    factor     = "(" selector ")" | "*" | kind ":" argument
    argument   = "quoted text" | 'quoted text' | a run without spaces, &, |, ( and ) | name[r0:r1,c0:c1]

`-` is an operator only with spaces around it, so that names and ranges (`keys:3-9`) may contain it. `*` is every key.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from vla_attention.schemas.errors import did_you_mean, listing
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

_TOKEN = re.compile(
    r"""\s*(?:
      (?P<open>\() | (?P<close>\)) | (?P<and>&) | (?P<or>\|) | (?P<minus>-(?=\s|$)) | (?P<star>\*)
      | (?P<kind>[A-Za-z_]+):(?P<argument>"[^"]*" | '[^']*' | [^\s&|()\[\]"']+[^\s&|()\[\]"]*(?:\[[^\]]*\])? | )
    )""",
    re.VERBOSE,
)


def parse_selector(text: str) -> Selector:
    """Parse one selector; raises `SelectorError` that quotes it and says what was expected where."""
    return _Parser(text).parse()


def atoms_of(selector: Selector) -> tuple[Atom, ...]:
    """All `kind:argument` parts of a selector, left to right."""
    if isinstance(selector, Operation):
        return atoms_of(selector.left) + atoms_of(selector.right)
    return (selector,) if isinstance(selector, Atom) else ()


def _unquoted(argument: str) -> str:
    return argument[1:-1] if argument[:1] in ('"', "'") else argument


class _Parser:
    def __init__(self, text: str) -> None:
        self.text = text
        self.tokens = self._tokenise()
        self.next = 0

    def _fail(self, position: int, problem: str) -> SelectorError:
        return SelectorError(f"Cannot read selector '{self.text}' at character {position + 1}: {problem}.")

    def _tokenise(self) -> list[tuple[str, str, int]]:
        tokens: list[tuple[str, str, int]] = []
        position, end = 0, len(self.text.rstrip())
        while position < end:
            match = _TOKEN.match(self.text, position)
            start = position + len(self.text[position:]) - len(self.text[position:].lstrip())
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
                f"unknown kind '{match['kind']}:';{did_you_mean(match['kind'], SELECTOR_KINDS).lower()} "
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
            tree = self._selector()
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
