"""Groupings: named sets of groups, each a selector over keys, as data (TOML file, command line, or built in)."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from vla_attention.schemas.errors import BadArgument, UserError, did_you_mean, listing, shortened
from vla_attention.schemas.foreign_files import read_toml
from vla_attention.schemas.groupings.selector_parser import atoms_of, parse_selector
from vla_attention.schemas.groupings.selectors import SelectorError
from vla_attention.schemas.jsonable import Document, MalformedDocument, from_json
from vla_attention.schemas.safe_text import check_text, visible

#: The selector that, alone, means: whatever no other group of the grouping takes.
REST = "*"


#: Column names of tables begin with group names; these are taken by the ratio.
_RESERVED_NAMES = ("numerator", "denominator", "ratio")
#: Names become parts of files' names.
_NAME_CHARACTERS = 255
_GROUP_NAME = re.compile(r"[A-Za-z0-9_][\w.@-]*")


class GroupingError(UserError, ValueError):
    """A grouping that contradicts itself or that does not fit what is stored."""


class GroupingNotFound(GroupingError, FileNotFoundError):
    """Neither a built-in grouping nor a readable TOML file."""


class Ratio(Document, frozen=True):
    """Which groups' masses make the numerator and the denominator of the ratio."""

    numerator: tuple[str, ...]
    denominator: tuple[str, ...]


class GroupingFile(Document, frozen=True):
    """A grouping as written in a TOML file: group name to one selector or a list of selectors (their union)."""

    groups: dict[str, str | list[str]]
    name: str | None = None
    description: str = ""
    ratio: Ratio | None = None
    overlap: bool = False
    allow_empty: tuple[str, ...] = ()


@dataclass(frozen=True)
class Grouping:
    """A named set of groups. Order matters only for display and for the rest group.

    `groups`: group name to selectors (their union). `overlap`: a key may belong to more than one group. `allow_empty`:
    groups that may have no keys in any selected episode; for any other group that is an error. `proxy`: groups are
    called visual and linguistic, as in the published scripts, although their keys are something else.
    `published_denoise`: the denoise step whose rows the published numbers are of, for a grouping that repeats them.
    """

    name: str
    groups: Mapping[str, tuple[str, ...]]
    ratio: Ratio | None = None
    overlap: bool = False
    allow_empty: tuple[str, ...] = ()
    description: str = ""
    proxy: bool = False
    published_denoise: Literal["first", "last"] | None = None

    def __post_init__(self) -> None:
        """Check everything that can be checked without a layout."""
        if not self.groups:
            raise GroupingError(f"Grouping '{self.name}' has no groups; expected at least one NAME = SELECTOR.")
        for group, selectors in self.groups.items():
            if group in _RESERVED_NAMES or not _GROUP_NAME.fullmatch(group) or len(group) > _NAME_CHARACTERS:
                raise GroupingError(
                    f"'{visible(shortened(group))}' cannot name a group: expected letters, digits, '_', '.', '-', and "
                    f"none of {listing(_RESERVED_NAMES)}."
                )
            if not selectors:
                raise GroupingError(f"Group '{group}' of grouping '{self.name}' has no selector.")
            for selector in selectors:
                if selector.strip() == REST and len(selectors) > 1:
                    raise GroupingError(f"Group '{group}': '*' (the rest) cannot be joined with other selectors.")
                try:
                    parse_selector(selector)
                except SelectorError as error:
                    raise SelectorError(f"Group '{group}': {error}") from None
        rest = [group for group, selectors in self.groups.items() if selectors[0].strip() == REST]
        if len(rest) > 1:
            raise GroupingError(f"Groups {listing(rest)} are all '*'; only one group can take the rest.")
        for part in (*(self.ratio.numerator + self.ratio.denominator if self.ratio else ()), *self.allow_empty):
            if part not in self.groups:
                raise GroupingError(
                    f"Grouping '{self.name}' refers to group '{part}', which it does not define."
                    f"{did_you_mean(part, self.groups)} Defined: {listing(self.groups)}."
                )
        if self.ratio and not (self.ratio.numerator and self.ratio.denominator):
            raise GroupingError(f"The ratio of grouping '{self.name}' needs a numerator and a denominator.")

    @property
    def compares_modalities(self) -> bool:
        """Whether the ratio is visual over linguistic attention, so that the published thresholds apply to it.

        A proxy's ratio is not, whatever its groups are called, nor is one whose denominator consists of latent frames,
        which are pictures, numbers and noise.
        """
        if self.proxy or self.ratio is None or self.ratio.denominator != ("linguistic",):
            return False
        atoms = [atom for text in self.groups["linguistic"] for atom in atoms_of(parse_selector(text))]
        return not any(atom.kind == "frame" for atom in atoms)

    @property
    def names(self) -> tuple[str, ...]:
        """Group names in order."""
        return tuple(self.groups)


