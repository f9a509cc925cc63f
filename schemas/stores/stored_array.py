"""An array of an episode: its chunks are compared with the seal, decoded, and put together.

A chunk is read alone where the array's file is a shard of them (Zarr's `sharding_indexed` codec). Nothing that a file
says is believed: index and checksum of each chunk are compared with the seal, the chunk with its checksum, and the
header of each compressed chunk with the size of the decoded one. A frame of Blosc that says it holds fewer bytes than
the chunk would otherwise leave the rest of the memory as it was, and bytes of the process would pass for attention.
zarr-python is not needed: passing chunks through its event loop takes as long as decoding them.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vla_attention.schemas.cached_property import cached_property
from vla_attention.schemas.limit_checks import TooLarge, check_decoded
from vla_attention.schemas.limits import WHOLE_FILE_BYTES
from vla_attention.schemas.stores.array_metadata import ArrayMetadata
from vla_attention.schemas.stores.byte_source import Memory
from vla_attention.schemas.stores.digest import CHECKSUM_BYTES
from vla_attention.schemas.stores.sealed_files import SealedFiles
from vla_attention.schemas.stores.shards import SealedShard
from vla_attention.schemas.stores.store_format import CorruptEpisode

#: The header of a Blosc frame: format, version of the codec, flags, typesize; decoded bytes, bytes of a block, bytes of
#: the frame (c-blosc, README_CHUNK_FORMAT.rst).
_BLOSC_HEADER = struct.Struct("<BBBBIII")


@dataclass(frozen=True)
class StoredArray:
    """An array of an episode.

    Attributes:
        name: its path in the episode.
        metadata: what its checked `zarr.json` says.
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
        # Blosc keeps what it cannot compress as it is.
        most = self.metadata.chunk_bytes + _BLOSC_HEADER.size + CHECKSUM_BYTES
        return None if count is None else self.files.shard(self._file, count, most)

    def check_memory(self, what: str, decoded: int) -> None:
        """Raise `CorruptEpisode` when `what` would take more memory than the array's file can hold."""
        try:
            check_decoded(what, decoded, self.files.record(self._file).size)
        except TooLarge as error:
            raise CorruptEpisode(str(error)) from None

    def read(self, first: int = 0, stop: int | None = None) -> NDArray[Any]:
        """Values from one index along the first axis to another one; all of them without.

        Raises:
            CorruptEpisode: a chunk is missing, is not the one that was sealed, or decodes to another size.
        """
        shape, chunk, grid = self.metadata.shape, self.metadata.chunk_shape, self.metadata.grid
        stop = shape[0] if stop is None else stop
        wanted = (stop - first, *shape[1:])
        itemsize = self.metadata.dtype.itemsize
        if not math.prod(wanted):
            return np.empty(wanted, self.metadata.dtype)
        self.check_memory("it", itemsize * math.prod(wanted))
        self.check_memory("a chunk of it", self.metadata.chunk_bytes)
        values, decoded = np.empty(wanted, self.metadata.dtype), np.empty(chunk, self.metadata.dtype)
        blocks = range(first // chunk[0], -(-stop // chunk[0]))
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

    def layers(
        self, places: Iterable[tuple[int, int]], memory: NDArray[np.float32] | None = None
    ) -> Iterator[NDArray[np.float32]]:
        """Layers and denoise steps (positions) of an array (replan, layer, denoise, ...), one after the other.

        Each is (replan, ...), and gone when the next one is asked for: all are decoded into the same memory, which
        stays in the processor's cache.

        Args:
            places: layer and denoise step of each.
            memory: see `layer_memory`, which is made unless it is given.

        Raises:
            CorruptEpisode: as `read`, or a chunk holds something else than replans of one layer and denoise step.
        """
        shape, (block, *rest) = self.metadata.shape, self.metadata.chunk_shape
        if len(shape) < 4 or rest != [1, 1, *shape[3:]]:
            raise CorruptEpisode(f"its chunks are {self.metadata.chunk_shape}; expected replans of a layer and step")
        memory = self.layer_memory() if memory is None else memory
        stored = None if self._shard is None else np.empty(self._shard.longest, np.uint8)
        for layer, denoise in places:
            if not (0 <= layer < shape[1] and 0 <= denoise < shape[2]):
                raise IndexError(f"layer {layer} and denoise {denoise} of an array of shape {shape}")
            for i in range(len(memory) // block):
                number = (i * shape[1] + layer) * shape[2] + denoise
                self._decode(number, memory[i * block : (i + 1) * block], stored)
            yield memory[: shape[0]]

    def layer_memory(self) -> NDArray[np.float32]:
        """Memory for `layers`: whole chunks of one layer and denoise step, (replans of all chunks, ...)."""
        shape = (self.metadata.grid[0] * self.metadata.chunk_shape[0], *self.metadata.shape[3:])
        self.check_memory("a layer of it", self.metadata.dtype.itemsize * math.prod(shape))
        return np.empty(shape, self.metadata.dtype)

    def _decode(self, number: int, values: NDArray[Any], stored: Memory | None = None) -> None:
        """Decode a chunk into memory of its size. stored: memory for its encoded bytes."""
        from numcodecs import blosc

        if self._shard is None:
            frame, what = memoryview(self.files.whole(self._file, WHOLE_FILE_BYTES))[:-CHECKSUM_BYTES], "it"
        else:
            frame, what = self._shard.chunk(number, stored).data, f"chunk {number} of it"
        try:
            check_blosc_frame(frame, values.nbytes, self.metadata.typesize)
            blosc.decompress(frame, values)
        except (CorruptEpisode, RuntimeError, ValueError) as error:
            raise CorruptEpisode(f"{what} cannot be decoded: {error}", self._file) from None


def check_blosc_frame(frame: memoryview, decoded_bytes: int, typesize: int) -> None:
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
