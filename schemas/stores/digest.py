"""The digests in a store: of an array (sha256 over its values in C order, little endian), and of a `zarr.json`."""

from __future__ import annotations

import hashlib

import numpy as np
from numpy.typing import NDArray


class ArrayDigest:
    """Digest of an array that is given in consecutive blocks along its first axis."""

    def __init__(self) -> None:
        self._hash = hashlib.sha256()

    def update(self, values: NDArray[np.generic]) -> None:
        """Add the next block."""
        ordered = np.ascontiguousarray(values, dtype=values.dtype.newbyteorder("<"))
        self._hash.update(ordered.reshape(-1).view(np.uint8).data)

    def hexdigest(self) -> str:
        """The digest so far, in hexadecimal."""
        return self._hash.hexdigest()


def document_digest(content: bytes) -> str:
    """The digest of a `zarr.json`: sha256 of its bytes, in hexadecimal."""
    return hashlib.sha256(content).hexdigest()
