"""Files of an episode as its seal lists them: bytes that are not those that were sealed are never returned."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from vla_attention.schemas.limits import DOCUMENT_BYTES
from vla_attention.schemas.regular_files import NotRegular
from vla_attention.schemas.stores.byte_source import ByteSource, Folder
from vla_attention.schemas.stores.digest import bytes_digest
from vla_attention.schemas.stores.remote_source import RemoteFailure
from vla_attention.schemas.stores.shards import SealedShard
from vla_attention.schemas.stores.store_format import CorruptEpisode, FileRecord

#: Bytes of a file that are in memory at once where no more than its digest is wanted.
PART_BYTES = 16_000_000


@dataclass(frozen=True)
class SealedFiles:
    """The files of an episode, wherever they are; `records` are those of its seal, by path."""

    source: ByteSource
    records: Mapping[str, FileRecord]

    def whole(self, file: str, most: int | None = None) -> bytes:
        """All bytes of a file.

        most: bytes that it may have; without, as many as the seal says, and no more than documents have at most.

        Raises:
            CorruptEpisode: the file is missing, not in the seal, or not the one that was sealed.
        """
        record = self.record(file)
        if most is None:
            most = DOCUMENT_BYTES if file.endswith("zarr.json") else record.size
        if record.size > most:
            raise CorruptEpisode(f"its {file} has {record.size:,} bytes; expected at most {most:,}", file)
        with _reading(file):
            content = self.source.whole(file, most=most)
        if len(content) != record.size or bytes_digest(content) != record.sha256:
            raise CorruptEpisode(_differs(file), file)
        return content

    def check(self, file: str) -> None:
        """Read a file part by part; raises `CorruptEpisode` as `whole` does."""
        for _ in self._parts(file):
            pass

    def copy(self, file: str, path: Path) -> int:
        """Write a file to `path` part by part, and return its bytes; raises `CorruptEpisode` as `whole` does.

        What has been written when the error is raised is of no use.
        """
        record = self.record(file)
        with path.open("wb") as copied:
            for offset, part in self._parts(file):
                copied.seek(offset)
                copied.write(part)
        return record.size

    def _parts(self, file: str) -> Iterator[tuple[int, bytes]]:
        """Offset and bytes of each part of a file; they are those of the seal when all of them have been taken."""
        record = self.record(file)
        if record.size <= PART_BYTES:
            yield 0, self.whole(file)
            return
        digest = hashlib.sha256()
        with _reading(file):
            if isinstance(self.source, Folder):
                self.source.check_not_sparse(file)
            for offset in range(0, record.size, PART_BYTES):
                length = min(PART_BYTES, record.size - offset)
                # One byte more at the end: a file that has grown is not the one that was sealed.
                last = offset + length == record.size
                part = self.source.part(file, offset, length + last)
                if len(part) != length:
                    break
                digest.update(part)
                yield offset, part
        if digest.hexdigest() != record.sha256:
            raise CorruptEpisode(_differs(file), file)

    def shard(self, file: str, chunks: int, most: int) -> SealedShard:
        """The shard in a file, of which single chunks can be read; see `SealedShard.open`."""
        with _reading(file):
            return SealedShard.open(self.source, file, self.record(file), chunks, most)

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


@contextmanager
def _reading(file: str) -> Iterator[None]:
    """Within the block a file of the episode is read: that it cannot be is damage, and that a network fails is none."""
    try:
        yield
    except RemoteFailure:
        raise
    except OSError as error:
        raise CorruptEpisode(_lost(file, error), file) from None


def _differs(file: str) -> str:
    return f"its {file} does not agree with its seal"


def _lost(file: str, error: OSError) -> str:
    if isinstance(error, NotRegular):
        return f"its {file} cannot be read: {error.strerror}"
    return f"it has lost its {file} ({error.strerror or error})"
