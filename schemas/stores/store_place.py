"""Where a store may be made."""

from __future__ import annotations

from pathlib import Path

from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.stores.root import group_attributes
from vla_attention.schemas.stores.store_format import FORMAT_NAME, STORE_SUFFIX


def check_place(path: Path, doing: str) -> None:
    """Raise `BadArgument` unless a store may be made at a path: it is called NAME.zarr, and is in no other store.

    doing: how the sentence begins, for instance "copy to".
    """
    if path.suffix != STORE_SUFFIX:
        raise BadArgument(f"Cannot {doing} {path}: expected a name that ends with '{STORE_SUFFIX}'.")
    for above in path.resolve().parents:
        if _is_store(above):
            raise BadArgument(
                f"Cannot {doing} {path}: it is inside of the store {above}, whose readers would take it for a part of "
                "that; give a place beside it."
            )


def _is_store(folder: Path) -> bool:
    document = folder / "zarr.json"
    try:
        return document.is_file() and group_attributes(document.read_bytes()).get("format") == FORMAT_NAME
    except (OSError, ValueError):
        return False
