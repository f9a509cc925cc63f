"""An array's `zarr.json`, checked before anything believes it: shape, chunks, codecs and types that the format has.

zarr-python reads whatever a `zarr.json` says, and numpy and the codecs allocate what they are asked for. What no
capture writes is refused here: other codecs than those in `docs/store.md`, chunks of extent 0, more chunks than there
are files for, and arrays that would take more memory than their stored bytes can hold.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from vla_attention.schemas.documents import decode_json
from vla_attention.schemas.errors import listing, shortened
from vla_attention.schemas.limit_checks import check_decoded
from vla_attention.schemas.limits import ARRAY_AXES, ARRAY_BYTES
from vla_attention.schemas.stores.shards import CHECKSUM_BYTES, chunks_of_a_shard
from vla_attention.schemas.stores.store_format import CorruptEpisode, FileRecord

#: Types of numbers that a store holds.
TYPES = ("uint8", "int32", "int64", "float32", "float64")
#: Codecs of the format; all are in the core of Zarr v3.
CODECS = ("bytes", "blosc", "crc32c", "sharding_indexed")
_COMPRESSORS = ("lz4", "zstd")
#: Bytes of a `zarr.json` whose description is kept; real ones have up to 2 kB.
_KEPT_BYTES = 16_000
_INDEX_CODECS = ["bytes", "crc32c"]
#: Chains in which the codecs may stand. Captures write the first; without compression nothing expands.
_CHAINS = (["bytes", "blosc", "crc32c"], ["bytes", "blosc"], ["bytes", "crc32c"], ["bytes"])


@dataclass(frozen=True)
class ArrayMetadata:
    """What is known of an array whose `zarr.json` was checked.

    Attributes:
        document: the `zarr.json`, not to be changed.
        shape: of the array.
        dtype: of its numbers.
        file_shape: extents of what one file holds: a shard, or a chunk.
        chunk_shape: extents of what is decoded at once.
        shard_chunks: chunks in each file whose checksums the seal lists; None where it cannot.
        stored: bytes of the array's files, as the seal lists them.
    """

    document: dict[str, Any]
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    file_shape: tuple[int, ...]
    chunk_shape: tuple[int, ...]
    shard_chunks: int | None
    stored: int

    @property
    def chunk_bytes(self) -> int:
        """Decoded bytes of a chunk."""
        return math.prod(self.chunk_shape) * self.dtype.itemsize

    @property
    def typesize(self) -> int:
        """Bytes that the codec blosc shuffles together; the array has this codec."""
        codecs = self.document["codecs"]
        if codecs[0]["name"] == "sharding_indexed":
            codecs = codecs[0]["configuration"]["codecs"]
        size: int = codecs[1]["configuration"].get("typesize", 1)
        return size

    def check_reading(self, shape: tuple[int, ...]) -> None:
        """Raise `CorruptEpisode` when values of this shape would take more memory than the files can hold."""
        _check_decoded("it", math.prod(shape), self.dtype, self.stored)


def array_metadata(content: bytes, shape: tuple[int, ...], name: str, files: Mapping[str, FileRecord]) -> ArrayMetadata:
    """Check the `zarr.json` of the array `name`.

    Args:
        content: the bytes of the file.
        shape: the array's shape in the attributes of its episode.
        name: the array's path in the episode.
        files: the episode's files in its seal.

    Raises:
        CorruptEpisode: it is nothing that a capture writes; the message says what, without a full stop.
    """
    found = _described(content) if len(content) <= _KEPT_BYTES else _describe(content)
    if found.shape != shape:
        raise CorruptEpisode("it has another shape than its attributes say")
    numbers = [record.size for file, record in files.items() if file.startswith(f"{name}/") and _is_chunk(file)]
    needed = math.prod(-(-extent // part) for extent, part in zip(shape, found.file_shape, strict=True))
    if needed > len(numbers):
        raise CorruptEpisode(f"it has {needed:,} files of chunks, and its seal lists {len(numbers):,}")
    _check_decoded("a chunk of it", math.prod(found.chunk_shape), found.dtype, max(numbers, default=0))
    return replace(found, stored=sum(numbers))


def _describe(content: bytes) -> ArrayMetadata:
    """What a `zarr.json` says, without what the seal says of the files."""
    try:
        document = decode_json(content)
    except ValueError as error:
        raise CorruptEpisode(f"its zarr.json is damaged ({error})") from None
    if not isinstance(document, dict) or (document.get("zarr_format"), document.get("node_type")) != (3, "array"):
        raise CorruptEpisode("its zarr.json does not describe an array of Zarr format 3")
    if document.get("data_type") not in TYPES:
        raise CorruptEpisode(f"its numbers are of the type {_shown(document.get('data_type'))}; {_expected(TYPES)}")
    if document.get("storage_transformers"):
        raise CorruptEpisode("its zarr.json names storage transformers, of which the format has none")
    _check_keys(document.get("chunk_key_encoding"))
    dtype = np.dtype(document["data_type"])
    shape = _shape(document.get("shape"), dtype)
    grid = document.get("chunk_grid")
    if not isinstance(grid, dict) or grid.get("name") != "regular":
        raise CorruptEpisode("its chunk_grid is not regular")
    file_shape = _extents(_configuration(grid).get("chunk_shape"), shape, "chunks")
    chunk_shape = _check_codecs(document.get("codecs"), file_shape, sharded=True) or file_shape
    shard_chunks = chunks_of_a_shard(document)
    sharded = document["codecs"][0]["name"] == "sharding_indexed"
    if sharded and shard_chunks is None and "blosc" in inner_codecs(document):
        raise CorruptEpisode("its shards hold compressed chunks without checksums, or have their index elsewhere")
    return ArrayMetadata(document, shape, dtype, file_shape, chunk_shape, shard_chunks, 0)


#: Arrays of one run differ in the number of replans only: most are described already.
_described = functools.lru_cache(maxsize=512)(_describe)


def inner_codecs(document: Mapping[str, Any]) -> list[str]:
    """The names of the codecs of a chunk, of a checked `zarr.json`."""
    codecs = document["codecs"]
    if codecs[0]["name"] == "sharding_indexed":
        codecs = codecs[0]["configuration"]["codecs"]
    return [codec["name"] for codec in codecs]


def check_shard(metadata: ArrayMetadata, record: FileRecord, file: str) -> None:
    """Raise `CorruptEpisode` unless the seal lists as many checksums as a shard has chunks."""
    listed = len(record.chunks) // (2 * CHECKSUM_BYTES)
    if listed and listed != metadata.shard_chunks:
        raise CorruptEpisode(f"its {file} has {metadata.shard_chunks} chunks, and its seal lists {listed}")


def _shape(given: Any, dtype: np.dtype[Any]) -> tuple[int, ...]:
    """The shape of an array, if numpy can have one of it."""
    whole = isinstance(given, list) and all(type(extent) is int and extent >= 0 for extent in given)
    if not whole or not 1 <= len(given) <= ARRAY_AXES or math.prod(given) * dtype.itemsize > ARRAY_BYTES:
        raise CorruptEpisode(
            f"its shape is {_shown(given)}; expected 1 to {ARRAY_AXES} axes of 0 or more, and {ARRAY_BYTES:,} bytes"
        )
    return tuple(given)


def _is_chunk(file: str) -> bool:
    return not file.endswith("/zarr.json")


def _check_decoded(what: str, elements: int, dtype: np.dtype[Any], stored: int) -> None:
    try:
        check_decoded(what, elements * dtype.itemsize, stored)
    except ValueError as error:
        raise CorruptEpisode(str(error)) from None


def _check_keys(keys: Any) -> None:
    name = keys.get("name") if isinstance(keys, dict) else None
    separator = _configuration(keys).get("separator", "/") if isinstance(keys, dict) else None
    if name not in ("default", "v2") or separator not in ("/", "."):
        raise CorruptEpisode(f"its chunk_key_encoding is {_shown(keys)}; expected 'default' with '/' or '.'")


def _check_codecs(codecs: Any, shape: tuple[int, ...], *, sharded: bool) -> tuple[int, ...] | None:
    """Check a chain of codecs; returns the extents of a shard's chunks, None without a shard."""
    names = _names(codecs)
    unknown = [codec for codec in names if codec not in CODECS]
    if unknown or not names:
        given = f"the codec {_shown(unknown[0])}" if unknown else "no codecs"
        raise CorruptEpisode(f"it has {given}; {_expected(CODECS)}")
    if names == ["sharding_indexed"] and sharded:
        inner = _configuration(codecs[0])
        chunk = _extents(inner.get("chunk_shape"), shape, "chunks")
        if any(extent % part for extent, part in zip(shape, chunk, strict=True)):
            raise CorruptEpisode(f"its chunks of {_shown(chunk)} do not divide its shards of {_shown(shape)}")
        found = _names(inner.get("index_codecs"))
        if found != _INDEX_CODECS:
            raise CorruptEpisode(f"the index of its shards has the codecs {listing(found)}; expected bytes and crc32c")
        _check_codecs(inner.get("codecs"), chunk, sharded=False)
        return chunk
    if names not in _CHAINS:
        raise CorruptEpisode(f"it has the codecs {listing(names)}; expected bytes, blosc and crc32c, in this order")
    for codec in codecs:
        if codec["name"] == "blosc":
            _check_blosc(_configuration(codec))
    return None


