"""Writing rows, row sums, atoms and contributions of one site of one episode.

Rows are one shard, which is one file, whatever the number of replans. zarr-python writes whole shards only: an episode
that is written block by block would have a file for each block, 18 of them where all queries of 104 replans are stored.
Here the chunks of each block go to the end of the file, and the shard's index after the last one (Zarr's
`sharding_indexed` codec). `codecs.py` decides what a chunk is.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import DTypeLike, NDArray

from vla_attention.capture.store.codecs import create_rows, encode_row_chunk, replans_per_block
from vla_attention.capture.store.replan_records import RecordedRows
from vla_attention.schemas.groupings.key_counts import uniform_of_roles
from vla_attention.schemas.jsonable import to_json
from vla_attention.schemas.layout import ROLE_DTYPE, Prompt, SiteLayout
from vla_attention.schemas.precision import FLOAT32_MANTISSA_BITS, round_mantissa
from vla_attention.schemas.segments import Segment, merge_segments, segment_masses, segment_members, segments_of
from vla_attention.schemas.stores.array_metadata import chunk_file
from vla_attention.schemas.stores.content_rules import (
    absent_problems,
    gram_problems,
    piece_role_problems,
    role_problems,
    row_problems,
    row_sum_problems,
    uniform_problems,
    unseen_problems,
)
from vla_attention.schemas.stores.digest import CHECKSUM_BYTES, ArrayDigest, crc32c
from vla_attention.schemas.stores.store_format import (
    ATOM_AXES,
    CONTRIBUTION_AXES,
    ROW_AXES,
    ArrayRecord,
    Recording,
)


class ShardWriter:
    """The file of a float32 array (replan, layer, denoise, ...), which grows by blocks of replans."""

    def __init__(self, folder: Path, cells: tuple[int, ...], block: int) -> None:
        """Begin the file in the array's folder; `cells` are its axes (layer, ...), `block` the replans of a chunk."""
        folder.mkdir()
        self.file = folder / chunk_file(1 + len(cells))
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


#: Writes one complete array of the episode: name, values, axes.
WriteArray = Callable[[str, NDArray[np.generic], tuple[str, ...]], None]


