"""How arrays are laid out in an episode's group: codecs, chunks and shards of the Zarr v3 store.

Only core codecs are used (bytes, blosc, crc32c, sharding_indexed), so that any Zarr v3 reader opens the store, and every
chunk carries a checksum. The reasons behind each choice are measured facts of `docs/store.md`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import zarr
from numpy.typing import NDArray
from zarr.codecs import BloscCodec, Crc32cCodec

#: Decoded size that a chunk of rows aims at: large enough for the codec, small enough to read one layer quickly.
TARGET_CHUNK_BYTES = 2 << 20


#: What a missing chunk reads as, by kind of number. None of these occurs in floats and signed integers that are stored; of
#: unsigned arrays, key roles never are 0, and pictures are only known to be complete by their digest.
MISSING = {"f": float("nan"), "i": -1, "u": 0}


def replans_per_block(bytes_per_replan: int, max_replans: int) -> int:
    """Replans in one chunk, for one layer and denoise step.

    A multiple of 8: Blosc silently skips its bit shuffle when a chunk's number of elements is not one.
    """
    wanted = max(1, TARGET_CHUNK_BYTES // max(1, bytes_per_replan))
    return 8 * math.ceil(min(wanted, max_replans) / 8)


def create_blocked(
    group: zarr.Group, name: str, shape: tuple[int, ...], block: int, axes: Sequence[str], one_chunk: bool = False
) -> zarr.Array:
    """Create a float32 array that grows along replans by whole shards of `block` replans.

    A chunk holds one layer and one denoise step (so that an analysis of three layers does not read the others), or with
    `one_chunk` everything of the block. A missing chunk reads as NaN, never as zeros that look like data.
    """
    shard = (block, *shape[1:])
    chunk = shard if one_chunk else (block, 1, 1, *shape[3:])
    if math.prod(chunk) % 8:
        raise AssertionError(f"chunk {chunk} is not a multiple of 8 elements: bit shuffle would be skipped")
    return group.create_array(
        name,
        shape=shape,
        dtype="float32",
        chunks=chunk,
        shards=shard,
        compressors=(BloscCodec(cname="lz4", clevel=5, shuffle="bitshuffle", typesize=4), Crc32cCodec()),
        fill_value=float("nan"),
        dimension_names=list(axes),
        config={"write_empty_chunks": True},
    )


def write_whole(group: zarr.Group, name: str, values: NDArray[np.generic], axes: Sequence[str]) -> zarr.Array:
    """Write a complete array in one go: one shard, one chunk per eight replans of pictures, one chunk otherwise."""
    pictures = values.ndim == 4
    chunk = (min(8, values.shape[0]), *values.shape[1:]) if pictures else values.shape
    shard = (chunk[0] * math.ceil(values.shape[0] / chunk[0]), *values.shape[1:]) if pictures else None
    array = group.create_array(
        name,
        shape=values.shape,
        dtype=values.dtype,
        chunks=chunk,
        shards=shard,
        compressors=(
            BloscCodec(cname="zstd", clevel=3, shuffle="shuffle", typesize=values.dtype.itemsize),
            Crc32cCodec(),
        ),
        fill_value=MISSING[values.dtype.kind],
        dimension_names=list(axes),
        # A chunk that happens to hold only the fill value is data, too.
        config={"write_empty_chunks": True},
    )
    array[...] = values
    return array
