"""Files of an episode as its seal lists them: bytes that are not those that were sealed are never returned.

Of a shard (a file of compressed chunks with an index of their places at its end, Zarr's codec `sharding_indexed`)
single chunks are read: the index is compared with the digest in the seal, and a chunk with the checksum at its end and
with that in the seal.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vla_attention.schemas.foreign_files import MAX_DOCUMENT_BYTES
from vla_attention.schemas.stores.byte_source import ByteSource, Memory
from vla_attention.schemas.stores.digest import CHECKSUM_BYTES, bytes_digest, crc32c
from vla_attention.schemas.stores.remote_source import RemoteFailure
from vla_attention.schemas.stores.store_format import CorruptEpisode, FileRecord

#: Bytes of a file that are in memory at once where it is copied, or no more than its digest is wanted.
PART_BYTES = 16_000_000


def index_size(chunks: int) -> int:
    """Bytes of a shard's index of that many chunks, with its checksum."""
    return 16 * chunks + CHECKSUM_BYTES


def index_places(stored: bytes) -> list[tuple[int, int]]:
    """Offset and length of every chunk, from the bytes of the index; -1 and -1 for one that was not written."""
    return [
        (offset, length) for offset, length in np.frombuffer(stored[:-CHECKSUM_BYTES], "<i8").reshape(-1, 2).tolist()
    ]


@dataclass(frozen=True)
class SealedFiles:
    """The files of an episode, wherever they are; `records` are those of its seal, by path."""

    source: ByteSource
    records: Mapping[str, FileRecord]

    def whole(self, file: str) -> bytes:
        """All bytes of a file.

        Raises:
            CorruptEpisode: the file is missing, not in the seal, or not the one that was sealed.
        """
        record = self.record(file)
        with _reading(file):
            content = self.source.whole(file, record.size)
        if len(content) != record.size or bytes_digest(content) != record.sha256:
            raise CorruptEpisode(_differs(file), file)
        return content

    def parts(self, file: str) -> Iterator[bytes]:
        """The bytes of a file part by part; its end raises as `whole` does unless they are those of the seal."""
        record, digest, read = self.record(file), hashlib.sha256(), 0
        with _reading(file):
            # One byte more at the end: a file that has grown is not the one that was sealed.
            for offset in range(0, record.size + 1, PART_BYTES):
                part = self.source.part(file, offset, min(PART_BYTES, record.size + 1 - offset))
                if not part:
                    break
                digest.update(part)
                read += len(part)
                yield part
        if digest.hexdigest() != record.sha256 or read != record.size:
            raise CorruptEpisode(_differs(file), file)

    def check(self, file: str) -> None:
        """Read a file part by part; raises `CorruptEpisode` as `whole` does."""
        for _ in self.parts(file):
            pass

    def copy(self, file: str, path: Path) -> int:
        """Write a file to `path` part by part, and return its bytes; raises `CorruptEpisode` as `whole` does.

        What has been written when the error is raised is of no use.
        """
        with path.open("wb") as copied:
            return sum(copied.write(part) for part in self.parts(file))

    def shard(self, file: str, chunks: int) -> SealedShard:
        """The shard of so many chunks in a file.

        Raises:
            CorruptEpisode: its index is not the one in the seal, or the file cannot be read.
        """
        record, size = self.record(file), index_size(chunks)
        if size > min(record.size, MAX_DOCUMENT_BYTES):
            raise CorruptEpisode(f"its {file} has {record.size} bytes, too few for {chunks} chunks", file)
        with _reading(file):
            # One byte more: a file that has grown is not the one that was sealed.
            stored = self.source.part(file, max(0, record.size - size), size + 1)
        if bytes_digest(stored) != record.index:
            raise CorruptEpisode(f"{_differs(file)}: its index was changed, or it has another size", file)
        places = index_places(stored)
        checksums = np.frombuffer(bytes.fromhex(record.chunks), "<u4").tolist()
        if len(checksums) != sum(length >= 0 for _, length in places):
            raise CorruptEpisode(f"{_differs(file)}, which knows {len(checksums)} of {len(places)} chunks", file)
        following = iter(checksums)
        return SealedShard(self.source, file, places, [next(following) if n >= 0 else 0 for _, n in places])

    def problems(self) -> dict[str, str]:
        """What is wrong, by file: it is missing, or has another size than in the seal. Reads none of them."""
        wrong = {}
        for file, record in self.records.items():
            try:
                size = self.source.size(file)
            except RemoteFailure:
                raise
            except OSError as error:
                wrong[file] = _lost(file, error)
                continue
            if size != record.size:
                wrong[file] = f"its {file} has {size} bytes; its seal says {record.size}"
        return wrong

    def record(self, file: str) -> FileRecord:
        """What the seal says of a file; `CorruptEpisode` where it does not list it."""
        record = self.records.get(file)
        if record is None:
            raise CorruptEpisode(f"its {file} does not agree with its seal, which does not list it", file)
        return record


