"""The codec chain of every array of a store, and its chunks and shards.

Only core codecs of Zarr v3 are used (bytes, blosc, crc32c, sharding_indexed), so that any Zarr v3 reader opens the
store, and every chunk has a checksum. `docs/store.md` gives the reasons and measurements.
`schemas/stores/array_metadata.py` says what else than the layouts of `create_rows` and `write_whole` is refused.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import zarr
from numcodecs import Blosc
from numpy.typing import NDArray
from zarr.codecs import BloscCodec, Crc32cCodec

from vla_attention.schemas.layout import SiteLayout
from vla_attention.schemas.precision import HALF_MANTISSA_BITS, HALF_SCALE, is_half

#: Decoded size of a chunk, about: large enough for the codec, small enough to read one layer quickly.
TARGET_CHUNK_BYTES = 2 << 20

#: Fewest keys of a chunk that has not all of them.
FEWEST_KEYS = 128

#: Chunks are named `c.0.0`: with the separator `/`, every axis would be a folder of its own.
CHUNK_KEYS: dict[str, Any] = {"name": "default", "configuration": {"separator": "."}}

#: Fill values, which zarr gives for a missing chunk, by kind of number. No stored float has this value. A stored byte
#: may, so readers of pictures must check that the chunk's file exists.
MISSING = {"f": float("nan"), "u": 0}


@dataclass(frozen=True)
class RowCodec:
    """How the rows of a precision are encoded.

    Attributes:
        dtype: of the stored numbers.
        shuffle: what is put side by side before lz4: bytes, or bits where rounding cleared some of them.
        scale: the attribute `scale_factor`, None without one.
    """

    dtype: str
    shuffle: Literal["shuffle", "bitshuffle"]
    scale: float | None = None

    @classmethod
    def of_bits(cls, bits: int) -> RowCodec:
        """Bytes are read twice as fast as bits, and float16 of ten mantissa bits has no bit that is always 0."""
        if is_half(bits):
            return cls("<f2", "shuffle" if bits == HALF_MANTISSA_BITS else "bitshuffle", HALF_SCALE)
        return cls("<f4", "bitshuffle")

    @property
    def itemsize(self) -> int:
        """Bytes of a number."""
        return np.dtype(self.dtype).itemsize

    @property
    def attributes(self) -> dict[str, Any]:
        """The attributes of the array."""
        return {} if self.scale is None else {"scale_factor": self.scale}

    def encode(self, values: NDArray[Any]) -> bytes:
        """A chunk as `create_rows` says that it is encoded, without the checksum that follows it."""
        shuffle = Blosc.SHUFFLE if self.shuffle == "shuffle" else Blosc.BITSHUFFLE
        encoded: bytes = Blosc(cname="lz4", clevel=5, shuffle=shuffle).encode(values)
        return encoded


def replans_per_block(bytes_per_replan: int, numbers_per_replan: int, count: int | None = None) -> int:
    """Replans in one chunk, for one layer and denoise step. count: of the episode, where it is known.

    The chunk's number of elements is a multiple of 8; Blosc leaves out its bit shuffle when it is not, without a word.
    """
    step = 8 // math.gcd(8, numbers_per_replan)
    most = max(1, TARGET_CHUNK_BYTES // max(1, bytes_per_replan))
    return step * math.ceil(min(most, count or most) / step)


def keys_per_chunk(layout: SiteLayout) -> int:
    """Keys in one chunk of rows: the most with which a question about words reads no pictures; all keys at worst.

    Every span but those in the last chunk begins with a chunk.
    """
    starts, last = [span.start for span in layout.spans], layout.num_keys - 1
    for length in range(last, FEWEST_KEYS - 1, -1):
        begin = all(start % length == 0 or start // length == last // length for start in starts)
        if begin and any(start >= length for start in starts):
            return length
    return layout.num_keys


def create_rows(
    group: zarr.Group, name: str, shape: tuple[int, ...], chunk: tuple[int, int], axes: Sequence[str], codec: RowCodec
) -> zarr.Array[Any]:
    """Create an array (replan, layer, denoise, ..., key) of one shard, whose file is written by `ShardWriter`.

    chunk: replans and keys in a chunk of one layer and one denoise step, so that an analysis of three layers does not
    read the others. A missing chunk reads as NaN, never as zeros that look like data.
    """
    replans, keys = chunk
    extents = (replans, 1, 1, *shape[3:-1], keys)
    if math.prod(extents) % 8:
        raise AssertionError(f"chunk {extents} is not a multiple of 8 elements: bit shuffle would be skipped")
    return group.create_array(
        name,
        shape=shape,
        dtype=codec.dtype,
        chunks=extents,
        shards=(replans * math.ceil(shape[0] / replans), *shape[1:-1], keys * math.ceil(shape[-1] / keys)),
        compressors=(
            BloscCodec(cname="lz4", clevel=5, shuffle=codec.shuffle, typesize=codec.itemsize),
            Crc32cCodec(),
        ),
        fill_value=float("nan"),
        chunk_key_encoding=CHUNK_KEYS,
        dimension_names=list(axes),
        attributes=codec.attributes,
    )


def entries_per_chunk(rest: tuple[int, ...], dtype: np.dtype[Any]) -> int:
    """Return the most entries of the first axis in one chunk of an array that is no array of rows."""
    return max(1, TARGET_CHUNK_BYTES // max(1, math.prod(rest) * dtype.itemsize))


def create_whole(
    group: zarr.Group, name: str, shape: tuple[int, ...], dtype: np.dtype[Any], axes: tuple[str, ...]
) -> zarr.Array[Any]:
    """Create an array that is one file: one chunk when it is small, else a shard of chunks along its first axis."""
    length = shape[0]
    chunk_length = max(1, min(length, entries_per_chunk(shape[1:], dtype)))
    rest = tuple(max(1, extent) for extent in shape[1:])
    return group.create_array(
        name,
        shape=shape,
        dtype=dtype,
        chunks=(chunk_length, *rest),
        shards=(chunk_length * math.ceil(length / chunk_length), *rest) if chunk_length < length else None,
        compressors=(
            BloscCodec(cname="zstd", clevel=3, shuffle="shuffle", typesize=dtype.itemsize),
            Crc32cCodec(),
        ),
        fill_value=MISSING[dtype.kind],
        chunk_key_encoding=CHUNK_KEYS,
        dimension_names=list(axes),
        # A chunk in which every number is the fill value is data, too.
        config={"write_empty_chunks": True},
    )


def encode_whole(chunk: NDArray[Any]) -> bytes:
    """A chunk as `create_whole` says that it is encoded, without the checksum that follows it."""
    encoded: bytes = Blosc(cname="zstd", clevel=3, shuffle=Blosc.SHUFFLE).encode(np.ascontiguousarray(chunk))
    return encoded


def write_whole(group: zarr.Group, name: str, values: NDArray[np.generic], axes: tuple[str, ...]) -> zarr.Array[Any]:
    """Write a complete array, as `create_whole` says."""
    array = create_whole(group, name, values.shape, values.dtype, axes)
    array[...] = values
    return array