def _names(codecs: Any) -> list[Any]:
    """The names of a chain of codecs; empty where it is none."""
    if not _is_list(codecs):
        return []
    return [codec.get("name") if isinstance(codec, dict) else None for codec in codecs]


def _check_blosc(settings: Mapping[str, Any]) -> None:
    compressor, typesize = settings.get("cname"), settings.get("typesize", 1)
    if compressor not in _COMPRESSORS:
        raise CorruptEpisode(f"it is compressed by {_shown(compressor)}; {_expected(_COMPRESSORS)}")
    if type(typesize) is not int or not 1 <= typesize <= 8:
        raise CorruptEpisode(f"its codec blosc has the typesize {_shown(typesize)}; expected 1 to 8")


def _extents(given: Any, of: tuple[int, ...], what: str) -> tuple[int, ...]:
    """The extents of chunks or shards, one for each axis."""
    if not _is_list(given) or any(type(extent) is not int or not 1 <= extent <= ARRAY_BYTES for extent in given):
        raise CorruptEpisode(f"its {what} have the extents {_shown(given)}; expected whole numbers from 1")
    if len(given) != len(of):
        raise CorruptEpisode(f"its {what} have {len(given)} axes; expected {len(of)}")
    return tuple(given)


def _is_list(given: Any) -> bool:
    return isinstance(given, list) and len(given) <= ARRAY_AXES


def _configuration(holder: Mapping[str, Any]) -> Mapping[str, Any]:
    found = holder.get("configuration", {})
    return found if isinstance(found, dict) else {}


def _expected(names: tuple[str, ...]) -> str:
    return f"expected one of {listing(names)}"


def _shown(value: Any) -> str:
    return shortened(repr(value), 80)
