"""Where the cache is and how large it may become: the variables VLA_CACHE and VLA_CACHE_SIZE. Imports nothing heavy."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from vla_attention.schemas.errors import BadArgument

#: The folder of the cache, relative to the working directory: beside the results, which are in results/STORE/GROUPING.
DEFAULT_FOLDER = Path("results", ".cache")
#: A grouping of 500 LIBERO episodes takes 70 MB.
DEFAULT_BYTES = 2_000_000_000
FOLDER_VARIABLE = "VLA_CACHE"
SIZE_VARIABLE = "VLA_CACHE_SIZE"
#: Values of VLA_CACHE with which there is no cache.
_OFF = ("off", "0", "no", "false")
#: Values with which it is where it is without the variable.
_ON = ("on", "1", "yes", "true", "")
_UNITS = {"": 1, "B": 1, "KB": 10**3, "MB": 10**6, "GB": 10**9, "TB": 10**12}
_UNITS |= {"KIB": 2**10, "MIB": 2**20, "GIB": 2**30, "TIB": 2**40}
_UNITS |= {unit[0]: _UNITS[unit] for unit in ("KB", "MB", "GB", "TB")}
#: At most 15 digits before the point: more are a mistake, and hundreds would be an infinite float.
_SIZE = re.compile(r"([0-9]{1,15}(?:\.[0-9]*)?|\.[0-9]+)\s*([A-Za-z]*)")


@dataclass(frozen=True)
class CachePlace:
    """A folder for the cache, which need not exist, and the most bytes that its files may take."""

    folder: Path
    most_bytes: int = DEFAULT_BYTES


def cache_place() -> CachePlace | None:
    """The cache of this process; None when it is switched off.

    Raises:
        BadArgument: VLA_CACHE_SIZE is no size.
    """
    given = os.environ.get(FOLDER_VARIABLE, "").strip()
    if given.casefold() in _OFF:
        return None
    text = os.environ.get(SIZE_VARIABLE, "").strip()
    size = _parse_bytes(text) if text else DEFAULT_BYTES
    if size is None:
        raise BadArgument(
            f"{SIZE_VARIABLE}={text} is no size; expected a number of bytes, or one with a unit, as in 500MB or 2GB. "
            f"To switch the cache off, set {FOLDER_VARIABLE}=off."
        )
    # Absolute: the working directory may change while a store is open.
    folder = DEFAULT_FOLDER if given.casefold() in _ON else Path(given)
    return CachePlace(folder.absolute(), size)


def _parse_bytes(text: str) -> int | None:
    """Read a number of bytes with or without a unit; KB (or K) is 1000 bytes, KiB 1024. None for anything else."""
    match = _SIZE.fullmatch(text)
    unit = _UNITS.get(match[2].upper()) if match else None
    return None if match is None or unit is None else int(float(match[1]) * unit)


def check_cache_place(place: CachePlace) -> None:
    """Raise `BadArgument` for a cache inside of a store, whose readers would take it for a part of that."""
    from vla_attention.schemas.stores.store_place import refuse_in_store

    given = os.environ.get(FOLDER_VARIABLE, "").strip()
    where = "the working directory's cache" if given.casefold() in _ON else f"what {FOLDER_VARIABLE} names,"
    refuse_in_store(place.folder, f"keep what is measured in {where}")


@contextmanager
def switched_off() -> Iterator[None]:
    """No cache within the block, for this process and those that it starts: `--no-cache`."""
    before = os.environ.get(FOLDER_VARIABLE)
    os.environ[FOLDER_VARIABLE] = _OFF[0]
    try:
        yield
    finally:
        if before is None:
            del os.environ[FOLDER_VARIABLE]
        else:
            os.environ[FOLDER_VARIABLE] = before
