"""Where a store may be made, and where nothing else may be written."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.limits import ROOT_BYTES
from vla_attention.schemas.regular_files import read_regular
from vla_attention.schemas.stores.root import group_attributes
from vla_attention.schemas.stores.store_format import FORMAT_NAME, STORE_SUFFIX


def check_place(path: Path, doing: str) -> None:
    """Raise `BadArgument` unless a store may be made at a path: it is called NAME.zarr, and is in no other store.

    doing: how the sentence begins, for instance "copy to".
    """
    if path.suffix != STORE_SUFFIX:
        raise BadArgument(f"Cannot {doing} {path}: expected a name that ends with '{STORE_SUFFIX}'.")
    _refuse_in(_place(path).parents, path, doing)


def refuse_in_store(path: Path, doing: str) -> None:
    """Raise `BadArgument` for a file or folder that is a store, or in one, and is to be written.

    doing: how the sentence begins, for instance "write results to".
    """
    place = _place(path)
    _refuse_in((place, *place.parents), path, doing)


def _place(path: Path) -> Path:
    return Path(os.path.realpath(path))


def _refuse_in(folders: Iterable[Path], path: Path, doing: str) -> None:
    for folder in folders:
        if _is_store(folder):
            raise BadArgument(
                f"Cannot {doing} {path}: it is inside of the store {folder}, whose readers would take it for a part of "
                "that; give a place beside it."
            )


def _is_store(folder: Path) -> bool:
    try:
        return group_attributes(read_regular(folder / "zarr.json", ROOT_BYTES)).get("format") == FORMAT_NAME
    except (OSError, ValueError):
        return False


def check_writable(path: Path, option: str) -> None:
    """Raise `BadArgument` if nothing can be created at `path`, or if it is in a store. Creates nothing itself."""
    refuse_in_store(path, "write to")
    nearest = next(folder for folder in (path.absolute(), *path.absolute().parents) if folder.exists())
    if not nearest.is_dir():
        raise BadArgument(f"Cannot write to {path}: {nearest} is a file; give another {option}.")
    if not os.access(nearest, os.W_OK | os.X_OK):
        raise BadArgument(f"Cannot write to {path}: no permission to write in {nearest}; give another {option}.")
