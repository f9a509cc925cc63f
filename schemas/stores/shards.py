"""Reading one layer and denoise step of a sharded array, straight from the shard's file.

A shard is a file of compressed chunks, with an index of their positions at its end (Zarr's `sharding_indexed` codec).
zarr-python reads it through an event loop, and passing the chunks between threads takes as long as decoding them; an
analysis of words reads thousands of chunks. This reader handles the one layout that `capture/store/codecs.py` writes.
An array of any other layout is read with zarr-python.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import google_crc32c
import numpy as np
from numcodecs import blosc
from numpy.typing import NDArray

from vla_attention.schemas.stores.store_format import CorruptEpisode

_CHECKSUM_BYTES = 4
_ABSENT = np.uint64(2**64 - 1)


@dataclass(frozen=True)
class _Shard:
    """One shard's file; `index` (layer, denoise, 2) uint64 has the offset and the length of each chunk in bytes."""

    path: Path
    index: NDArray[np.uint64]


@dataclass(frozen=True)
class ShardedLayers:
    """A float32 array (replan, layer, denoise, ...) whose chunks hold one layer and one denoise step each.

    Attributes:
        folder: the array's folder.
        shape: shape of the array.
        replans_per_shard: extent of shards and chunks along the replans.
    """

    folder: Path
    shape: tuple[int, ...]
    replans_per_shard: int

    @classmethod
    def of(cls, folder: Path, metadata: dict[str, Any]) -> ShardedLayers | None:
        """The array's reader, or None when its metadata (its `zarr.json`) describe another layout."""
        shape = tuple(metadata["shape"])
        shard = tuple(metadata["chunk_grid"].get("configuration", {}).get("chunk_shape", ()))
        codecs = metadata["codecs"]
        if len(shape) < 4 or len(codecs) != 1 or codecs[0]["name"] != "sharding_indexed":
            return None
        inner = codecs[0]["configuration"]
        known = (
            metadata["data_type"] == "float32"
            and metadata["chunk_key_encoding"] == {"name": "default", "configuration": {"separator": "/"}}
            and not metadata.get("storage_transformers")
            and shard[1:] == shape[1:]
            and tuple(inner["chunk_shape"]) == (shard[0], 1, 1, *shape[3:])
            and [codec["name"] for codec in inner["codecs"]] == ["bytes", "blosc", "crc32c"]
            and [codec["name"] for codec in inner["index_codecs"]] == ["bytes", "crc32c"]
            and inner["index_location"] == "end"
            and all(
                codec["configuration"]["endian"] == "little"
                for codec in (*inner["codecs"], *inner["index_codecs"])
                if codec["name"] == "bytes"
            )
        )
        return cls(folder, shape, shard[0]) if known else None

    @cached_property
    def _shards(self) -> tuple[_Shard, ...]:
        count = -(-self.shape[0] // self.replans_per_shard)
        rest = "/".join("0" for _ in self.shape[1:])
        return tuple(self._open(self.folder / "c" / str(i) / rest) for i in range(count))

    def _open(self, path: Path) -> _Shard:
        size = self.shape[1] * self.shape[2] * 16
        try:
            with path.open("rb") as file:
                file.seek(-(size + _CHECKSUM_BYTES), os.SEEK_END)
                stored = file.read()
        except OSError as error:
            raise CorruptEpisode(f"{path} cannot be read: {error.strerror or error}.") from None
        index = _checked(stored, f"the index of {path}")
        return _Shard(path, np.frombuffer(index, dtype="<u8").reshape(*self.shape[1:3], 2))

    def read(self, layer: int, denoise: int) -> NDArray[np.float32]:
        """Values (replan, ...) of one layer and denoise step, both positions along their axes.

        Raises:
            CorruptEpisode: a chunk is missing, or its checksum does not fit.
        """
        values = np.empty((self.shape[0], *self.shape[3:]), dtype=np.float32)
        chunk = np.empty((self.replans_per_shard, *self.shape[3:]), dtype="<f4")
        for i, shard in enumerate(self._shards):
            offset, length = shard.index[layer, denoise]
            what = f"chunk (layer {layer}, denoise {denoise}) of {shard.path}"
            if offset == _ABSENT:
                raise CorruptEpisode(f"The {what} is missing.")
            with shard.path.open("rb", buffering=0) as file:
                stored = os.pread(file.fileno(), int(length), int(offset))
            encoded = _checked(stored, f"the {what}")
            try:
                blosc.decompress(encoded, chunk)
            except (RuntimeError, ValueError) as error:
                raise CorruptEpisode(f"The {what} cannot be decoded: {error}.") from None
            first = i * self.replans_per_shard
            values[first : first + self.replans_per_shard] = chunk[: self.shape[0] - first]
        return values


def _checked(stored: bytes, what: str) -> bytes:
    """The bytes without their checksum at the end, which must be right."""
    content, checksum = stored[:-_CHECKSUM_BYTES], stored[-_CHECKSUM_BYTES:]
    if len(stored) <= _CHECKSUM_BYTES or google_crc32c.value(content) != int.from_bytes(checksum, "little"):
        raise CorruptEpisode(f"The checksum of {what} does not fit.")
    return content
