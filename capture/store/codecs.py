"""The codec chain of every array of a store, and its chunks and shards.

Only core codecs of Zarr v3 are used (bytes, blosc, crc32c, sharding_indexed), so that any Zarr v3 reader opens the
store, and every chunk has a checksum. `docs/store.md` gives the reasons and measurements.
`schemas/stores/array_metadata.py` says what else than the layouts of `create_rows` and `write_whole` is refused.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import zarr
from numcodecs import Blosc
from numpy.typing import NDArray
from zarr.codecs import BloscCodec, Crc32cCodec

#: Decoded size of a chunk, about: large enough for the codec, small enough to read one layer quickly.
TARGET_CHUNK_BYTES = 2 << 20

#: Chunks are named `c.0.0`: with the separator `/`, every axis would be a folder of its own.
CHUNK_KEYS: dict[str, Any] = {"name": "default", "configuration": {"separator": "."}}

#: The codec of rows, for zarr, which keeps it in the array's metadata, and for numcodecs, which encodes the chunks.
_ROWS = BloscCodec(cname="lz4", clevel=5, shuffle="bitshuffle", typesize=4)
_ROW_ENCODER = Blosc(cname="lz4", clevel=5, shuffle=Blosc.BITSHUFFLE)

#: Fill values, which zarr gives for a missing chunk, by kind of number. No stored float has this value. A stored byte
#: may, so readers of pictures must check that the chunk's file exists.
MISSING = {"f": float("nan"), "u": 0}


def replans_per_block(bytes_per_replan: int, count: int | None = None) -> int:
    """Replans in one chunk, for one layer and denoise step. count: of the episode, where it is known.

    The chunk's number of elements is a multiple of 8; Blosc leaves out its bit shuffle when it is not, without a word.
    """
    step = 8 // math.gcd(8, bytes_per_replan // 4)
    most = max(1, TARGET_CHUNK_BYTES // max(1, bytes_per_replan))
    return step * math.ceil(min(most, count or most) / step)


def create_rows(
    group: zarr.Group, name: str, shape: tuple[int, ...], block: int, axes: Sequence[str]
) -> zarr.Array[Any]:
    """Create a float32 array (replan, layer, denoise, ...) of one shard, whose file is written by `ShardWriter`.

    A chunk holds `block` replans of one layer and one denoise step, so that an analysis of three layers does not read
    the others. A missing chunk reads as NaN, never as zeros that look like data.
    """
    chunk = (block, 1, 1, *shape[3:])
    if math.prod(chunk) % 8:
        raise AssertionError(f"chunk {chunk} is not a multiple of 8 elements: bit shuffle would be skipped")
    return group.create_array(
        name,
        shape=shape,
        dtype="float32",
        chunks=chunk,
        shards=(block * math.ceil(shape[0] / block), *shape[1:]),
        compressors=(_ROWS, Crc32cCodec()),
        fill_value=float("nan"),
        chunk_key_encoding=CHUNK_KEYS,
        dimension_names=list(axes),
    )


def encode_row_chunk(values: NDArray[np.float32]) -> bytes:
    """A chunk of rows as the Blosc codec of `create_rows` encodes it, without the checksum that follows it."""
    encoded: bytes = _ROW_ENCODER.encode(values)
    return encoded


def write_whole(group: zarr.Group, name: str, values: NDArray[np.generic], axes: Sequence[str]) -> zarr.Array[Any]:
    """Write a complete array as one file: one chunk when it is small, else a shard of chunks along its first axis."""
    length = values.shape[0]
    chunk_length = max(
        1, min(length, TARGET_CHUNK_BYTES // max(1, math.prod(values.shape[1:]) * values.dtype.itemsize))
    )
    rest = tuple(max(1, extent) for extent in values.shape[1:])
    array = group.create_array(
        name,
        shape=values.shape,
        dtype=values.dtype,
        chunks=(chunk_length, *rest),
        shards=(chunk_length * math.ceil(length / chunk_length), *rest) if chunk_length < length else None,
        compressors=(
            BloscCodec(cname="zstd", clevel=3, shuffle="shuffle", typesize=values.dtype.itemsize),
            Crc32cCodec(),
        ),
        fill_value=MISSING[values.dtype.kind],
        chunk_key_encoding=CHUNK_KEYS,
        dimension_names=list(axes),
        # A chunk in which every number is the fill value is data, too.
        config={"write_empty_chunks": True},
    )
    array[...] = values
    return array
