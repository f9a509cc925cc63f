"""Arrays of one episode that grow by a replan at a time, with a chunk of numbers in memory at most."""

from __future__ import annotations

import math
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray

from vla_attention.capture.store.codecs import MISSING, create_whole, encode_whole, entries_per_chunk
from vla_attention.schemas.stores.array_metadata import chunk_file
from vla_attention.schemas.stores.digest import CHECKSUM_BYTES, ArrayDigest, crc32c
from vla_attention.schemas.stores.store_format import ArrayRecord


def with_checksum(content: bytes) -> bytes:
    """Return a chunk or an index with the checksum behind it."""
    return content + crc32c(content).to_bytes(CHECKSUM_BYTES, "little")


class ShardFile:
    """The file of an array that is one shard: chunks one after the other, and behind them where each begins."""

    def __init__(self, folder: Path, name: str, ndim: int) -> None:
        self._file = folder / name / chunk_file(ndim)
        self._file.parent.mkdir(parents=True)
        self._index: list[tuple[int, int]] = []
        self._size = 0

    def append(self, *chunks: bytes) -> None:
        """Add encoded chunks, without their checksums; in the order of the chunk grid."""
        with self._file.open("ab") as file:
            for chunk in map(with_checksum, chunks):
                file.write(chunk)
                self._index.append((self._size, len(chunk)))
                self._size += len(chunk)

    def finish(self) -> None:
        """Write the index, offset and length of every chunk."""
        with self._file.open("ab") as file:
            file.write(with_checksum(np.array(self._index, dtype="<u8").tobytes()))


class GrowingArray:
    """An array whose first axis grows. Its files are those that `write_whole` makes of all values at once."""

    def __init__(self, group: zarr.Group, folder: Path, name: str, axes: tuple[str, ...]) -> None:
        """Begin the array `name` of the episode's `group`, whose folder it is."""
        self._group, self._folder, self._name, self._axes = group, folder, name, axes
        self._pending: list[NDArray[Any]] = []
        self._length, self._written = 0, 0
        self._shard: ShardFile | None = None
        self._digest = ArrayDigest()

    def append(self, values: NDArray[Any]) -> None:
        """Add values (entry, ...)."""
        self._digest.update(values)
        # A copy: the caller's array may be a view of a larger one, which would stay in memory.
        self._pending.append(values.copy())
        self._length += len(values)
        most = entries_per_chunk(values.shape[1:], values.dtype)
        while self._length - self._written > most:  # the last chunk stays: an array of one chunk is no shard
            self._write(most)

    def _write(self, count: int) -> None:
        values = np.concatenate(self._pending)
        self._pending = [values[count:].copy()]
        most = entries_per_chunk(values.shape[1:], values.dtype)
        chunk = np.full((most, *values.shape[1:]), MISSING[values.dtype.kind], dtype=values.dtype)
        chunk[:count] = values[:count]
        if self._shard is None:
            self._shard = ShardFile(self._folder, self._name, values.ndim)
        self._shard.append(encode_whole(chunk))
        self._written += count

    def finish(self) -> ArrayRecord:
        """Write the rest and the metadata; returns shape and digest."""
        values = np.concatenate(self._pending)
        shape = (self._length, *values.shape[1:])
        if self._shard is not None:
            self._write(len(values))
            self._shard.finish()
        array = create_whole(self._group, self._name, shape, values.dtype, self._axes)
        if self._shard is None:
            array[...] = values
        self._pending.clear()
        return ArrayRecord(shape, self._digest.hexdigest())


class KeptArrays(list[NDArray[Any]]):
    """Arrays that wait in memory."""

    def part(self, number: int, *cell: int) -> NDArray[Any]:
        """Return one array, or what it has in a cell of its first axes."""
        values: NDArray[Any] = self[number][cell]
        return values

    def close(self) -> None:
        """Nothing is open."""


class SpilledArrays:
    """Arrays of one dtype that wait in a file without a name."""

    def __init__(self, folder: Path, dtype: str) -> None:
        """Wait beside the folder: one for temporary files may lie in memory."""
        self._file = tempfile.TemporaryFile(dir=folder.parent)  # noqa: SIM115 - it is open as long as this lives
        self._dtype = np.dtype(dtype)
        self._places: list[tuple[int, tuple[int, ...]]] = []
        self._size = 0

    def __len__(self) -> int:
        return len(self._places)

    def append(self, values: NDArray[Any]) -> None:
        """Add an array."""
        self._file.seek(self._size)
        self._file.write(np.ascontiguousarray(values, dtype=self._dtype).data)
        self._places.append((self._size, values.shape))
        self._size += values.size * self._dtype.itemsize

    def part(self, number: int, *cell: int) -> NDArray[Any]:
        """Return one array, or what it has in a cell of its first axes."""
        offset, shape = self._places[number]
        for place, (index, length) in enumerate(zip(cell, shape, strict=False), start=1):
            assert index < length
            offset += index * math.prod(shape[place:]) * self._dtype.itemsize
        rest = shape[len(cell) :]
        self._file.seek(offset)
        content = self._file.read(math.prod(rest) * self._dtype.itemsize)
        return np.frombuffer(content, dtype=self._dtype).reshape(rest)

    def clear(self) -> None:
        """Begin anew."""
        self._file.truncate(0)
        self._places.clear()
        self._size = 0

    def close(self) -> None:
        """Give the file back; nothing happens the second time."""
        self._file.close()
