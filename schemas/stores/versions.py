"""Which versions of the format this program reads, and the drafts that came before version 1.

A store says `store_version` in its root. The drafts, written while the format was made, say `format_version` 2 to 5
instead, which no later version will: a store has one of the two, so that a draft is never taken for a version.
`docs/store.md` ("Versions") has the rule for changes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from vla_attention.schemas.jsonable import from_json
from vla_attention.schemas.stores.store_format import (
    FORMAT_NAME,
    STORE_VERSION,
    FormatTooNew,
    RootAttributes,
    StoreError,
)

#: Seals of draft 1 bind metadata only: files that were exchanged between episodes would be read without an error.
OLDEST_DRAFT = 2
LAST_DRAFT = 5
#: The draft from which on numbers along one axis are attributes of their group. Before it they are small arrays.
_NUMBERS_DRAFT = 5
_READS = f"this program reads versions up to {STORE_VERSION} and the drafts {OLDEST_DRAFT} to {LAST_DRAFT}"


@dataclass(frozen=True, kw_only=True)
class DraftAttributes(RootAttributes):
    """Root attributes of a draft: `format_version` in place of `store_version`, which is 0 in memory.

    Draft 2 has neither `interventions` nor `rerun_of`, and up to draft 3 sites are `joint`, `self` and `cross`, and in
    all recorded layers.
    """

    format_version: int
    store_version: int = 0

    @property
    def version_text(self) -> str:
        """See `RootAttributes`."""
        return f"draft {self.format_version}"

    @property
    def numbers_in_arrays(self) -> bool:
        """See `RootAttributes`."""
        return self.format_version < _NUMBERS_DRAFT


def decode_root(attributes: dict[str, Any], path: object) -> RootAttributes:
    """The root attributes of a store of any version that this program reads.

    Raises:
        FormatTooNew: a later version wrote the store.
        StoreError: it is no store of this tool, or its version is none.
        MalformedDocument, ValueError: its attributes have other fields or values than that version.
    """
    check_version(attributes, path)
    return from_json(DraftAttributes if "format_version" in attributes else RootAttributes, attributes)


def check_version(attributes: dict[str, Any], path: object) -> None:
    """Raise unless root attributes belong to a store that this program can read; see `decode_root`."""
    if attributes.get("format") != FORMAT_NAME:
        raise StoreError(
            f"{path} is a Zarr group, but not a store of this tool: its attribute 'format' is not '{FORMAT_NAME}'."
        )
    given = [name for name in ("store_version", "format_version") if name in attributes]
    if len(given) != 1:
        raise StoreError(
            f"{path} has {'both' if given else 'neither'} a store_version {'and' if given else 'nor'} a "
            f"format_version; {_READS}."
        )
    name = given[0]
    version = attributes[name]
    if not isinstance(version, int) or isinstance(version, bool) or version < 1:
        raise StoreError(f"{path} has the {name} {_short(version)}; expected a whole number: {_READS}.")
    if name == "store_version" and version > STORE_VERSION:
        raise FormatTooNew(
            f"{path} is a store of version {_short(version)}, and this program reads stores up to version "
            f"{STORE_VERSION}; install a newer version of it."
        )
    if name == "format_version" and version > LAST_DRAFT:
        raise StoreError(
            f"{path} has the format_version {_short(version)}, which no store has: the drafts end with {LAST_DRAFT}, "
            f"and stores since then say store_version; {_READS}."
        )
    if name == "format_version" and version < OLDEST_DRAFT:
        raise StoreError(
            f"{path} is of draft {version}, whose seals do not bind the numbers to their episodes; {_READS}: capture "
            "the episodes again."
        )


def _short(value: object) -> str:
    """A value of a document as text; a number of thousands of digits cannot be printed."""
    if isinstance(value, int) and value.bit_length() > 64:
        return "with more than 19 digits"
    text = repr(value)
    return text if len(text) <= 40 else f"{text[:40]}..."
