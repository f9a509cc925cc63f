"""Writing rows, row sums, atoms and contributions of one site of one episode.

Rows are one shard, which is one file, whatever the number of replans. zarr-python writes whole shards only: an episode
that is written block by block would have a file for each block, 18 of them where all queries of 104 replans are stored.
Here the chunks of each block go to the end of the file, and the shard's index after the last one (Zarr's
`sharding_indexed` codec). `codecs.py` decides what a chunk is.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray

from vla_attention.capture.store.codecs import create_rows, encode_row_chunk, replans_per_block
from vla_attention.capture.store.replan_records import RecordedRows
from vla_attention.schemas.groupings.key_counts import uniform_of_roles
from vla_attention.schemas.jsonable import to_json
from vla_attention.schemas.layout import SiteLayout
from vla_attention.schemas.precision import round_mantissa
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
    """A float32 array (replan, layer, denoise, ...), whose file grows by blocks of replans; one block is in memory."""

    def __init__(self, group: zarr.Group, folder: Path, name: str, cells: tuple[int, ...]) -> None:
        """Begin the array `name` of the episode's `group`, whose folder it is; `cells` are its axes (layer, ...)."""
        self.group = group
        self.name = name
        self.cells = cells
        self.bytes_per_replan = 4 * math.prod(cells[2:])
        self.block = replans_per_block(self.bytes_per_replan)
        self.file = folder / name / chunk_file(1 + len(cells))
        self.file.parent.mkdir()
        self.num_replans = 0
        self.digest = ArrayDigest()
        self._pending: list[NDArray[np.float32]] = []
        self._index: list[tuple[int, int]] = []
        self._size = 0

    def append(self, values: NDArray[np.float32]) -> None:
        """Add the next replan, (layer, denoise, ...)."""
        self._pending.append(values)
        if len(self._pending) == self.block:
            self._flush()

    def _flush(self) -> None:
        values = np.stack(self._pending)
        self._pending.clear()
        if not self.num_replans:
            self.block = replans_per_block(self.bytes_per_replan, len(values))
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
        self.digest.update(values)

    def finish(self, axes: Sequence[str]) -> ArrayRecord:
        """Write the index (offset and length of every chunk, in the order of the chunk grid) and the metadata."""
        if self._pending:
            self._flush()
        index = np.array(self._index, dtype="<u8").tobytes()
        with self.file.open("ab") as file:
            file.write(_with_checksum(index))
        shape = (self.num_replans, *self.cells)
        create_rows(self.group, self.name, shape, self.block, axes)
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
        self.rows = ShardWriter(group, folder, f"{layout.name}/rows", (*self.shape, layout.num_keys))

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
        self.rows.append(round_mantissa(recorded.rows, self.recording.mantissa_bits))
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
        atoms = np.zeros((len(columns), *self.shape, len(column)), dtype=np.float32)
        for replan, (at, (_, masses)) in enumerate(zip(columns, self.masses, strict=True)):
            atoms[replan][..., at] = masses
        self.write(f"{name}/atoms", atoms, ATOM_AXES)
        if self.recording.contributions:
            grams = np.zeros((len(columns), *self.shape[:2], len(column) + 1, len(column) + 1), dtype=np.float32)
            for replan, (at, gram) in enumerate(zip(columns, self._of_replans("contribution"), strict=True)):
                # A segment that a replan lacks contributes nothing there; the last part is the whole attention update.
                parts = np.array([*at, len(column)])
                grams[replan][..., parts[:, None], parts] = gram
            self.write(f"{name}/contribution", grams, CONTRIBUTION_AXES)
        self.write(f"{name}/row_sum", np.stack(self._of_replans("row_sum")), ROW_AXES[:-1])
        self.write(f"{name}/key_role", np.stack(self._of_replans("key_role")), ("replan", "key"))
        return {f"{name}/rows": self.rows.finish(ROW_AXES), f"{name}/uniform": self._write_uniform()}

    def _of_replans(self, kind: str) -> list[NDArray[Any]]:
        return [arrays[f"{self.layout.name}/{kind}"][0] for arrays in self.others]

    def _write_uniform(self) -> ArrayRecord:
        """Write what uniform attention gives, once along every axis along which it is the same."""
        uniforms = self._of_replans("uniform")
        cells = np.broadcast_shapes(*(uniform.shape for uniform in uniforms))
        uniform = np.stack([np.broadcast_to(of_replan, cells) for of_replan in uniforms])
        for axis in range(uniform.ndim - 1):
            first = uniform.take([0], axis=axis)
            uniform = first if (uniform == first).all() else uniform
        # In the layout of rows: masks may differ in as many ways, and an analysis reads its layers only.
        shard = ShardWriter(self.group, self.folder, f"{self.layout.name}/uniform", uniform.shape[1:])
        for of_replan in uniform:
            shard.append(of_replan)
        # Axes of one name have one length in a group, or xarray does not open it.
        lengths = zip(ROW_AXES, uniform.shape, (len(uniforms), *self.shape, self.layout.num_keys), strict=True)
        return shard.finish([axis if n == m else f"any_{axis}" for axis, n, m in lengths])
