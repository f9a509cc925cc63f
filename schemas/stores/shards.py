"""Reading arrays without zarr-python: those that are one chunk in one file, and single chunks of a shard's file.

A shard is a file of compressed chunks, with an index of their positions at its end (Zarr's `sharding_indexed` codec).
zarr-python reads it through an event loop, and passing the chunks between threads takes as long as decoding them; an
analysis of words reads thousands of chunks, and opens hundreds of episodes with several small arrays each.
`ShardedLayers` handles the layout of rows, and `SingleChunk` that of most other arrays, as `create_rows` and
`write_whole` of `capture/store/codecs.py` write them. An array of any other layout is read with zarr-python.

Nothing that a file says is believed: the index and the checksum of each chunk are compared with the episode's seal, the
chunk with its checksum, positions with the file's size, and the header of each compressed chunk with the size of the
decoded one. A frame of Blosc that says it holds fewer bytes than the chunk would otherwise leave the rest of the buffer
as it was: bytes of the process, which would pass for attention.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vla_attention.schemas.cached_property import cached_property
from vla_attention.schemas.limit_checks import TooLarge, check_decoded
from vla_attention.schemas.limits import WHOLE_FILE_BYTES
from vla_attention.schemas.stores.array_metadata import ArrayMetadata
from vla_attention.schemas.stores.byte_source import ByteSource, Memory
from vla_attention.schemas.stores.digest import CHECKSUM_BYTES, bytes_digest, crc32c
from vla_attention.schemas.stores.remote_source import RemoteFailure
from vla_attention.schemas.stores.seal_content import FileRecord
from vla_attention.schemas.stores.store_format import CorruptEpisode

_ABSENT = np.uint64(2**64 - 1)
#: The header of a Blosc frame: format, version of the codec, flags, typesize; decoded bytes, bytes of a block, bytes of
#: the frame (c-blosc, README_CHUNK_FORMAT.rst).
_BLOSC_HEADER = struct.Struct("<BBBBIII")


def index_size(chunks: int) -> int:
    """Bytes of a shard's index of that many chunks, with its checksum."""
    return 16 * chunks + CHECKSUM_BYTES


def read_index(stored: bytes, file_size: int) -> NDArray[np.uint64]:
    """Offset and length of every chunk, shape (chunk, 2), from the bytes of the index; (0, 0): not written.

    Raises:
        CorruptEpisode: the checksum does not fit, or the chunks overlap or reach beyond the file's chunks.
    """
    content, checksum = stored[:-CHECKSUM_BYTES], stored[-CHECKSUM_BYTES:]
    if crc32c(content) != int.from_bytes(checksum, "little"):
        raise CorruptEpisode("the checksum of its index does not fit")
    index = np.frombuffer(content, dtype="<u8").reshape(-1, 2).copy()
    index[(index == _ABSENT).all(axis=1)] = 0
    written = index[index[:, 1] > 0]
    written = written[np.argsort(written[:, 0])]
    end = np.uint64(file_size - len(stored))
    # Compared without adding: a sum of large numbers would wrap around.
    inside = (written[:, 0] <= end).all() and (written[:, 1] <= end - np.minimum(written[:, 0], end)).all()
    if not inside or (written[:-1, 0] + written[:-1, 1] > written[1:, 0]).any():
        raise CorruptEpisode("its index names chunks that overlap or lie outside of the file")
    return index