def read_grouping_file(path: Path) -> Grouping:
    """Read a TOML grouping; every error names the file. The rest is a group of its own, unless one takes it."""
    try:
        document = read_toml(path)
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise GroupingNotFound(f"Cannot read grouping file {path}: {reason}.") from None
    except ValueError as error:
        raise GroupingError(f"Grouping file {path} is not valid TOML: {error}.") from None
    try:
        content = from_json(GroupingFile, document)
        check_text("grouping's name", content.name or path.stem)
        groups = {
            name: (selectors,) if isinstance(selectors, str) else tuple(selectors)
            for name, selectors in content.groups.items()
        }
        whole, may_be_empty = _with_rest(groups)
        return Grouping(
            name=content.name or path.stem,
            groups=whole,
            ratio=content.ratio or conventional_ratio(groups),
            overlap=content.overlap,
            allow_empty=(*content.allow_empty, *may_be_empty),
            description=content.description,
        )
    except (MalformedDocument, GroupingError, SelectorError) as error:
        raise type(error)(f"Grouping file {path}: {error}") from None
    except BadArgument as error:
        raise GroupingError(f"Grouping file {path}: {error}") from None


def conventional_ratio(groups: Iterable[str]) -> Ratio | None:
    """visual / linguistic for a grouping that has groups of these names and no ratio of its own."""
    names = set(groups)
    return Ratio(("visual",), ("linguistic",)) if {"visual", "linguistic"} <= names else None


def parse_group_argument(text: str) -> tuple[str, str]:
    """Split a command-line `NAME=SELECTOR`."""
    name, separator, selector = text.partition("=")
    if not separator or not name.strip() or not selector.strip():
        raise GroupingError(f"Cannot read --group '{text}'; expected NAME=SELECTOR, for instance nouns='word:bowl'.")
    return name.strip(), selector.strip()


def parse_ratio_argument(text: str) -> Ratio:
    """Read a command-line `A,B/C`: groups of the numerator and of the denominator."""
    numerator, separator, denominator = text.partition("/")
    parts = [tuple(name.strip() for name in side.split(",") if name.strip()) for side in (numerator, denominator)]
    if not separator or not all(parts):
        raise GroupingError(f"Cannot read --ratio '{text}'; expected GROUP[,GROUP]/GROUP[,GROUP].")
    return Ratio(parts[0], parts[1])


def with_groups(base: Grouping | None, added: Iterable[tuple[str, str]]) -> Grouping:
    """Add command-line groups to a grouping, or make one of them alone (then the rest is a group of its own).

    A name given twice is a union of its selectors; a name that the base grouping has is replaced.
    """
    selectors: dict[str, tuple[str, ...]] = {}
    for name, selector in added:
        selectors[name] = (*selectors.get(name, ()), selector)
    if base is not None:
        kept = {name: value for name, value in base.groups.items() if name not in selectors}
        return replace(base, name=f"{base.name}+{'+'.join(selectors)}", groups={**selectors, **kept})
    whole, may_be_empty = _with_rest(selectors)
    return Grouping("+".join(selectors), whole, conventional_ratio(selectors), allow_empty=may_be_empty)


def _with_rest(groups: Mapping[str, tuple[str, ...]]) -> tuple[Mapping[str, tuple[str, ...]], tuple[str, ...]]:
    """The groups, and a group of the rest unless one takes it: fractions are of all tokens. And which may be empty."""
    if any(value[:1] and value[0].strip() == REST for value in groups.values()) or not groups:
        return groups, ()
    name = next(name for name in ("rest", "other_tokens", "all_other_tokens") if name not in groups)
    return {**groups, name: (REST,)}, (name,)
