"""Files of an episode as its seal lists them: bytes that are not those that were sealed are never returned."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from vla_attention.schemas.limits import DOCUMENT_BYTES
from vla_attention.schemas.regular_files import NotRegular
from vla_attention.schemas.stores.byte_source import ByteSource
from vla_attention.schemas.stores.digest import bytes_digest
from vla_attention.schemas.stores.remote_source import RemoteFailure
from vla_attention.schemas.stores.shards import SealedShard
from vla_attention.schemas.stores.store_format import CorruptEpisode, FileRecord
from vla_attention.schemas.stores.zip_members import DamagedZip


@dataclass(frozen=True)
class SealedFiles:
    """The files of an episode, wherever they are; `records` are those of its seal, by path."""

    source: ByteSource
    records: Mapping[str, FileRecord]
    _shards: dict[str, SealedShard] = field(default_factory=dict, repr=False, compare=False)

    def whole(self, file: str, most: int | None = None) -> bytes:
        """All bytes of a file.

        most: bytes that it may have; without, as many as the seal says, and no more than documents have at most.

        Raises:
            CorruptEpisode: the file is missing, not in the seal, or not the one that was sealed.
        """
        record = self._record(file)
        if most is None:
            most = DOCUMENT_BYTES if file.endswith("zarr.json") else record.size
        if record.size > most:
            raise CorruptEpisode(f"its {file} has {record.size:,} bytes; expected at most {most:,}")
        # A cache may have kept damaged bytes: they are asked for anew once.
        for fresh in (False, True) if self.source.remembers else (False,):
            try:
                content = self.source.whole(file, most=most, fresh=fresh)
            except RemoteFailure:
                raise
            except OSError as error:
                raise CorruptEpisode(_lost(file, error)) from None
            if len(content) == record.size and bytes_digest(content) == record.sha256:
                return content
        raise CorruptEpisode(f"its {file} does not agree with its seal")

    def shard(self, file: str) -> SealedShard | None:
        """The shard in a file, of which single chunks can be read; None when the seal does not list its chunks."""
        if file not in self._shards:
            record = self._record(file)
            if not record.chunks:
                return None
            try:
                self._shards[file] = SealedShard.open(self.source, file, record)
            except RemoteFailure:
                raise
            except OSError as error:
                raise CorruptEpisode(_lost(file, error)) from None
        return self._shards[file]

    def problems(self) -> list[str]:
        """Files that are missing or have another size than in the seal. Reads none of them."""
        found = []
        for file, record in self.records.items():
            try:
                size = self.source.size(file)
            except RemoteFailure:
                raise
            except OSError as error:
                found.append(_lost(file, error))
                continue
            if size != record.size:
                found.append(f"its {file} has {size} bytes; its seal says {record.size}")
        return found

    def _record(self, file: str) -> FileRecord:
        record = self.records.get(file)
        if record is None:
            raise CorruptEpisode(f"its {file} does not agree with its seal, which does not list it")
        return record


def _lost(file: str, error: OSError) -> str:
    if isinstance(error, DamagedZip):
        return str(error)
    if isinstance(error, NotRegular):
        return f"its {file} cannot be read: {error.strerror}"
    return f"it has lost its {file} ({error.strerror or error})"
