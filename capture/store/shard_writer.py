"""Writing the rows of an episode as one shard, which is one file, whatever the number of replans.

zarr-python writes whole shards only: an episode that is written block by block would have a file for each block, 18 of
them where all queries of 104 replans are stored. Here the chunks of each block go to the end of the file, and the
shard's index after the last one (Zarr's `sharding_indexed` codec). `codecs.py` decides what a chunk is.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vla_attention.capture.store.codecs import CHUNK_KEYS, encode_row_chunk
from vla_attention.schemas.stores.digest import crc32c
from vla_attention.schemas.stores.shards import CHECKSUM_BYTES, chunk_file


class ShardWriter:
    """The file of a float32 array (replan, layer, denoise, ...), which grows by blocks of replans."""

    def __init__(self, folder: Path, cells: tuple[int, ...], block: int) -> None:
        """Begin the file in the array's folder; `cells` are its axes (layer, ...), `block` the replans of a chunk."""
        folder.mkdir()
        self.file = folder / chunk_file(CHUNK_KEYS, (0,) * (1 + len(cells)))
        self.cells = cells
        self.block = block
        self.num_replans = 0
        self._index: list[tuple[int, int]] = []
        self._size = 0

    @property
    def shape(self) -> tuple[int, ...]:
        """The array's shape so far."""
        return (self.num_replans, *self.cells)

    def append(self, values: NDArray[np.float32]) -> None:
        """Write the next block, (replan, layer, denoise, ...); only the last may have fewer replans than `block`."""
        # What a last block lacks is never read; it has the fill value, as zarr-python would write it.
        chunk = np.full((self.block, *self.cells[2:]), np.nan, dtype="<f4")
        with self.file.open("ab") as file:
            for layer in range(self.cells[0]):
                for denoise in range(self.cells[1]):
                    chunk[: len(values)] = values[:, layer, denoise]
                    encoded = _with_checksum(encode_row_chunk(chunk))
                    file.write(encoded)
                    self._index.append((self._size, len(encoded)))
                    self._size += len(encoded)
        self.num_replans += len(values)

    def finish(self) -> None:
        """Write the index: offset and length of every chunk, in the order of the chunk grid."""
        index = np.array(self._index, dtype="<u8").tobytes()
        with self.file.open("ab") as file:
            file.write(_with_checksum(index))


def _with_checksum(content: bytes) -> bytes:
    return content + crc32c(content).to_bytes(CHECKSUM_BYTES, "little")
