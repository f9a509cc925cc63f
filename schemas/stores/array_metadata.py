"""What the `zarr.json` of an array says: the one layout that a store's arrays have, in two forms.

An array is one file, a chunk or a shard of chunks, and a chunk has the codecs bytes (little-endian), blosc and crc32c
(`capture/store/codecs.py` writes them). Another layout is refused; zarr-python reads it.

Numbers of the type float16 are probabilities x 2^15 (`schemas/precision.py`), and have the attribute `scale_factor`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from vla_attention.schemas.precision import HALF_SCALE
from vla_attention.schemas.stores.store_format import CorruptEpisode

_CODECS = ["bytes", "blosc", "crc32c"]
#: Blosc's own limit.
_MOST_CHUNK_BYTES = 2**31 - 1


@dataclass(frozen=True)
class ArrayMetadata:
    """What is known of an array.

    Attributes:
        shape: of the array.
        dtype: of its numbers, little-endian.
        chunk_shape: extents of what is decoded at once.
        shard_chunks: chunks in the array's file, which can be read alone; None where the file is one chunk.
        axes: names of the axes.
    """

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    chunk_shape: tuple[int, ...]
    shard_chunks: int | None
    axes: tuple[str, ...]

    @property
    def is_half(self) -> bool:
        """Whether the numbers are probabilities in float16."""
        return self.dtype == np.dtype("<f2")

    @property
    def read_dtype(self) -> np.dtype[Any]:
        """The type of the numbers as they are read."""
        return np.dtype(np.float32) if self.is_half else self.dtype

    @property
    def file(self) -> str:
        """The name of the array's only file in its folder."""
        return chunk_file(len(self.shape))

    @property
    def grid(self) -> tuple[int, ...]:
        """Number of chunks along each axis."""
        return tuple(-(-extent // part) for extent, part in zip(self.shape, self.chunk_shape, strict=True))

    def whole_chunks(self, first: int, stop: int) -> range:
        """The indices along the last axis of all chunks that hold some from `first` to `stop`."""
        of_chunk, length = self.chunk_shape[-1], self.shape[-1]
        return range(first // of_chunk * of_chunk, min(length, -(-stop // of_chunk) * of_chunk))


def chunk_file(axes: int) -> str:
    """The name of the only file of an array with so many axes, with the separator `.`."""
    return ".".join(["c", *["0"] * axes])


def array_metadata(document: Any) -> ArrayMetadata:
    """Read the `zarr.json` of an array.

    Raises:
        CorruptEpisode: it has another layout than a capture writes; the message says what, without a full stop.
    """
    try:
        shape, of_file, codecs = (
            document["shape"],
            document["chunk_grid"]["configuration"]["chunk_shape"],
            document["codecs"],
        )
        shard = codecs[0]["configuration"] if codecs[0]["name"] == "sharding_indexed" else None
        chunk = of_file if shard is None else shard["chunk_shape"]
        of_chunk = [codec["name"] for codec in (codecs if shard is None else shard["codecs"])]
        dtype = np.dtype(str(document["data_type"])).newbyteorder("<")
        are_extents = all(type(n) is int and n >= 0 for n in shape) and all(type(n) is int and n > 0 for n in chunk)
        if not are_extents or dtype.kind not in "fiu" or math.prod(chunk) * dtype.itemsize > _MOST_CHUNK_BYTES:
            raise ValueError(f"chunks of {chunk} numbers of the type {dtype} for the shape {shape}")
        # Extents of the shard in chunks; a remainder or several files make another layout.
        chunks = [divmod(extent, part) for extent, part in zip(of_file, chunk, strict=True)]
        one_file = all(extent <= most for extent, most in zip(shape, of_file, strict=True))
        if of_chunk != _CODECS or not one_file or any(rest for _, rest in chunks):
            raise ValueError(f"the codecs {of_chunk}, files of {of_file} and chunks of {chunk} for the shape {shape}")
        scale = document.get("attributes", {}).get("scale_factor")
        if scale != (HALF_SCALE if dtype == np.dtype("<f2") else None):
            raise ValueError(f"numbers of the type {dtype} with the scale_factor {scale}")
        return ArrayMetadata(
            tuple(shape),
            dtype,
            tuple(chunk),
            None if shard is None else math.prod(count for count, _ in chunks),
            tuple(document["dimension_names"]),
        )
    except (LookupError, TypeError, ValueError, AttributeError) as error:
        raise CorruptEpisode(f"its zarr.json is not that of an array of this format: {error}") from None