@dataclass(frozen=True)
class SealedShard:
    """One shard's file, whose size and index agree with the seal.

    Attributes:
        source: where the episode's files are.
        file: the shard's path there.
        index_bytes: the index as it is stored, with its checksum.
        index: offset and length of each chunk, shape (chunk, 2); (0, 0): not written.
        checksums: the last `CHECKSUM_BYTES` of each chunk, from the seal.
    """

    source: ByteSource
    file: str
    index_bytes: bytes
    index: NDArray[np.uint64]
    checksums: bytes

    @classmethod
    def open(cls, source: ByteSource, file: str, record: FileRecord, chunks: int) -> SealedShard:
        """Read the index of so many chunks.

        Raises:
            CorruptEpisode: it is not the one in the seal.
            OSError: the file cannot be read.
        """
        size, checksums = index_size(chunks), bytes.fromhex(record.chunks)
        if len(checksums) != CHECKSUM_BYTES * chunks:
            raise CorruptEpisode(
                f"its {file} has {chunks} chunks, and its seal lists {len(checksums) // CHECKSUM_BYTES}", file
            )
        if record.size < size:
            raise CorruptEpisode(f"its {file} has {record.size} bytes in the seal, and an index of {size}", file)
        # One byte more: a file that has grown is not the one that was sealed.
        stored, more = source.parts(file, max(0, record.size - size), (size, 1))
        if len(stored) != size or more:
            raise CorruptEpisode(f"its {file} does not agree with its seal: it has another size", file)
        if bytes_digest(stored) != record.index:
            raise CorruptEpisode(f"its {file} does not agree with its seal: its index was changed", file)
        try:
            return cls(source, file, stored, read_index(stored, record.size), checksums)
        except CorruptEpisode as error:
            raise CorruptEpisode(f"its {file} cannot be read: {error}", file) from None

    def longest(self) -> int:
        """Bytes of the longest chunk, with its checksum."""
        return int(self.index[:, 1].max(initial=0))

    def stored(self) -> int:
        """Bytes of all chunks."""
        return int(self.index[:, 1].sum())

    def chunk(self, number: int, memory: Memory | None = None) -> Memory:
        """The encoded bytes of one chunk, without the checksum that follows them in the file.

        memory: as much as the `longest` chunk takes, for the result; new memory without. To be given new memory for
        half a megabyte takes longer than to read it from the system's cache.

        Raises:
            CorruptEpisode: the chunk is missing, or its checksum is another one than in the seal or than that of its
                bytes.
        """
        offset, length = (int(value) for value in self.index[number])
        if length <= CHECKSUM_BYTES:
            raise CorruptEpisode(f"its {self.file} lacks chunk {number}: it is missing", self.file)
        stored = np.empty(length, np.uint8) if memory is None else memory[:length]
        try:
            count = self.source.read_into(stored, self.file, offset)
        except RemoteFailure:
            raise
        except OSError as error:
            raise CorruptEpisode(f"its {self.file} cannot be read: {error.strerror or error}", self.file) from None
        if problem := self.problem(number, stored[:count]):
            raise CorruptEpisode(problem, self.file)
        return stored[:-CHECKSUM_BYTES]

    def problem(self, number: int, stored: Memory) -> str | None:
        """What is wrong with the bytes of a chunk and its checksum, or None."""
        if len(stored) != self.index[number, 1]:
            return f"its {self.file} ends in chunk {number}"
        if stored[-CHECKSUM_BYTES:].tobytes() != self.checksum(number):
            return f"chunk {number} of its {self.file} does not agree with its seal"
        if crc32c(stored[:-CHECKSUM_BYTES]) != int.from_bytes(self.checksum(number), "little"):
            return f"the checksum of chunk {number} of its {self.file} does not fit"
        return None

    def checksum(self, number: int) -> bytes:
        """The checksum of one chunk, from the seal."""
        return self.checksums[CHECKSUM_BYTES * number : CHECKSUM_BYTES * (number + 1)]


def check_blosc_frame(frame: bytes | memoryview, decoded_bytes: int, typesize: int) -> None:
    """Raise `CorruptEpisode` unless a Blosc frame says of itself what is known of it: its own size and the decoded one.

    c-blosc trusts the header: it reads and writes as many bytes as that says.
    """
    if len(frame) < _BLOSC_HEADER.size:
        raise CorruptEpisode("it is too short for a Blosc frame")
    *_, stored_typesize, nbytes, blocksize, cbytes = _BLOSC_HEADER.unpack_from(frame)
    for what, given, expected in (
        ("decoded bytes", nbytes, decoded_bytes),
        ("encoded bytes", cbytes, len(frame)),
        ("bytes a number", stored_typesize, typesize),
    ):
        if given != expected:
            raise CorruptEpisode(f"its header says {given} {what}; expected {expected}")
    if not 0 < blocksize <= max(decoded_bytes, typesize):
        raise CorruptEpisode(f"its header says blocks of {blocksize} bytes; expected 1 to {decoded_bytes}")


def _decode(frame: bytes | memoryview, values: NDArray[Any], typesize: int, what: str, file: str) -> None:
    """Decode a chunk into memory of its size; `CorruptEpisode`, which begins with `what`, where it is another's."""
    from numcodecs import blosc

    try:
        check_blosc_frame(frame, values.nbytes, typesize)
        blosc.decompress(frame, values)
    except (CorruptEpisode, RuntimeError, ValueError) as error:
        raise CorruptEpisode(f"{what} cannot be decoded: {error}", file) from None


#: The codecs of a chunk that are handled here.
_CODECS = ("bytes", "blosc", "crc32c")


