"""An array's `zarr.json`, checked before anything believes it: shape, chunks, codecs and types that the format has.

zarr-python reads whatever a `zarr.json` says, and numpy and the codecs allocate what they are asked for. What no
capture writes is refused here: other codecs than those in `docs/store.md`, chunks of extent 0, more chunks than there
are files for, and arrays that would take more memory than their stored bytes can hold.
"""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from vla_attention.schemas.errors import listing, shortened
from vla_attention.schemas.limit_checks import check_decoded
from vla_attention.schemas.limits import ARRAY_AXES, ARRAY_BYTES
from vla_attention.schemas.stores.seal_content import FileRecord
from vla_attention.schemas.stores.store_format import CorruptEpisode

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
        shard_chunks: chunks in each file, which can be read alone; None where they cannot.
        codecs: those of a chunk, by name.
        endian: the order of bytes in a number; None where it is not stated.
        typesize: bytes that the codec blosc shuffles together.
        stored: bytes of the array's files, as the seal lists them.
    """

    document: dict[str, Any]
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    file_shape: tuple[int, ...]
    chunk_shape: tuple[int, ...]
    shard_chunks: int | None
    codecs: tuple[str, ...]
    endian: str | None
    typesize: int
    stored: int

    @property
    def is_sharded(self) -> bool:
        """Whether a file is a shard, of several chunks with an index."""
        return bool(self.document["codecs"][0]["name"] == "sharding_indexed")

    @property
    def has_default_keys(self) -> bool:
        """Whether the files of chunks have the names that `chunk_file` gives."""
        return bool(self.document["chunk_key_encoding"]["name"] == "default")

    def file(self, place: Sequence[int]) -> str:
        """The path of a chunk, or shard, in the array's folder; see `chunk_file`."""
        return chunk_file(self.document["chunk_key_encoding"], place)

    @property
    def chunk_bytes(self) -> int:
        """Decoded bytes of a chunk."""
        return math.prod(self.chunk_shape) * self.dtype.itemsize

    def check_reading(self, shape: tuple[int, ...]) -> None:
        """Raise `CorruptEpisode` when values of this shape would take more memory than the files can hold."""
        _check_decoded("it", math.prod(shape), self.dtype, self.stored)


