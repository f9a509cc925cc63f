"""Reading an array that is one chunk in one file, as most arrays of an episode are, without zarr-python.

Passing one small chunk through zarr's event loop takes 0.6 ms, decoding it a tenth of that; an analysis opens hundreds
of episodes with several such arrays each. This reader handles what `write_whole` of `capture/store/codecs.py` writes;
an array of any other layout is read with zarr-python.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numcodecs import blosc
from numpy.typing import NDArray

from vla_attention.schemas.limits import WHOLE_FILE_BYTES
from vla_attention.schemas.stores.array_metadata import TYPES
from vla_attention.schemas.stores.digest import crc32c
from vla_attention.schemas.stores.sealed_files import SealedFiles
from vla_attention.schemas.stores.shards import CHECKSUM_BYTES, check_blosc_frame, chunk_file
from vla_attention.schemas.stores.store_format import CorruptEpisode


@dataclass(frozen=True)
class SingleChunk:
    """An array that is one chunk in one file, read when it is indexed.

    Attributes:
        files: the files of the episode.
        file: path of the array's file in the episode.
        shape: shape of the array and of its chunk.
        dtype: its numbers, little endian.
        typesize: bytes that the codec shuffles together.
    """

    files: SealedFiles
    file: str
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    typesize: int

    @classmethod
    def of(cls, metadata: dict[str, Any], files: SealedFiles, name: str) -> SingleChunk | None:
        """The array `name`, or None when its metadata (its `zarr.json`) describe another layout, or none."""
        try:
            shape, codecs = tuple(metadata["shape"]), metadata["codecs"]
            known = (
                metadata["data_type"] in TYPES
                and tuple(metadata["chunk_grid"]["configuration"]["chunk_shape"]) == shape
                and not metadata.get("storage_transformers")
                and [codec["name"] for codec in codecs] == ["bytes", "blosc", "crc32c"]
                and codecs[0].get("configuration", {}).get("endian", "little") == "little"
            )
            if not known:
                return None
            typesize = codecs[1]["configuration"]["typesize"]
            file = chunk_file(metadata["chunk_key_encoding"], (0,) * len(shape))
        except (AttributeError, IndexError, KeyError, TypeError, ValueError):
            return None  # zarr says what is wrong with them
        dtype = np.dtype(metadata["data_type"]).newbyteorder("<")
        return cls(files, f"{name}/{file}", shape, dtype, typesize)

    def __getitem__(self, index: Any) -> NDArray[Any]:
        """Values at a numpy index; raises `CorruptEpisode` for other bytes than were sealed, and for other sizes."""
        content = self.files.whole(self.file, WHOLE_FILE_BYTES)
        frame, checksum = content[:-CHECKSUM_BYTES], content[-CHECKSUM_BYTES:]
        if crc32c(frame) != int.from_bytes(checksum, "little"):
            raise CorruptEpisode(f"the checksum of its {self.file} does not fit", self.file)
        values = np.empty(self.shape, self.dtype)
        try:
            check_blosc_frame(frame, values.nbytes, self.typesize)
            blosc.decompress(frame, values)
        except (CorruptEpisode, RuntimeError, ValueError) as error:
            raise CorruptEpisode(f"its {self.file} cannot be decoded: {error}", self.file) from None
        found: NDArray[Any] = values[index]
        return found