@dataclass(frozen=True)
class SealedShard:
    """One shard's file, whose index agrees with the seal.

    places: offset and length of each chunk. checksums: those of the chunks in the seal.
    """

    source: ByteSource
    file: str
    places: Sequence[tuple[int, int]]
    checksums: Sequence[int]

    def size(self, numbers: range) -> int:
        """Bytes of some chunks, with their checksums."""
        return sum(length for _, length in self.places[numbers.start : numbers.stop])

    def chunks(self, numbers: range, memory: Memory | None = None) -> Iterator[Memory]:
        """The encoded bytes of chunks with neighbouring numbers, without the checksum that follows each in the file.

        Chunks that follow each other in the file are read at once: on a network each reading is a request.

        memory: as much as they take, for the results; new memory without. To be given new memory for half a megabyte
        takes longer than to read it from the system's cache.

        Raises:
            CorruptEpisode: a chunk is missing, or is not the one that was sealed.
        """
        while numbers:
            offset, length = self.places[numbers[0]]
            ends = [offset + length]
            for number in numbers[1:]:
                begins, length = self.places[number]
                if begins != ends[-1] or length < 0:
                    break
                ends.append(begins + length)
            if self.places[numbers[0]][1] < 0:
                raise CorruptEpisode(f"its {self.file} lacks chunk {numbers[0]}: it is missing", self.file)
            with _reading(self.file):
                size = ends[-1] - offset
                stored = np.empty(size, np.uint8) if memory is None else memory[:size]
                count = self.source.read_into(stored, self.file, offset)
            if count != size:
                raise CorruptEpisode(f"its {self.file} ends in chunk {numbers[0]}, or in one behind it", self.file)
            for number, begin, end in zip(numbers, [offset, *ends], ends, strict=False):
                yield self._checked(number, stored[begin - offset : end - offset])
            numbers = numbers[len(ends) :]

    def _checked(self, number: int, stored: Memory) -> Memory:
        chunk, checksum = stored[:-CHECKSUM_BYTES], stored[-CHECKSUM_BYTES:].tobytes()
        if not crc32c(chunk) == int.from_bytes(checksum, "little") == self.checksums[number]:
            raise CorruptEpisode(f"the checksum of chunk {number} of its {self.file} does not fit", self.file)
        return chunk


@contextmanager
def _reading(file: str) -> Iterator[None]:
    """Within the block a file of the episode is read: that it cannot be is damage, and that a network fails is none."""
    try:
        yield
    except RemoteFailure:
        raise
    except OSError as error:
        raise CorruptEpisode(_lost(file, error), file) from None
    except MemoryError:
        raise CorruptEpisode(f"its {file} is said to have more bytes than there is memory", file) from None


def _differs(file: str) -> str:
    return f"its {file} does not agree with its seal"


def _lost(file: str, error: OSError) -> str:
    return f"it has lost its {file} ({error.strerror or error})"