def array_metadata(document: Any, shape: tuple[int, ...], name: str, files: Mapping[str, FileRecord]) -> ArrayMetadata:
    """Check the `zarr.json` of the array `name`.

    Args:
        document: what the file says.
        shape: the array's shape in the attributes of its episode.
        name: the array's path in the episode.
        files: the episode's files in its seal.

    Raises:
        CorruptEpisode: it is nothing that a capture writes; the message says what, without a full stop.
    """
    content = json.dumps(document)
    metadata = _described(content) if len(content) <= _KEPT_BYTES else describe_array(document)
    if metadata.shape != shape:
        raise CorruptEpisode("it has another shape than its attributes say")
    numbers = [
        record.size for file, record in files.items() if file.startswith(f"{name}/") and not file.endswith("/zarr.json")
    ]
    needed = math.prod(-(-extent // part) for extent, part in zip(shape, metadata.file_shape, strict=True))
    if needed > len(numbers):
        raise CorruptEpisode(f"it has {needed:,} files of chunks, and its seal lists {len(numbers):,}")
    _check_decoded("a chunk of it", math.prod(metadata.chunk_shape), metadata.dtype, max(numbers, default=0))
    return replace(metadata, stored=sum(numbers))


def describe_array(document: Any) -> ArrayMetadata:
    """What a `zarr.json` says, without what the seal says of the files."""
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
    shard_chunks, codecs = chunks_of_a_shard(document), document["codecs"]
    if codecs[0]["name"] == "sharding_indexed":
        codecs = codecs[0]["configuration"]["codecs"]
        if shard_chunks is None and any(codec["name"] == "blosc" for codec in codecs):
            raise CorruptEpisode("its shards hold compressed chunks without checksums, or have their index elsewhere")
    settings = {codec["name"]: _configuration(codec) for codec in codecs}
    endian, typesize = settings["bytes"].get("endian"), settings.get("blosc", {}).get("typesize", 1)
    return ArrayMetadata(
        document, shape, dtype, file_shape, chunk_shape, shard_chunks, tuple(settings), endian, typesize, stored=0
    )


@functools.lru_cache(maxsize=512)
def _described(content: str) -> ArrayMetadata:
    """`describe_array`; arrays of one run differ in the number of replans only, so that most are described already."""
    return describe_array(json.loads(content))


def chunks_of_a_shard(metadata: dict[str, Any]) -> int | None:
    """Number of chunks in each shard of an array, or None where single chunks of it cannot be bound to a seal.

    They can when every chunk ends with its crc32c, and the file with its index. `metadata` is the array's `zarr.json`;
    that of a group gives None, too.
    """
    try:
        codecs = metadata.get("codecs", [])
        if [codec["name"] for codec in codecs] != ["sharding_indexed"]:
            return None
        inner = codecs[0]["configuration"]
        shard = metadata["chunk_grid"]["configuration"]["chunk_shape"]
        bound = (
            inner["codecs"][-1]["name"] == "crc32c"
            and inner.get("index_location", "end") == "end"
            and [codec["name"] for codec in inner["index_codecs"]] == ["bytes", "crc32c"]
            and inner["index_codecs"][0]["configuration"]["endian"] == "little"
        )
        counts = [extent // chunk for extent, chunk in zip(shard, inner["chunk_shape"], strict=True)]
    except (AttributeError, IndexError, KeyError, TypeError, ValueError, ZeroDivisionError):
        return None  # whoever reads the array says what is wrong with it
    return math.prod(counts) if bound else None


def chunk_file(keys: Mapping[str, Any], place: Sequence[int]) -> str:
    """The path of a chunk, or shard, in its array's folder, from its place in the grid and the array's chunk keys.

    Raises:
        ValueError: the `chunk_key_encoding` of the array is another one than Zarr's default.
    """
    separator = keys.get("configuration", {}).get("separator", "/")
    if keys.get("name") != "default" or separator not in ("/", "."):
        raise ValueError(f"the chunk keys {dict(keys)} are not known")
    return str(separator).join(("c", *map(str, place)))


def _shape(given: Any, dtype: np.dtype[Any]) -> tuple[int, ...]:
    """The shape of an array, if numpy can have one of it."""
    whole = isinstance(given, list) and all(type(extent) is int and extent >= 0 for extent in given)
    if not whole or not 1 <= len(given) <= ARRAY_AXES or math.prod(given) * dtype.itemsize > ARRAY_BYTES:
        raise CorruptEpisode(
            f"its shape is {_shown(given)}; expected 1 to {ARRAY_AXES} axes of 0 or more, and {ARRAY_BYTES:,} bytes"
        )
    return tuple(given)


def _check_decoded(what: str, elements: int, dtype: np.dtype[Any], stored: int) -> None:
    try:
        check_decoded(what, elements * dtype.itemsize, stored)
    except ValueError as error:
        raise CorruptEpisode(str(error)) from None


def _check_keys(keys: Any) -> None:
    name = keys.get("name") if isinstance(keys, dict) else None
    configuration = keys.get("configuration", {}) if isinstance(keys, dict) else None
    separator = configuration.get("separator", "/") if isinstance(configuration, dict) else None
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
        index_codecs = _names(inner.get("index_codecs"))
        if index_codecs != _INDEX_CODECS:
            raise CorruptEpisode(
                f"the index of its shards has the codecs {listing(index_codecs)}; expected bytes and crc32c"
            )
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
    configuration = holder.get("configuration", {})
    return configuration if isinstance(configuration, dict) else {}


def _expected(names: tuple[str, ...]) -> str:
    return f"expected one of {listing(names)}"


def _shown(value: Any) -> str:
    return shortened(repr(value), 80)
