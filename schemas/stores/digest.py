"""The digests in a store (sha256, in hexadecimal): of an array's values, a file, a run's configuration, a seal.

Where two runs have different digests, `run_differences` says in which fields.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vla_attention.schemas.jsonable import to_json
from vla_attention.schemas.stores.store_format import JOB_RECORDS, RootAttributes

#: Bytes of the checksum `crc32c`, which stands behind each chunk and each index of a shard.
CHECKSUM_BYTES = 4


def crc32c(content: bytes | NDArray[np.uint8]) -> int:
    """The checksum that Zarr's codec `crc32c` writes after a chunk; imports its library when first used."""
    import google_crc32c

    checksum: int = google_crc32c.value(content)
    return checksum


class ArrayDigest:
    """Digest of an array (C order, little endian) that is given in consecutive blocks along its first axis."""

    def __init__(self) -> None:
        self._hash = hashlib.sha256()

    def update(self, values: NDArray[np.generic]) -> None:
        """Add the next block."""
        ordered = np.ascontiguousarray(values, dtype=values.dtype.newbyteorder("<"))
        self._hash.update(ordered.reshape(-1).view(np.uint8).data)

    def hexdigest(self) -> str:
        """The digest so far, in hexadecimal."""
        return self._hash.hexdigest()


def bytes_digest(content: bytes) -> str:
    """The digest of a file, or of a part of it."""
    return hashlib.sha256(content).hexdigest()


def run_configuration(attributes: Mapping[str, Any]) -> dict[str, Any]:
    """The root's attributes, as they stand in its `zarr.json`, without the job records (`JOB_RECORDS`)."""
    configuration = dict(attributes)
    for *parents, field in JOB_RECORDS:
        holder = configuration
        for parent in parents:
            holder[parent] = dict(holder[parent])  # the caller's keeps its fields
            holder = holder[parent]
        holder.pop(field, None)
    return configuration


def run_digest(attributes: Mapping[str, Any]) -> str:
    """The digest of a run's configuration; `attributes` are those in the root's `zarr.json`.

    It is over the attributes as they stand there, not over `RootAttributes`: a field that a later version adds with a
    default does not change the digest of older stores.
    """
    return bytes_digest(_canonical(run_configuration(attributes)))


def root_digest(attributes: Mapping[str, Any]) -> str:
    """The digest of a root over all its fields but `digest`; `attributes` are those in its `zarr.json`."""
    return bytes_digest(_canonical({name: value for name, value in attributes.items() if name != "digest"}))


def with_digest(attributes: Mapping[str, Any]) -> dict[str, Any]:
    """Attributes with their own digest as the last field, in place of the one that they have."""
    return {**attributes, "digest": root_digest(attributes)}


def _canonical(document: object) -> bytes:
    """JSON in one form: keys sorted, no white space, other characters than ASCII escaped."""
    return json.dumps(document, sort_keys=True, separators=(",", ":")).encode()


#: Path of a field, and its values in the one and in the other run; None where a run has no such field.
Difference = tuple[str, object, object]


def run_differences(one: RootAttributes, other: RootAttributes) -> Iterator[Difference]:
    """The fields in which two runs' configurations differ, in the order of the root's attributes."""
    yield from _differences(run_configuration(to_json(one)), run_configuration(to_json(other)), "")


def _differences(one: Any, other: Any, where: str) -> Iterator[Difference]:
    if isinstance(one, dict) and isinstance(other, dict):
        for key in [*one, *(key for key in other if key not in one)]:
            yield from _differences(one.get(key), other.get(key), f"{where}.{key}".lstrip("."))
    elif isinstance(one, list) and isinstance(other, list) and len(one) == len(other) and where.startswith("sites"):
        for i, (a, b) in enumerate(zip(one, other, strict=True)):
            yield from _differences(a, b, f"{where}[{i}]")
    elif one != other:
        yield where, one, other
