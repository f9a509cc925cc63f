"""An array of an episode: its chunks are compared with their checksums, decoded, and put together.

A chunk is read alone where the array's file is a shard of them. zarr-python is not needed: passing chunks through its
event loop takes as long as decoding them. Probabilities that are stored as float16 are read as float32.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vla_attention.schemas.cached_property import cached_property
from vla_attention.schemas.precision import from_half, in_range
from vla_attention.schemas.stores.array_metadata import ArrayMetadata
from vla_attention.schemas.stores.byte_source import Memory
from vla_attention.schemas.stores.digest import CHECKSUM_BYTES
from vla_attention.schemas.stores.sealed_files import SealedFiles, SealedShard
from vla_attention.schemas.stores.store_format import CorruptEpisode


@dataclass(frozen=True)
class StoredArray:
    """An array of an episode.

    Attributes:
        name: its path in the episode.
        metadata: what its `zarr.json` says.
        files: the episode's files.
    """

    name: str
    metadata: ArrayMetadata
    files: SealedFiles

    @property
    def _file(self) -> str:
        return f"{self.name}/{self.metadata.file}"

    @cached_property
    def _shard(self) -> SealedShard | None:
        """The array's file, of which chunks are read alone; None where it is one chunk."""
        count = self.metadata.shard_chunks
        return None if count is None else self.files.shard(self._file, count)

    def read(self, first: int = 0, stop: int | None = None) -> NDArray[Any]:
        """Values from one index along the first axis to another one; all of them without.

        Raises:
            CorruptEpisode: a chunk is missing, is not the one that was sealed, or decodes to another size.
        """
        return self.values_of(self.read_stored(first, stop))

    def values_of(self, stored: NDArray[Any], into: NDArray[np.float32] | None = None) -> NDArray[Any]:
        """The numbers that stored ones stand for: probabilities, where they are float16. into: memory for these.

        Raises:
            CorruptEpisode: some stand for none.
        """
        if not self.metadata.is_half:
            return stored
        if not in_range(stored):
            raise CorruptEpisode("it has missing values: a chunk is lost, or holds what is no probability", self._file)
        return from_half(stored, into)

    def read_stored(self, first: int = 0, stop: int | None = None) -> NDArray[Any]:
        """As `read`; probabilities in float16 as they are stored."""
        shape, chunk, grid = self.metadata.shape, self.metadata.chunk_shape, self.metadata.grid
        stop = shape[0] if stop is None else stop
        values = np.empty((stop - first, *shape[1:]), self.metadata.dtype)
        decoded = np.empty(chunk, self.metadata.dtype)
        blocks = range(first // chunk[0], -(-stop // chunk[0]) if values.size else 0)
        numbers = range(blocks.start * math.prod(grid[1:]), blocks.stop * math.prod(grid[1:]))
        for place, (number, frame) in zip(product(blocks, *map(range, grid[1:])), self._frames(numbers), strict=False):
            self._decode(number, frame, decoded)
            # Where the chunk begins among the wanted values: before them, if only its end is wanted.
            begins = [i * extent for i, extent in zip(place, chunk, strict=True)]
            begins[0] -= first
            into = [slice(max(0, at), at + extent) for at, extent in zip(begins, chunk, strict=True)]
            part = values[tuple(into)]
            skipped = max(0, -begins[0])
            taken = [slice(skipped, skipped + len(part)), *(slice(extent) for extent in part.shape[1:])]
            part[...] = decoded[tuple(taken)]
        return values

    def layers(self, places: Iterable[tuple[int, int]], keys: range | None = None) -> Iterator[NDArray[np.float32]]:
        """Layers and denoise steps (positions) of an array (replan, layer, denoise, ..., key), one after the other.

        Each is (replan, ..., key), and gone when the next one is asked for: all are decoded into the same memory, which
        stays in the processor's cache.

        keys: those that are read, which are whole chunks (`ArrayMetadata.whole_chunks`); all unless given.

        Raises:
            CorruptEpisode: as `read`, or a chunk holds something else than replans of one layer and denoise step.
        """
        shape, (block, *rest) = self.metadata.shape, self.metadata.chunk_shape
        if len(shape) < 4 or rest[:-1] != [1, 1, *shape[3:-1]]:
            raise CorruptEpisode(f"its chunks are {self.metadata.chunk_shape}; expected replans of a layer and step")
        keys, of_key = range(shape[-1]) if keys is None else keys, rest[-1]
        of_keys = range(keys.start // of_key, -(-keys.stop // of_key))
        blocks, along_keys = self.metadata.grid[0], self.metadata.grid[-1]
        stored = np.empty((blocks * block, *shape[3:-1], len(keys)), self.metadata.dtype)
        values = np.empty(stored.shape, np.float32) if self.metadata.is_half else stored
        # A chunk that is all there is of some replans is decoded where it belongs, others are copied there: converted
        # are all of a layer at once, since numpy is slow with rows of a few hundred numbers.
        decoded = (
            None if len(of_keys) == 1 and len(keys) == of_key else np.empty((block, *shape[3:-1], of_key), stored.dtype)
        )
        memory = np.empty(0, np.uint8)
        for layer, denoise in places:
            if not (0 <= layer < shape[1] and 0 <= denoise < shape[2]):
                raise IndexError(f"layer {layer} and denoise {denoise} of an array of shape {shape}")
            for i in range(blocks):
                first = ((i * shape[1] + layer) * shape[2] + denoise) * along_keys
                numbers = range(first + of_keys.start, first + of_keys.stop)
                if self._shard is not None and memory.size < self._shard.size(numbers):
                    memory = np.empty(self._shard.size(numbers), np.uint8)
                rows = stored[i * block : (i + 1) * block]
                for number, frame in self._frames(numbers, memory):
                    self._decode(number, frame, rows if decoded is None else decoded)
                    if decoded is not None:
                        begin = (number - first) * of_key - keys.start
                        into = rows[..., begin : begin + of_key]
                        into[...] = decoded[..., : into.shape[-1]]
            yield self.values_of(stored[: shape[0]], values[: shape[0]])

    def _frames(self, numbers: range, memory: Memory | None = None) -> Iterator[tuple[int, memoryview]]:
        """Numbers and encoded bytes of neighbouring chunks. memory: for these bytes."""
        if self._shard is not None:
            for number, chunk in zip(numbers, self._shard.chunks(numbers, memory), strict=True):
                yield number, chunk.data
        elif numbers:
            yield 0, memoryview(self.files.whole(self._file))[:-CHECKSUM_BYTES]

    def _decode(self, number: int, frame: memoryview, values: NDArray[Any]) -> None:
        """Decode a chunk into memory of its size."""
        from numcodecs import blosc

        what = "it" if self._shard is None else f"chunk {number} of it"
        # Blosc leaves what a shorter chunk does not fill as it was. Its header has the decoded size.
        size = int.from_bytes(frame[4:8], "little")
        if size != values.nbytes:
            raise CorruptEpisode(f"{what} decodes to {size} bytes; expected {values.nbytes}", self._file)
        try:
            blosc.decompress(frame, values)
        except (RuntimeError, ValueError) as error:
            raise CorruptEpisode(f"{what} cannot be decoded: {error}", self._file) from None
