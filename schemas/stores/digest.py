"""The digest of an array in a store: sha256 over its values in C order, little endian."""

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
