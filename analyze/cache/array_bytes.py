"""Named arrays as bytes and back: a line of JSON with names, types and shapes, then the numbers."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

_TYPES = ("<f8", "<f4", "<i8", "<i4", "|u1", "|b1")


def arrays_to_bytes(arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """The arrays, C order, little endian; raises `TypeError` for another type than `_TYPES`."""
    described, contents = [], []
    for name, array in arrays.items():
        kind = array.dtype.newbyteorder("<").str
        if kind not in _TYPES:
            raise TypeError(f"arrays of {array.dtype} are not kept")
        described.append([name, kind, list(array.shape)])
        contents.append(np.ascontiguousarray(array, dtype=kind).tobytes())
    line = json.dumps(described).encode()
    # Numbers begin at a multiple of 8 bytes.
    return b"".join((line, b" " * (-(len(line) + 1) % 8), b"\n", *contents))


def arrays_from_bytes(content: bytes) -> dict[str, NDArray[Any]]:
    """The arrays, read-only; raises `ValueError` when the bytes are not those of arrays."""
    line, found, _ = content.partition(b"\n")
    if not found:
        raise ValueError("there is no first line")
    arrays: dict[str, NDArray[Any]] = {}
    start = len(line) + 1
    for name, kind, shape in json.loads(line):
        if kind not in _TYPES:
            raise ValueError(f"'{kind}' is no type of arrays that are kept")
        count = math.prod(shape)
        arrays[name] = np.frombuffer(content, kind, count, start).reshape(shape)
        start += count * np.dtype(kind).itemsize
    if start != len(content):
        raise ValueError("the arrays have another size than their first line says")
    return arrays
