"""Where the bytes of a store come from: a folder here, or an address elsewhere.

Nothing here knows what the bytes mean. `sealed_files.py` compares them with an episode's seal before anything else sees
them, so that damage, or a server that answers with something else, gives an error and never a number.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from vla_attention.schemas.foreign_files import MAX_DOCUMENT_BYTES, open_regular, read_regular

#: Memory for bytes of a file, (byte,) uint8.
Memory: TypeAlias = NDArray[np.uint8]


class ByteSource(Protocol):
    """Files below one place, read whole or in parts. Every method raises `OSError` for what cannot be read.

    A source can be pickled.
    """

    def whole(self, file: str, most: int = MAX_DOCUMENT_BYTES) -> bytes:
        """All bytes of a file, which may have at most so many."""

    def part(self, file: str, offset: int, length: int) -> bytes:
        """So many bytes of a file from `offset` on; fewer where the file ends."""

    def read_into(self, memory: Memory, file: str, offset: int) -> int:
        """Fill memory with the bytes of a file from `offset` on; returns how many there were, fewer at its end."""

    def size(self, file: str) -> int:
        """Bytes of a file."""


@dataclass(frozen=True)
class Folder:
    """A folder of this machine's file systems."""

    path: Path

    def whole(self, file: str, most: int = MAX_DOCUMENT_BYTES) -> bytes:
        """See `ByteSource`."""
        return read_regular(f"{self.path}/{file}", most)

    def part(self, file: str, offset: int, length: int) -> bytes:
        """See `ByteSource`."""
        handle = open_regular(f"{self.path}/{file}")
        try:
            return os.pread(handle, length, offset)
        finally:
            os.close(handle)

    def read_into(self, memory: Memory, file: str, offset: int) -> int:
        """See `ByteSource`."""
        # A scan reads thousands of chunks: Python's own file objects take longer than the read.
        handle = open_regular(f"{self.path}/{file}")
        try:
            return os.preadv(handle, [memory.data], offset)
        finally:
            os.close(handle)

    def size(self, file: str) -> int:
        """See `ByteSource`."""
        return os.stat(f"{self.path}/{file}").st_size
