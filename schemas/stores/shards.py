"""A shard: a file of compressed chunks with an index of their places at its end (Zarr's codec `sharding_indexed`)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vla_attention.schemas.stores.byte_source import ByteSource, Memory
from vla_attention.schemas.stores.digest import CHECKSUM_BYTES, bytes_digest, crc32c
from vla_attention.schemas.stores.remote_source import RemoteFailure
from vla_attention.schemas.stores.store_format import CorruptEpisode, FileRecord

_ABSENT = np.uint64(2**64 - 1)


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
        places: offset, length and checksum of each chunk, the latter from the seal; length 0: not written.
    """

    source: ByteSource
    file: str
    places: Sequence[tuple[int, int, bytes]]

    @classmethod
    def open(cls, source: ByteSource, file: str, record: FileRecord, chunks: int, most: int) -> SealedShard:
        """Read the index of so many chunks, each of which has at most `most` bytes with its checksum.

        Raises:
            CorruptEpisode: it is not the one in the seal.
            OSError: the file cannot be read.
        """
        size, checksums = index_size(chunks), bytes.fromhex(record.chunks)
        if len(checksums) != CHECKSUM_BYTES * chunks:
            listed = len(checksums) // CHECKSUM_BYTES
            raise CorruptEpisode(f"its {file} has {chunks} chunks, and its seal lists {listed}", file)
        if record.size < size:
            raise CorruptEpisode(f"its {file} has {record.size} bytes in the seal, and an index of {size}", file)
        # One byte more: a file that has grown is not the one that was sealed.
        stored = source.part(file, record.size - size, size + 1)
        if len(stored) != size:
            raise CorruptEpisode(f"its {file} does not agree with its seal: it has another size", file)
        if bytes_digest(stored) != record.index:
            raise CorruptEpisode(f"its {file} does not agree with its seal: its index was changed", file)
        try:
            index = read_index(stored, record.size).tolist()
        except CorruptEpisode as error:
            raise CorruptEpisode(f"its {file} cannot be read: {error}", file) from None
        parts = (checksums[i : i + CHECKSUM_BYTES] for i in range(0, len(checksums), CHECKSUM_BYTES))
        shard = cls(source, file, [(*place, part) for place, part in zip(index, parts, strict=True)])
        if shard.longest > most:
            raise CorruptEpisode(f"its index names a chunk of {shard.longest} bytes; expected at most {most}", file)
        return shard

    @property
    def longest(self) -> int:
        """Bytes of the longest chunk, with its checksum."""
        return max((length for _, length, _ in self.places), default=0)

    def chunk(self, number: int, memory: Memory | None = None) -> Memory:
        """The encoded bytes of one chunk, without the checksum that follows them in the file.

        memory: as much as the `longest` chunk takes, for the result; new memory without. To be given new memory for
        half a megabyte takes longer than to read it from the system's cache.

        Raises:
            CorruptEpisode: the chunk is missing, or its checksum is another one than in the seal or than that of its
                bytes.
        """
        offset, length, sealed = self.places[number]
        if length <= CHECKSUM_BYTES:
            raise CorruptEpisode(f"its {self.file} lacks chunk {number}: it is missing", self.file)
        stored = np.empty(length, np.uint8) if memory is None else memory[:length]
        try:
            count = self.source.read_into(stored, self.file, offset)
        except RemoteFailure:
            raise
        except OSError as error:
            raise CorruptEpisode(f"its {self.file} cannot be read: {error.strerror or error}", self.file) from None
        if count != length:
            raise CorruptEpisode(f"its {self.file} ends in chunk {number}", self.file)
        chunk, checksum = stored[:-CHECKSUM_BYTES], stored[-CHECKSUM_BYTES:].tobytes()
        if checksum != sealed:
            raise CorruptEpisode(f"chunk {number} of its {self.file} does not agree with its seal", self.file)
        if crc32c(chunk) != int.from_bytes(checksum, "little"):
            raise CorruptEpisode(f"the checksum of chunk {number} of its {self.file} does not fit", self.file)
        return chunk
