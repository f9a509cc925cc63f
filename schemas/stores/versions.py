"""Which versions of the format this program reads. `docs/store.md` ("Versions") has the rule for changes."""

from __future__ import annotations

from typing import Any

from vla_attention.schemas.jsonable import from_json
from vla_attention.schemas.stores.store_format import (
    FORMAT_NAME,
    STORE_VERSION,
    FormatTooNew,
    RootAttributes,
    StoreError,
)

#: What drafts of the format said in place of `store_version`, which no release wrote.
_DRAFT = "format_version"


def decode_root(attributes: dict[str, Any], path: object) -> RootAttributes:
    """The root attributes of a store of any version that this program reads.

    Raises:
        FormatTooNew: a later version wrote the store.
        StoreError: it is no store of this tool, or its version is none.
        MalformedDocument, ValueError: its attributes have other fields or values than that version.
    """
    check_version(attributes, path)
    return from_json(RootAttributes, attributes)


def check_version(attributes: dict[str, Any], path: object) -> None:
    """Raise unless root attributes belong to a store that this program can read; see `decode_root`."""
    if attributes.get("format") != FORMAT_NAME:
        raise StoreError(
            f"{path} is a Zarr group, but not a store of this tool: its attribute 'format' is not '{FORMAT_NAME}'."
        )
    if _DRAFT in attributes:
        raise StoreError(
            f"{path} says {_DRAFT}: it is of a draft of the format, before version 1, and this program reads versions "
            f"1 to {STORE_VERSION}; capture the episodes again."
        )
    version = attributes.get("store_version")
    if not isinstance(version, int) or isinstance(version, bool) or version < 1:
        given = f"has the store_version {_short(version)}" if "store_version" in attributes else "has no store_version"
        raise StoreError(f"{path} {given}; expected a whole number, 1 to {STORE_VERSION}.")
    if version > STORE_VERSION:
        raise FormatTooNew(
            f"{path} is a store of version {_short(version)}, and this program reads stores up to version "
            f"{STORE_VERSION}; install a newer version of it."
        )


def _short(value: object) -> str:
    """A value of a document as text; a number of thousands of digits cannot be printed."""
    if isinstance(value, int) and value.bit_length() > 64:
        return "with more than 19 digits"
    text = repr(value)
    return text if len(text) <= 40 else f"{text[:40]}..."
