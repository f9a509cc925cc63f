"""Where the bytes of a store come from: a folder here, an address elsewhere, or a zip file in either of them.

Nothing here knows what the bytes mean. `sealed_files.py` compares them with an episode's seal before anything else sees
them, so that a damaged zip, a server that answers with something else, or a damaged cache gives an error and never a
number.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

#: Memory for bytes of a file, (byte,) uint8.
Memory: TypeAlias = NDArray[np.uint8]


class ByteSource(Protocol):
    """Files below one place, read whole or in parts. Every method raises `OSError` for what cannot be read.

    `remembers`: bytes may come from a cache; `fresh` asks for them anew. A source can be pickled.
    """

    @property
    def remembers(self) -> bool:
        """Whether bytes may come from a cache."""

    def whole(self, file: str, *, fresh: bool = False) -> bytes:
        """All bytes of a file."""

    def parts(self, file: str, offset: int, lengths: Sequence[int], *, fresh: bool = False) -> list[bytes]:
        """Neighbouring parts of a file, the first at `offset`; they are shorter where the file ends."""

    def read_into(self, memory: Memory, file: str, offset: int, *, fresh: bool = False) -> int:
        """Fill memory with the bytes of a file from `offset` on; returns how many there were, fewer at its end."""

    def size(self, file: str) -> int:
        """Bytes of a file."""

    def bound_to(self, digest: str) -> ByteSource:
        """The same files, of which it is known that they belong to a seal of this digest; a cache is kept by it."""


@dataclass(frozen=True)
class Folder:
    """A folder of this machine's file systems."""

    path: Path
    remembers = False

    def whole(self, file: str, *, fresh: bool = False) -> bytes:
        """See `ByteSource`."""
        return (self.path / file).read_bytes()

    def parts(self, file: str, offset: int, lengths: Sequence[int], *, fresh: bool = False) -> list[bytes]:
        """See `ByteSource`."""
        handle = self._open(file)
        try:
            found = []
            for length in lengths:
                found.append(os.pread(handle, length, offset))
                offset += length
            return found
        finally:
            os.close(handle)

    def read_into(self, memory: Memory, file: str, offset: int, *, fresh: bool = False) -> int:
        """See `ByteSource`."""
        handle = self._open(file)
        try:
            return os.preadv(handle, [memory.data], offset)
        finally:
            os.close(handle)

    def _open(self, file: str) -> int:
        # A scan opens files thousands of times: Python's own file objects take longer than the read.
        return os.open(f"{self.path}/{file}", os.O_RDONLY | getattr(os, "O_CLOEXEC", 0))

    def size(self, file: str) -> int:
        """See `ByteSource`."""
        return os.stat(self.path / file).st_size

    def bound_to(self, digest: str) -> Folder:
        """See `ByteSource`."""
        return self


def copy_into(memory: Memory, content: bytes) -> int:
    """`ByteSource.read_into` from bytes that are there."""
    memory[: len(content)] = np.frombuffer(content, np.uint8)
    return len(content)


def split(content: bytes, lengths: Sequence[int]) -> list[bytes]:
    """Neighbouring parts of some bytes."""
    found, at = [], 0
    for length in lengths:
        found.append(content[at : at + length])
        at += length
    return found
