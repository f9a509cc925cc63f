"""An array of an episode for zarr-python, which gets the array's files through the episode's seal."""

from __future__ import annotations

from collections.abc import AsyncIterator, Iterable

import numpy as np
from zarr.abc.store import ByteRequest, OffsetByteRequest, RangeByteRequest, Store, SuffixByteRequest
from zarr.core.buffer import Buffer, BufferPrototype

from vla_attention.schemas.limits import WHOLE_FILE_BYTES
from vla_attention.schemas.stores.array_metadata import ArrayMetadata
from vla_attention.schemas.stores.digest import CHECKSUM_BYTES
from vla_attention.schemas.stores.sealed_files import SealedFiles
from vla_attention.schemas.stores.shards import SealedShard, check_blosc_frame
from vla_attention.schemas.stores.store_format import CorruptEpisode


class SealedArrayStore(Store):
    """The files of one array, read only: a file that differs from the seal raises `CorruptEpisode`.

    A missing file raises it too: zarr would read it as the fill value, which is a valid number in a picture. zarr asks
    for a shard's index and then for its chunks, or for a whole file. The parts are compared with what the seal says of
    them; for any other part the whole file is read and compared.
    """

    supports_writes = False
    supports_deletes = False
    supports_listing = False

    def __init__(self, files: SealedFiles, name: str, metadata: ArrayMetadata) -> None:
        """Serve the array `name`; `metadata` are those of its checked `zarr.json`."""
        super().__init__(read_only=True)
        self._files = files
        self._name = name
        self._metadata = metadata

    async def get(self, key: str, prototype: BufferPrototype, byte_range: ByteRequest | None = None) -> Buffer | None:
        """The bytes of a file of the array, or of a part of it."""
        return prototype.buffer.from_bytes(self._bytes(f"{self._name}/{key}", byte_range))

    async def get_partial_values(
        self, prototype: BufferPrototype, key_ranges: Iterable[tuple[str, ByteRequest | None]]
    ) -> list[Buffer | None]:
        """`get` for several parts."""
        return [await self.get(key, prototype, byte_range) for key, byte_range in key_ranges]

    def _bytes(self, file: str, byte_range: ByteRequest | None) -> bytes:
        shard = self._shard(file)
        if shard is not None and byte_range is not None:
            part = self._part(shard, byte_range)
            if part is not None:
                return part
        content = self._files.whole(file, WHOLE_FILE_BYTES if shard is None else None)
        if shard is None:
            self._check_frame(content[:-CHECKSUM_BYTES] if self._metadata.codecs[-1] == "crc32c" else content, file)
        else:
            stored = np.frombuffer(content, np.uint8)
            for number, (offset, length) in enumerate(shard.index.tolist()):
                if length:
                    problem = shard.problem(number, stored[offset : offset + length])
                    if problem is not None:
                        raise CorruptEpisode(problem, shard.file)
                    self._check_frame(content[offset : offset + length - CHECKSUM_BYTES], file)
        return _cut(content, byte_range)

    def _shard(self, file: str) -> SealedShard | None:
        """The shard in a file; None for a file of one chunk, and for shards whose chunks have no checksums."""
        chunks = self._metadata.shard_chunks
        return None if chunks is None else self._files.shard(file, chunks)

    def _part(self, shard: SealedShard, wanted: ByteRequest) -> bytes | None:
        """The shard's index or one of its chunks; None when the wanted part is something else."""
        if isinstance(wanted, SuffixByteRequest) and wanted.suffix == len(shard.index_bytes):
            return shard.index_bytes
        if isinstance(wanted, RangeByteRequest):
            at = np.flatnonzero(shard.index[:, 0] == wanted.start)
            for number in at.tolist():
                if shard.index[number].sum() == wanted.end:
                    frame = shard.chunk(number).tobytes()
                    self._check_frame(frame, shard.file)
                    return frame + shard.checksum(number)
        return None

    def _check_frame(self, frame: bytes, file: str) -> None:
        """Compare the sizes in the header of an encoded chunk, without its checksum, with those of the array."""
        if "blosc" not in self._metadata.codecs:
            return
        try:
            check_blosc_frame(frame, self._metadata.chunk_bytes, self._metadata.typesize)
        except CorruptEpisode as error:
            raise CorruptEpisode(f"a chunk of its {file} cannot be decoded: {error}", file) from None

    def __eq__(self, other: object) -> bool:
        """Whether both serve the same array of the same folder."""
        return isinstance(other, SealedArrayStore) and (self._files, self._name) == (other._files, other._name)

    async def exists(self, key: str) -> bool:
        """Whether the seal lists the file."""
        return f"{self._name}/{key}" in self._files.records

    async def set(self, key: str, value: Buffer) -> None:
        """Not possible: the store is read only."""
        self._check_writable()

    async def delete(self, key: str) -> None:
        """Not possible: the store is read only."""
        self._check_writable()

    async def list(self) -> AsyncIterator[str]:
        """The files of the array."""
        for file in self._files.records:
            if file.startswith(f"{self._name}/"):
                yield file.removeprefix(f"{self._name}/")

    async def list_prefix(self, prefix: str) -> AsyncIterator[str]:
        """The files of the array whose path begins so."""
        async for file in self.list():
            if file.startswith(prefix):
                yield file

    async def list_dir(self, prefix: str) -> AsyncIterator[str]:
        """The names in a folder of the array."""
        folder = f"{prefix.rstrip('/')}/" if prefix else ""
        seen: set[str] = set()
        async for file in self.list_prefix(folder):
            name = file.removeprefix(folder).partition("/")[0]
            if name not in seen:
                seen.add(name)
                yield name


def _cut(content: bytes, byte_range: ByteRequest | None) -> bytes:
    if isinstance(byte_range, RangeByteRequest):
        return content[byte_range.start : byte_range.end]
    if isinstance(byte_range, OffsetByteRequest):
        return content[byte_range.offset :]
    if isinstance(byte_range, SuffixByteRequest):
        return content[max(0, len(content) - byte_range.suffix) :]
    return content
