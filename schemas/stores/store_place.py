"""Where a store may be made, the room there and what is taken, and where nothing else may be written."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from vla_attention.schemas.command_line import format_bytes
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.foreign_files import read_regular
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
        return group_attributes(read_regular(folder / "zarr.json")).get("format") == FORMAT_NAME
    except (OSError, ValueError):
        return False


@dataclass(frozen=True)
class Room:
    """What a file system has left for this user.

    inodes: as many files and folders can be made; None where it has no fixed number of them, or does not say.
    """

    bytes: int
    inodes: int | None

    def describe(self) -> str:
        """Return it in words, as the beginning of "... free"."""
        inodes = "" if self.inodes is None else f" and {self.inodes:,} inodes"
        return f"{format_bytes(self.bytes)}{inodes}"


def room_at(path: Path) -> Room:
    """Return the room for a path that need not exist yet."""
    place = _nearest(path)
    # Some file systems (btrfs, many network ones) say 0 of 0: they make inodes as they need them.
    counts = os.statvfs(place) if hasattr(os, "statvfs") else None
    return Room(shutil.disk_usage(place).free, counts.f_favail if counts is not None and counts.f_files else None)


def bytes_below(folder: Path) -> int:
    """Return the bytes of all files in a folder and below."""
    return sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())


def why_refused(error: OSError, path: Path) -> str:
    """Return why the operating system refused to write below a path: its own words, and what is used up.

    "No space left on device" also stands for a file system that has bytes and no inode left.
    """
    words = error.strerror or str(error) or type(error).__name__
    if error.errno not in (errno.ENOSPC, errno.EDQUOT):
        return words
    try:
        room = room_at(path)
    except OSError:
        return words
    if room.inodes == 0:
        return (
            f"{words}: all inodes are used, and every file and folder takes one ({format_bytes(room.bytes)} are free): "
            "delete files there, or write elsewhere"
        )
    return f"{words} ({room.describe()} free; quotas, of files too, may be smaller)"


def _nearest(path: Path) -> Path:
    return next(folder for folder in (path.absolute(), *path.absolute().parents) if folder.exists())


def check_writable(path: Path, option: str) -> None:
    """Raise `BadArgument` if nothing can be created at `path`, or if it is in a store. Creates nothing itself."""
    refuse_in_store(path, "write to")
    nearest = _nearest(path)
    if not nearest.is_dir():
        raise BadArgument(f"Cannot write to {path}: {nearest} is a file; give another {option}.")
    if not os.access(nearest, os.W_OK | os.X_OK):
        raise BadArgument(f"Cannot write to {path}: no permission to write in {nearest}; give another {option}.")
    room = room_at(nearest)
    if room.inodes == 0:
        raise BadArgument(
            f"Cannot write to {path}: the file system of {nearest} has no inode left for another file or folder "
            f"({format_bytes(room.bytes)} are free); delete files there, or give another {option}."
        )
