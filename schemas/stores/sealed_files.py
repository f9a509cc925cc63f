"""Files of an episode as its seal lists them: bytes that are not those that were sealed are never returned."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from vla_attention.schemas.stores.digest import bytes_digest
from vla_attention.schemas.stores.shards import SealedShard
from vla_attention.schemas.stores.store_format import CorruptEpisode, FileRecord


@dataclass(frozen=True)
class SealedFiles:
    """The files in an episode's folder; `records` are those of its seal, by path."""

    folder: Path
    records: Mapping[str, FileRecord]
    _shards: dict[str, SealedShard] = field(default_factory=dict, repr=False, compare=False)

    def whole(self, file: str) -> bytes:
        """All bytes of a file.

        Raises:
            CorruptEpisode: the file is missing, not in the seal, or not the one that was sealed.
        """
        record = self._record(file)
        try:
            content = (self.folder / file).read_bytes()
        except OSError as error:
            raise CorruptEpisode(_lost(file, error)) from None
        if len(content) != record.size or bytes_digest(content) != record.sha256:
            raise CorruptEpisode(f"its {file} does not agree with its seal")
        return content

    def shard(self, file: str) -> SealedShard | None:
        """The shard in a file, of which single chunks can be read; None when the seal does not list its chunks."""
        if file not in self._shards:
            record = self._record(file)
            if not record.chunks:
                return None
            try:
                self._shards[file] = SealedShard.open(self.folder / file, file, record)
            except OSError as error:
                raise CorruptEpisode(_lost(file, error)) from None
        return self._shards[file]

    def problems(self) -> list[str]:
        """Files that are missing or have another size than in the seal. Reads none of them."""
        found = []
        for file, record in self.records.items():
            try:
                size = os.stat(self.folder / file).st_size
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
    return f"it has lost its {file} ({error.strerror or error})"