@dataclass(frozen=True)
class SingleChunk:
    """An array that is one chunk in one file, read when it is indexed.

    Attributes:
        whole: gives all bytes of the file, compared with the seal.
        file: path of the array's file in the episode.
        metadata: of the array.
    """

    whole: Callable[[str, int], bytes]
    file: str
    metadata: ArrayMetadata

    @classmethod
    def of(cls, metadata: ArrayMetadata, whole: Callable[[str, int], bytes], name: str) -> SingleChunk | None:
        """The array `name`, or None when it has another layout."""
        known = (
            not metadata.is_sharded
            and metadata.file_shape == metadata.shape
            and metadata.codecs == _CODECS
            and metadata.endian in (None, "little")
            and metadata.has_default_keys
        )
        return cls(whole, f"{name}/{metadata.file((0,) * len(metadata.shape))}", metadata) if known else None

    def __getitem__(self, index: Any) -> NDArray[Any]:
        """Values at a numpy index; raises `CorruptEpisode` for other bytes than were sealed, and for other sizes."""
        content = self.whole(self.file, WHOLE_FILE_BYTES)
        frame, checksum = content[:-CHECKSUM_BYTES], content[-CHECKSUM_BYTES:]
        if crc32c(frame) != int.from_bytes(checksum, "little"):
            raise CorruptEpisode(f"the checksum of its {self.file} does not fit", self.file)
        values = np.empty(self.metadata.shape, self.metadata.dtype.newbyteorder("<"))
        _decode(frame, values, self.metadata.typesize, f"its {self.file}", self.file)
        selected: NDArray[Any] = values[index]
        return selected


@dataclass(frozen=True)
class LayerMemory:
    """Memory for `ShardedLayers.read`, used again for every layer and denoise step.

    Attributes:
        values: whole chunks of one layer and denoise step, (replans of all chunks, ...).
        chunk: bytes of a chunk as it is stored.
    """

    values: NDArray[np.float32]
    chunk: Memory


@dataclass(frozen=True)
class ShardedLayers:
    """A float32 array (replan, layer, denoise, ...) whose chunks hold one layer and one denoise step each.

    Attributes:
        metadata: of the array.
        shard: gives the shard in a file of the array, by its path in the array.
    """

    metadata: ArrayMetadata
    shard: Callable[[str], SealedShard]

    @classmethod
    def of(cls, metadata: ArrayMetadata, shard_in: Callable[[str], SealedShard]) -> ShardedLayers | None:
        """The array's reader, or None when it has another layout."""
        shape = metadata.shape
        known = (
            metadata.shard_chunks is not None
            and len(shape) >= 4
            and metadata.dtype == np.float32
            and metadata.file_shape[1:] == shape[1:]
            and metadata.chunk_shape[1:] == (1, 1, *shape[3:])
            and metadata.codecs == _CODECS
            and metadata.endian == "little"
            and metadata.has_default_keys
        )
        return cls(metadata, shard_in) if known else None

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the array."""
        return self.metadata.shape

    @property
    def block(self) -> int:
        """Extent of a chunk along the replans."""
        return self.metadata.chunk_shape[0]

    @property
    def blocks_per_shard(self) -> int:
        """How many chunks along the replans a file has."""
        return self.metadata.file_shape[0] // self.block

    @property
    def num_blocks(self) -> int:
        """How many chunks a layer and denoise step has."""
        return -(-self.shape[0] // self.block)

    @cached_property
    def _shards(self) -> tuple[SealedShard, ...]:
        rest = (0,) * (len(self.shape) - 1)
        count = -(-self.num_blocks // self.blocks_per_shard)
        return tuple(self.shard(self.metadata.file((i, *rest))) for i in range(count))

    def memory(self) -> LayerMemory:
        """Memory for `read`; raises `CorruptEpisode` for more than the shards can hold."""
        shape = (self.num_blocks * self.block, *self.shape[3:])
        longest = max((shard.longest() for shard in self._shards), default=0)
        try:
            check_decoded("a layer of it", 4 * math.prod(shape), sum(shard.stored() for shard in self._shards))
        except TooLarge as error:
            raise CorruptEpisode(str(error)) from None
        most = 4 * math.prod((self.block, *self.shape[3:])) + _BLOSC_HEADER.size + CHECKSUM_BYTES
        if longest > most:
            raise CorruptEpisode(f"its index names a chunk of {longest} bytes; expected at most {most}")
        return LayerMemory(np.empty(shape, dtype="<f4"), np.empty(longest, np.uint8))

    def read(self, layer: int, denoise: int, memory: LayerMemory | None = None) -> NDArray[np.float32]:
        """Values (replan, ...) of one layer and denoise step, both positions along their axes.

        memory: of which the result is then a part; new memory without. Decoding every layer into the same memory keeps
        it in the processor's cache, and no chunk is copied.

        Raises:
            CorruptEpisode: a chunk is missing, is not the one that was sealed, or decodes to another size.
        """
        if not (0 <= layer < self.shape[1] and 0 <= denoise < self.shape[2]):
            raise IndexError(f"layer {layer} and denoise {denoise} of an array of shape {self.shape}")
        memory = memory or self.memory()
        values = memory.values
        for i in range(self.num_blocks):
            shard, place = self._shards[i // self.blocks_per_shard], i % self.blocks_per_shard
            number = (place * self.shape[1] + layer) * self.shape[2] + denoise
            frame = shard.chunk(number, memory.chunk)
            chunk = values[i * self.block : (i + 1) * self.block]
            _decode(frame.data, chunk, chunk.itemsize, f"chunk {number} of its {shard.file}", shard.file)
        return values[: self.shape[0]]
