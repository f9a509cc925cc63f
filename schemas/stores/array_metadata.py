"""What the `zarr.json` of an array may say: the one layout that a store's arrays have, in two forms.

An array is one file, a chunk or a shard of chunks, and a chunk has the codecs bytes (little-endian), blosc and crc32c
(`capture/store/codecs.py` writes them). Whatever else Zarr knows is refused, before anything takes memory for it.
"""

from __future__ import annotations

import functools
import json
import math
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from msgspec import Meta

from vla_attention.schemas.jsonable import Document, MalformedDocument, from_json
from vla_attention.schemas.limits import ARRAY_AXES, ARRAY_BYTES
from vla_attention.schemas.stores.store_format import CorruptEpisode

#: Bytes of the `zarr.json` of an array; real ones have up to 2 kB.
_MOST_BYTES = 16_000
Extents = Annotated[list[Annotated[int, Meta(ge=1, le=ARRAY_BYTES)]], Meta(min_length=1, max_length=ARRAY_AXES)]


class _Endian(Document, frozen=True):
    endian: Literal["little"]


class _Bytes(Document, frozen=True, tag_field="name", tag="bytes"):
    configuration: _Endian | None = None  # numbers of one byte have no order


class _BloscSettings(Document, frozen=True):
    typesize: Annotated[int, Meta(ge=1, le=8)]
    cname: Literal["lz4", "zstd"]
    clevel: Annotated[int, Meta(ge=0, le=9)]
    shuffle: Literal["noshuffle", "shuffle", "bitshuffle"]
    blocksize: Annotated[int, Meta(ge=0, le=ARRAY_BYTES)]


class _Blosc(Document, frozen=True, tag_field="name", tag="blosc"):
    configuration: _BloscSettings


class _Crc32c(Document, frozen=True, tag_field="name", tag="crc32c"):
    pass


class _ShardSettings(Document, frozen=True):
    chunk_shape: Extents
    codecs: tuple[_Bytes, _Blosc, _Crc32c]
    index_codecs: tuple[_Bytes, _Crc32c]
    index_location: Literal["end"]


class _Shard(Document, frozen=True, tag_field="name", tag="sharding_indexed"):
    configuration: _ShardSettings


class _ChunkShape(Document, frozen=True):
    chunk_shape: Extents


class _Grid(Document, frozen=True, tag_field="name", tag="regular"):
    configuration: _ChunkShape


class _Separator(Document, frozen=True):
    separator: Literal["."]


class _Keys(Document, frozen=True, tag_field="name", tag="default"):
    configuration: _Separator


class _Array(Document, frozen=True):
    """The `zarr.json` of an array; `codecs` are those of a file."""

    zarr_format: Literal[3]
    node_type: Literal["array"]
    shape: Annotated[list[Annotated[int, Meta(ge=0)]], Meta(min_length=1, max_length=ARRAY_AXES)]
    data_type: Literal["uint8", "int32", "int64", "float32", "float64"]
    chunk_grid: _Grid
    chunk_key_encoding: _Keys
    fill_value: Any
    codecs: list[_Bytes | _Blosc | _Crc32c | _Shard]
    dimension_names: list[str]
    attributes: dict[str, Any]
    storage_transformers: tuple[()] = ()  # other versions of zarr-python leave it out


@dataclass(frozen=True)
class ArrayMetadata:
    """What is known of an array whose `zarr.json` was checked.

    Attributes:
        shape: of the array.
        dtype: of its numbers, little-endian.
        chunk_shape: extents of what is decoded at once.
        shard_chunks: chunks in the array's file, which can be read alone; None where the file is one chunk.
        typesize: bytes that the codec blosc shuffles together.
        axes: names of the axes.
    """

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    chunk_shape: tuple[int, ...]
    shard_chunks: int | None
    typesize: int
    axes: tuple[str, ...]

    @property
    def file(self) -> str:
        """The name of the array's only file in its folder."""
        return chunk_file(len(self.shape))

    @property
    def grid(self) -> tuple[int, ...]:
        """Number of chunks along each axis."""
        return tuple(-(-extent // part) for extent, part in zip(self.shape, self.chunk_shape, strict=True))

    @property
    def chunk_bytes(self) -> int:
        """Decoded bytes of a chunk."""
        return math.prod(self.chunk_shape) * self.dtype.itemsize


def chunk_file(axes: int) -> str:
    """The name of the only file of an array with so many axes, with the separator `.`."""
    return ".".join(["c", *["0"] * axes])


def array_metadata(document: Any) -> ArrayMetadata:
    """Check the `zarr.json` of an array.

    Raises:
        CorruptEpisode: it is nothing that a capture writes; the message says what, without a full stop.
    """
    content = json.dumps(document)
    if len(content) > _MOST_BYTES:
        raise CorruptEpisode(f"its zarr.json has {len(content):,} bytes; expected at most {_MOST_BYTES:,}")
    return _described(content)


@functools.lru_cache(maxsize=512)
def _described(content: str) -> ArrayMetadata:
    """Arrays of one run differ in the number of replans only, so that most are described already."""
    try:
        array = from_json(_Array, json.loads(content))
        if [type(codec) for codec in array.codecs] not in ([_Shard], [_Bytes, _Blosc, _Crc32c]):
            raise MalformedDocument("$.codecs: expected bytes, blosc and crc32c, or a shard of them")
    except MalformedDocument as error:
        raise CorruptEpisode(
            f"its zarr.json is not that of an array of this format: {str(error).rstrip('.')}"
        ) from None
    shape, of_file, dtype = array.shape, array.chunk_grid.configuration.chunk_shape, np.dtype(array.data_type)
    if math.prod(shape) * dtype.itemsize > ARRAY_BYTES:
        raise CorruptEpisode(f"its shape is {tuple(shape)}; expected at most {ARRAY_BYTES:,} bytes")
    shard = array.codecs[0].configuration if isinstance(array.codecs[0], _Shard) else None
    chunk = of_file if shard is None else shard.chunk_shape
    for what, extents in (("chunks", chunk), ("file", of_file), ("axes", array.dimension_names)):
        if len(extents) != len(shape):
            raise CorruptEpisode(f"its {what} have {len(extents)} axes; expected {len(shape)}")
    if any(extent % part for extent, part in zip(of_file, chunk, strict=True)):
        raise CorruptEpisode(f"its chunks of {chunk} do not divide its shard of {of_file}")
    if any(extent > part for extent, part in zip(shape, of_file, strict=True)):
        raise CorruptEpisode(f"its file holds {of_file} of {shape} numbers; expected one file")
    blosc = array.codecs[1] if shard is None else shard.codecs[1]
    assert isinstance(blosc, _Blosc)
    chunks = None if shard is None else math.prod(extent // part for extent, part in zip(of_file, chunk, strict=True))
    return ArrayMetadata(
        tuple(shape),
        dtype.newbyteorder("<"),
        tuple(chunk),
        chunks,
        blosc.configuration.typesize,
        tuple(array.dimension_names),
    )
