"""Where the bytes of a store come from: a folder here, or an address elsewhere.

Nothing here knows what the bytes mean. `sealed_files.py` compares them with an episode's seal before anything else sees
them, so that damage, or a server that answers with something else, gives an error and never a number.
"""

from __future__ import annotations

import os
import stat
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from vla_attention.schemas.limits import CLAIMED_BYTES, WHOLE_FILE_BYTES
from vla_attention.schemas.regular_files import (
    UNFOLLOWED,
    NotRegular,
    check_not_sparse,
    not_regular,
    open_regular,
    read_all,
)

#: Memory for bytes of a file, (byte,) uint8.
Memory: TypeAlias = NDArray[np.uint8]


class ByteSource(Protocol):
    """Files below one place, read whole or in parts. Every method raises `OSError` for what cannot be read.

    A source can be pickled.
    """

    def whole(self, file: str, *, most: int = WHOLE_FILE_BYTES) -> bytes:
        """All bytes of a file, which must not have more than `most`."""

    def part(self, file: str, offset: int, length: int) -> bytes:
        """So many bytes of a file from `offset` on; fewer where the file ends."""

    def read_into(self, memory: Memory, file: str, offset: int) -> int:
        """Fill memory with the bytes of a file from `offset` on; returns how many there were, fewer at its end."""

    def size(self, file: str) -> int:
        """Bytes of a file."""


@dataclass(frozen=True)
class Folder:
    """A folder of this machine's file systems. Only regular files are read, and no link is followed out of it.

    Attributes:
        path: the folder.
        within: the folder that links may not lead out of; None is the folder itself. What it is a part of may be a
            link: somebody gave the path.
    """

    path: Path
    within: Path | None = None
    _inside: set[str] = field(default_factory=set, repr=False, compare=False)
    _regular: set[str] = field(default_factory=set, repr=False, compare=False)

    def whole(self, file: str, *, most: int = WHOLE_FILE_BYTES) -> bytes:
        """See `ByteSource`."""
        handle, size = self._open(file)
        try:
            if size > most:
                raise NotRegular(f"it has {size:,} bytes; expected at most {most:,}", self.path / file)
            if size > CLAIMED_BYTES:
                check_not_sparse(self.path / file, handle, size)
            return read_all(handle, size)
        finally:
            os.close(handle)

    def part(self, file: str, offset: int, length: int) -> bytes:
        """See `ByteSource`."""
        handle, size = self._open(file)
        try:
            # Memory is taken for as many bytes as are asked for. One more than there are shows a file that grows.
            return os.pread(handle, min(length, max(0, size - offset) + 1), offset)
        finally:
            os.close(handle)

    def read_into(self, memory: Memory, file: str, offset: int) -> int:
        """See `ByteSource`."""
        # A scan reads hundreds of chunks of one file, which was looked at when its index was read.
        handle = os.open(f"{self.path}/{file}", UNFOLLOWED) if file in self._regular else self._open(file)[0]
        try:
            return os.preadv(handle, [memory.data], offset)
        finally:
            os.close(handle)

    def _open(self, file: str) -> tuple[int, int]:
        # A scan opens files thousands of times: Python's own file objects take longer than the read.
        folder = file.rpartition("/")[0]
        if folder not in self._inside:
            self._check_inside(folder)
        path = f"{self.path}/{file}"
        try:
            opened = open_regular(path, follow=False)
            self._regular.add(file)
            return opened
        except NotRegular:
            if not os.path.islink(path):
                raise
        self._check_target(path)
        return open_regular(path)

    def _check_inside(self, folder: str) -> None:
        """Raise `NotRegular` unless the folder of a file is where it seems to be, or at least in the store."""
        if "" not in self._inside:
            place = self._boundary
            for part in self.path.relative_to(place).parts:
                place = place / part
                self._check_link(str(place))
            self._inside.add("")
        inner = ""
        for part in folder.split("/") if folder else ():
            inner = f"{inner}/{part}" if inner else part
            if inner not in self._inside:
                self._check_link(f"{self.path}/{inner}")
                self._inside.add(inner)

    def _check_link(self, path: str) -> None:
        if stat.S_ISLNK(os.lstat(path).st_mode):
            self._check_target(path)

    @property
    def _boundary(self) -> Path:
        return self.within or self.path

    def _check_target(self, link: str | Path) -> None:
        target, boundary = os.path.realpath(link), os.path.realpath(self._boundary)
        if os.path.commonpath([target, boundary]) != boundary:
            raise NotRegular("it is a link that leads out of the store", link)

    def size(self, file: str) -> int:
        """See `ByteSource`."""
        path = self.path / file
        self._check_inside(file.rpartition("/")[0])
        status = os.lstat(path)
        if stat.S_ISLNK(status.st_mode):
            self._check_target(path)
            status = os.stat(path)
        if not stat.S_ISREG(status.st_mode):
            raise not_regular(path, status.st_mode)
        return status.st_size

    def check_not_sparse(self, file: str) -> None:
        """Raise `NotRegular` for a large file of which hardly any byte is stored."""
        handle, size = self._open(file)
        try:
            if size > CLAIMED_BYTES:
                check_not_sparse(self.path / file, handle, size)
        finally:
            os.close(handle)
