"""Writing rows, row sums, atoms and contributions of one site of one episode.

Rows are one shard, which is one file, whatever the number of replans. zarr-python writes whole shards only: an episode
that is written block by block would have a file for each block, 18 of them where all queries of 104 replans are stored.
Here the chunks of each block go to the end of the file, and the shard's index after the last one (Zarr's
`sharding_indexed` codec). `codecs.py` decides what a chunk is.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray

from vla_attention.capture.store.codecs import RowCodec, create_rows, keys_per_chunk, replans_per_block
from vla_attention.capture.store.replan_records import RecordedRows
from vla_attention.schemas.groupings.key_counts import stored_uniform_of_roles, uniform_of_roles
from vla_attention.schemas.jsonable import to_json
from vla_attention.schemas.layout import SiteLayout
from vla_attention.schemas.precision import FLOAT32_MANTISSA_BITS, to_stored
from vla_attention.schemas.segments import Segment, merge_segments, segment_masses, segment_members, segments_of
from vla_attention.schemas.stores.array_metadata import chunk_file
from vla_attention.schemas.stores.digest import CHECKSUM_BYTES, ArrayDigest, crc32c
from vla_attention.schemas.stores.store_format import (
    ATOM_AXES,
    CONTRIBUTION_AXES,
    ROW_AXES,
    ArrayRecord,
    Recording,
)


class ShardWriter:
    """An array (replan, layer, denoise, ..., key), whose file grows by blocks of replans; one block is in memory."""

    def __init__(
        self, group: zarr.Group, folder: Path, name: str, cells: tuple[int, ...], bits: int, keys: int | None = None
    ) -> None:
        """Begin the array `name` of the episode's `group`, whose folder it is.

        cells: its axes (layer, denoise, ..., key). bits: mantissa bits of its probabilities. keys: of a chunk; all
        unless given.
        """
        self.group = group
        self.name = name
        self.cells = cells
        self.bits = bits
        self.codec = RowCodec.of_bits(bits)
        self.keys = keys or cells[-1]
        self.block = self._replans_per_block()
        self.file = folder / name / chunk_file(1 + len(cells))
        self.file.parent.mkdir()
        self.num_replans = 0
        self.digest = ArrayDigest()
        self._pending: list[NDArray[Any]] = []
        self._index: list[tuple[int, int]] = []
        self._size = 0

    def _replans_per_block(self, count: int | None = None) -> int:
        rest = math.prod(self.cells[2:-1])
        return replans_per_block(self.codec.itemsize * rest * self.cells[-1], rest * self.keys, count)

    def append(self, values: NDArray[np.float32]) -> None:
        """Add the probabilities of the next replan, (layer, denoise, ..., key)."""
        self._pending.append(to_stored(values, self.bits))
        if len(self._pending) == self.block:
            self._flush()

    def _flush(self) -> None:
        values = np.stack(self._pending)
        self._pending.clear()
        if not self.num_replans:
            self.block = self._replans_per_block(len(values))
        num_keys = self.cells[-1]
        # What a chunk has beyond the last replan or key is never read. Beyond the last replan it is the fill value, as
        # zarr-python would write it; in every row zeros take less room.
        chunk = np.full((self.block, *self.cells[2:-1], self.keys), np.nan, dtype=self.codec.dtype)
        with self.file.open("ab") as file:
            for layer, denoise, first in product(*map(range, self.cells[:2]), range(0, num_keys, self.keys)):
                part = values[:, layer, denoise, ..., first : first + self.keys]
                chunk[: len(values), ..., : part.shape[-1]] = part
                chunk[: len(values), ..., part.shape[-1] :] = 0
                encoded = _with_checksum(self.codec.encode(chunk))
                file.write(encoded)
                self._index.append((self._size, len(encoded)))
                self._size += len(encoded)
        self.num_replans += len(values)
        self.digest.update(values)

    def finish(self, axes: Sequence[str]) -> ArrayRecord:
        """Write the index (offset and length of every chunk, in the order of the chunk grid) and the metadata."""
        if self._pending:
            self._flush()
        index = np.array(self._index, dtype="<u8").tobytes()
        with self.file.open("ab") as file:
            file.write(_with_checksum(index))
        shape = (self.num_replans, *self.cells)
        create_rows(self.group, self.name, shape, (self.block, self.keys), axes, self.codec)
        return ArrayRecord(shape, self.digest.hexdigest())


def _with_checksum(content: bytes) -> bytes:
    return content + crc32c(content).to_bytes(CHECKSUM_BYTES, "little")


#: Writes one complete array of the episode: name, values, axes.
WriteArray = Callable[[str, NDArray[np.generic], tuple[str, ...]], None]


class SiteWriter:
    """Collects one site's replans; has at most one block of rows in memory."""

    def __init__(
        self, group: zarr.Group, folder: Path, write: WriteArray, layout: SiteLayout, recording: Recording
    ) -> None:
        """Begin the site's group in the episode's `group`, whose folder it is; `recording` is what is of the site."""
        self.group = group
        self.folder = folder
        self.write = write
        self.layout = layout
        self.recording = recording
        self.shape = (len(recording.layers), len(recording.denoise_steps), len(recording.heads), recording.num_queries)
        self.masses: list[tuple[tuple[Segment, ...], NDArray[np.float32]]] = []
        self.others: list[dict[str, NDArray[Any]]] = []
        self.segments: tuple[Segment, ...] = ()
        group.create_group(layout.name, attributes=to_json(recording.axis_numbers))
        cells, keys = (*self.shape, layout.num_keys), keys_per_chunk(layout)
        self.rows = ShardWriter(group, folder, f"{layout.name}/rows", cells, recording.mantissa_bits, keys)

    def arrays(self, recorded: RecordedRows, key_role: NDArray[np.uint8]) -> dict[str, NDArray[Any]]:
        """Path in the episode -> values of one replan, with an axis of length 1 for it; `append` adds them."""
        uniform = recorded.uniform
        if uniform is None:
            uniform = uniform_of_roles(key_role).astype(np.float32)[None, None, None, None]
        arrays: dict[str, NDArray[Any] | None] = {
            "key_role": key_role,
            "row_sum": recorded.row_sum,
            "uniform": uniform,
            "rows": recorded.rows,
            "contribution": recorded.contribution,
        }
        return {f"{self.layout.name}/{kind}": values[None] for kind, values in arrays.items() if values is not None}

    def append(self, recorded: RecordedRows, key_role: NDArray[np.uint8]) -> None:
        """Add the next replan, whose `arrays` break no rule. Rows as in `RecordedRows`; roles (key,)."""
        segments = segments_of(self.layout, key_role)
        members = segment_members(self.layout, key_role[None], segments)[0]
        # Atoms and sums come from the rows as computed, so that the rounded rows can be compared with them.
        self.masses.append((segments, segment_masses(recorded.rows, members)))
        self.rows.append(recorded.rows)
        arrays = self.arrays(recorded, key_role)
        del arrays[f"{self.layout.name}/rows"]
        self.others.append(arrays)

    def finish(self) -> dict[str, ArrayRecord]:
        """Write the last rows and all other arrays of the site; returns shape and digest of those in shards."""
        if not self.others:
            raise ValueError("an episode without replans cannot be committed")
        name = self.layout.name
        self.segments = merge_segments(self.layout, (segments for segments, _ in self.masses))
        column = {segment: i for i, segment in enumerate(self.segments)}
        columns = [[column[segment] for segment in segments] for segments, _ in self.masses]
        atoms = np.zeros((len(columns), *self.shape, len(column) + 1), dtype=np.float32)
        for replan, (at, (_, masses)) in enumerate(zip(columns, self.masses, strict=True)):
            atoms[replan][..., at] = masses
        atoms[..., -1] = self._of_replans("row_sum")
        self.write(f"{name}/atoms", atoms, ATOM_AXES)
        if self.recording.contributions:
            grams = np.zeros((len(columns), *self.shape[:2], len(column) + 1, len(column) + 1), dtype=np.float32)
            for replan, (at, gram) in enumerate(zip(columns, self._of_replans("contribution"), strict=True)):
                # A segment that a replan lacks contributes nothing there; the last part is the whole attention update.
                parts = np.array([*at, len(column)])
                grams[replan][..., parts[:, None], parts] = gram
            self.write(f"{name}/contribution", grams, CONTRIBUTION_AXES)
        roles = np.stack(self._of_replans("key_role"))
        self.write(f"{name}/key_role", roles, ("replan", "key"))
        return {f"{name}/rows": self.rows.finish(ROW_AXES)} | self._write_uniform(roles)

    def _of_replans(self, kind: str) -> list[NDArray[Any]]:
        return [arrays[f"{self.layout.name}/{kind}"][0] for arrays in self.others]

    def _write_uniform(self, key_role: NDArray[np.uint8]) -> dict[str, ArrayRecord]:
        """Write what uniform attention gives, once along every axis along which it is the same.

        Nothing is written where every query sees all keys that the roles (replan, key) let it see.
        """
        uniforms = self._of_replans("uniform")
        cells = np.broadcast_shapes(*(uniform.shape for uniform in uniforms))
        uniform = np.stack([np.broadcast_to(of_replan, cells) for of_replan in uniforms])
        if (uniform == stored_uniform_of_roles(key_role)).all():
            return {}
        for axis in range(uniform.ndim - 1):
            first = uniform.take([0], axis=axis)
            uniform = first if (uniform == first).all() else uniform
        # In the layout of rows: masks may differ in as many ways, and an analysis reads its layers only.
        name = f"{self.layout.name}/uniform"
        shard = ShardWriter(self.group, self.folder, name, uniform.shape[1:], FLOAT32_MANTISSA_BITS)
        for of_replan in uniform:
            shard.append(of_replan)
        # Axes of one name have one length in a group, or xarray does not open it.
        lengths = zip(ROW_AXES, uniform.shape, (len(uniforms), *self.shape, self.layout.num_keys), strict=True)
        return {name: shard.finish([axis if n == m else f"any_{axis}" for axis, n, m in lengths])}
