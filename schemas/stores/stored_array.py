"""An array of an episode: its chunks are compared with their checksums, decoded, and put together.

A chunk is read alone where the array's file is a shard of them. zarr-python is not needed: passing chunks through its
event loop takes as long as decoding them.
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
        shape, chunk, grid = self.metadata.shape, self.metadata.chunk_shape, self.metadata.grid
        stop = shape[0] if stop is None else stop
        values = np.empty((stop - first, *shape[1:]), self.metadata.dtype)
        decoded = np.empty(chunk, self.metadata.dtype)
        blocks = range(first // chunk[0], -(-stop // chunk[0]) if values.size else 0)
        for number, place in enumerate(product(blocks, *map(range, grid[1:])), blocks.start * math.prod(grid[1:])):
            self._decode(number, decoded)
            # Where the chunk begins among the wanted values: before them, if only its end is wanted.
            begins = [i * extent for i, extent in zip(place, chunk, strict=True)]
            begins[0] -= first
            into = [slice(max(0, at), at + extent) for at, extent in zip(begins, chunk, strict=True)]
            part = values[tuple(into)]
            skipped = max(0, -begins[0])
            taken = [slice(skipped, skipped + len(part)), *(slice(extent) for extent in part.shape[1:])]
            part[...] = decoded[tuple(taken)]
        return values

    def layers(self, places: Iterable[tuple[int, int]]) -> Iterator[NDArray[np.float32]]:
        """Layers and denoise steps (positions) of an array (replan, layer, denoise, ...), one after the other.

        Each is (replan, ...), and gone when the next one is asked for: all are decoded into the same memory, which
        stays in the processor's cache.

        Raises:
            CorruptEpisode: as `read`, or a chunk holds something else than replans of one layer and denoise step.
        """
        shape, (block, *rest) = self.metadata.shape, self.metadata.chunk_shape
        if len(shape) < 4 or rest != [1, 1, *shape[3:]]:
            raise CorruptEpisode(f"its chunks are {self.metadata.chunk_shape}; expected replans of a layer and step")
        blocks = self.metadata.grid[0]
        memory = np.empty((blocks * block, *shape[3:]), self.metadata.dtype)
        stored = None if self._shard is None else np.empty(self._shard.longest, np.uint8)
        for layer, denoise in places:
            if not (0 <= layer < shape[1] and 0 <= denoise < shape[2]):
                raise IndexError(f"layer {layer} and denoise {denoise} of an array of shape {shape}")
            for i in range(blocks):
                number = (i * shape[1] + layer) * shape[2] + denoise
                self._decode(number, memory[i * block : (i + 1) * block], stored)
            yield memory[: shape[0]]

    def _decode(self, number: int, values: NDArray[Any], stored: Memory | None = None) -> None:
        """Decode a chunk into memory of its size. stored: memory for its encoded bytes."""
        from numcodecs import blosc

        if self._shard is None:
            frame, what = memoryview(self.files.whole(self._file))[:-CHECKSUM_BYTES], "it"
        else:
            frame, what = self._shard.chunk(number, stored).data, f"chunk {number} of it"
        # Blosc leaves what a shorter chunk does not fill as it was. Its header has the decoded size.
        size = int.from_bytes(frame[4:8], "little")
        if size != values.nbytes:
            raise CorruptEpisode(f"{what} decodes to {size} bytes; expected {values.nbytes}", self._file)
        try:
            blosc.decompress(frame, values)
        except (RuntimeError, ValueError) as error:
            raise CorruptEpisode(f"{what} cannot be decoded: {error}", self._file) from None