class SiteWriter:
    """Collects one site's replans; has at most one block of rows in memory."""

    def __init__(
        self,
        group: zarr.Group,
        folder: Path,
        write: WriteArray,
        layout: SiteLayout,
        recording: Recording,
    ) -> None:
        """Begin the site's group in the episode's `group`, whose folder it is; `recording` is what is of the site."""
        self.group = group
        self.folder = folder
        self.write = write
        self.layout = layout
        self.recording = recording
        self.bits = recording.mantissa_bits
        self.shape = (len(recording.layers), len(recording.denoise_steps), len(recording.heads), recording.num_queries)
        self.bytes_per_replan = 4 * self.shape[2] * self.shape[3] * layout.num_keys
        self.block = replans_per_block(self.bytes_per_replan)
        self.rows: ShardWriter | None = None
        self.rows_digest = ArrayDigest()
        self.pending: list[NDArray[np.float32]] = []
        self.row_sums: list[NDArray[np.float32]] = []
        self.roles: list[NDArray[np.uint8]] = []
        self.masses: list[tuple[tuple[Segment, ...], NDArray[np.float32]]] = []
        self.contributions: list[NDArray[np.float32]] = []
        self.uniforms: list[NDArray[np.float32]] = []
        self.segments: tuple[Segment, ...] = ()
        group.create_group(layout.name, attributes=to_json(recording.axis_numbers))

    def problems(
        self, recorded: RecordedRows, key_role: NDArray[np.uint8], prompt: Prompt, replan: int, *, only_site: bool
    ) -> Iterator[str]:
        """What forbids adding a replan: shapes, types, and the rules of `verify`.

        prompt: of the replan, at this site. only_site: no other has text. replan: its number, for the sentences.
        """
        name, recording = self.layout.name, self.recording
        rows, gram = recorded.rows, recorded.contribution
        wanted = (*self.shape, self.layout.num_keys)
        faults = [
            *_array_faults(f"{name}/rows", rows, wanted, np.float32),
            *_array_faults(f"{name}/row_sum", recorded.row_sum, self.shape, np.float32),
            *_array_faults(f"{name}/key_role", key_role, wanted[-1:], ROLE_DTYPE),
        ] or list(role_problems(self.layout, key_role[None], replan))
        if (gram is None) is recording.contributions:
            faults.append(f"{name} has {'no' if gram is None else 'unplanned'} contributions")
        elif gram is not None and not faults:
            parts = len(segments_of(self.layout, key_role)) + 1
            faults += _array_faults(f"{name}/contribution", gram, (*self.shape[:2], parts, parts), np.float32)
        uniform = _uniform(recorded, key_role)
        if uniform.ndim != rows.ndim or not all(
            given in (1, length) for given, length in zip(uniform.shape, wanted, strict=True)
        ):
            faults.append(f"{name}/uniform has the shape {uniform.shape}; expected {wanted}, or 1 in place of a length")
        if faults:
            yield from faults  # the numbers of wrong shapes have no places that could be named
            return
        # `recorded.rows` are as computed: no rounding yet.
        yield from row_problems(
            f"{name}/rows", rows[None], recorded.row_sum[None], recording, FLOAT32_MANTISSA_BITS, replan
        )
        yield from row_sum_problems(f"{name}/row_sum", recorded.row_sum[None], recording, replan)
        yield from absent_problems(self.layout, rows[None], key_role[None], recording, replan)
        yield from uniform_problems(f"{name}/uniform", uniform[None], replan)
        if gram is not None:
            yield from gram_problems(f"{name}/contribution", gram[None], recording, replan)
        yield from piece_role_problems(self.layout, key_role, prompt, replan, only_site=only_site)
        yield from unseen_problems(f"{name}/rows", rows[None], uniform[None], recording, replan)

    def append(self, recorded: RecordedRows, key_role: NDArray[np.uint8]) -> None:
        """Add the next replan, in which `problems` found nothing. Rows as in `RecordedRows`; roles (key,)."""
        segments = segments_of(self.layout, key_role)
        members = segment_members(self.layout, key_role[None], segments)[0]
        if recorded.contribution is not None:
            self.contributions.append(recorded.contribution)
        # Atoms and sums come from the rows as computed, so that the rounded rows can be compared with them.
        self.masses.append((segments, segment_masses(recorded.rows, members)))
        self.row_sums.append(recorded.row_sum)
        self.roles.append(key_role)
        self.uniforms.append(_uniform(recorded, key_role))
        self.pending.append(round_mantissa(recorded.rows, self.bits))
        if len(self.pending) == self.block:
            self._flush()

    def _flush(self) -> None:
        rows = np.stack(self.pending)
        self.pending.clear()
        if self.rows is None:
            block = replans_per_block(self.bytes_per_replan, len(rows))
            self.rows = ShardWriter(self.folder / self.layout.name / "rows", rows.shape[1:], block)
        self.rows.append(rows)
        self.rows_digest.update(rows)

    def finish(self) -> dict[str, ArrayRecord]:
        """Write the last rows and all other arrays of the site; returns shape and digest of those in shards."""
        if self.pending:
            self._flush()
        if self.rows is None:
            raise ValueError("an episode without replans cannot be committed")
        self.rows.finish()
        name, rows = self.layout.name, self.rows
        create_rows(self.group, f"{name}/rows", rows.shape, rows.block, ROW_AXES)
        self.segments = merge_segments(self.layout, (segments for segments, _ in self.masses))
        column = {segment: i for i, segment in enumerate(self.segments)}
        atoms = np.zeros((rows.num_replans, *self.shape, len(self.segments)), dtype=np.float32)
        for replan, (segments, masses) in enumerate(self.masses):
            atoms[replan][..., [column[segment] for segment in segments]] = masses
        self.write(f"{name}/atoms", atoms, ATOM_AXES)
        if self.contributions:
            self._write_contributions(column)
        uniform = self._write_uniform()
        self.write(f"{name}/row_sum", np.stack(self.row_sums), ROW_AXES[:-1])
        self.write(f"{name}/key_role", np.stack(self.roles), ("replan", "key"))
        return {f"{name}/rows": ArrayRecord(rows.shape, self.rows_digest.hexdigest()), f"{name}/uniform": uniform}

    def _write_uniform(self) -> ArrayRecord:
        """Write what uniform attention gives, once along every axis along which it is the same."""
        cells = np.broadcast_shapes(*(uniform.shape for uniform in self.uniforms))
        uniform = np.stack([np.broadcast_to(of_replan, cells) for of_replan in self.uniforms])
        for axis in range(uniform.ndim - 1):
            first = uniform.take([0], axis=axis)
            uniform = first if (uniform == first).all() else uniform
        # In the layout of rows: masks may differ in as many ways, and an analysis reads its layers only.
        name, shape = f"{self.layout.name}/uniform", uniform.shape
        block = replans_per_block(4 * int(np.prod(shape[3:])), len(uniform))
        shard = ShardWriter(self.folder / name, shape[1:], block)
        for first_replan in range(0, len(uniform), block):
            shard.append(uniform[first_replan : first_replan + block])
        shard.finish()
        # Axes of one name have one length in a group, or xarray does not open it.
        lengths = (len(self.roles), *self.shape, self.layout.num_keys)
        axes = [axis if n == m else f"any_{axis}" for axis, n, m in zip(ROW_AXES, shape, lengths, strict=True)]
        create_rows(self.group, name, shape, block, axes)
        digest = ArrayDigest()
        digest.update(uniform)
        return ArrayRecord(shape, digest.hexdigest())

    def _write_contributions(self, column: dict[Segment, int]) -> None:
        size = len(column) + 1
        grams = np.zeros((len(self.masses), *self.shape[:2], size, size), dtype=np.float32)
        for replan, ((segments, _), gram) in enumerate(zip(self.masses, self.contributions, strict=True)):
            # A segment that a replan lacks contributes nothing there; the last part is the whole attention update.
            at = [*(column[segment] for segment in segments), size - 1]
            grams[replan][..., np.ix_(at, at)[0], np.ix_(at, at)[1]] = gram
        self.write(f"{self.layout.name}/contribution", grams, CONTRIBUTION_AXES)


def _uniform(recorded: RecordedRows, key_role: NDArray[np.uint8]) -> NDArray[np.float32]:
    """`RecordedRows.uniform`, made from the roles (key,) where it is None."""
    if recorded.uniform is not None:
        return recorded.uniform
    return uniform_of_roles(key_role).astype(np.float32)[None, None, None, None]


def _array_faults(name: str, values: NDArray[Any], shape: tuple[int, ...], dtype: DTypeLike) -> Iterator[str]:
    if (values.shape, values.dtype) != (shape, np.dtype(dtype)):
        yield f"{name} has the shape {values.shape} and type {values.dtype}; expected {shape} and {np.dtype(dtype)}"
