"""Stores that lie in the repository as archives, unpacked once a process."""

from __future__ import annotations

import tempfile
from functools import cache
from pathlib import Path

from vla_attention.example_stores import archive_of
from vla_attention.schemas.stores.tar_files import unpack

#: Removed when the process ends.
_FOLDERS: list[tempfile.TemporaryDirectory[str]] = []


@cache
def unpacked(archive: Path) -> Path:
    """The store NAME.zarr of an archive NAME.tar.xz. It is shared: a test that changes it copies it first."""
    folder = tempfile.TemporaryDirectory(prefix="stores_")
    _FOLDERS.append(folder)
    unpack(archive, Path(folder.name))
    return Path(folder.name) / f"{archive.name.removesuffix('.tar.xz')}.zarr"


def example_store(name: str) -> Path:
    """An example store."""
    return unpacked(archive_of(name))
