"""Writing rows, row sums, atoms and contributions of one site of one episode.

Rows are one shard, which is one file, whatever the number of replans. zarr-python writes whole shards only: an episode
that is written block by block would have a file for each block, 18 of them where all queries of 104 replans are stored.
Here the chunks of each block go to the end of the file, and the shard's index after the last one (Zarr's
`sharding_indexed` codec). `codecs.py` decides what a chunk is.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray

from vla_attention.capture.store.codecs import RowCodec, create_rows, keys_per_chunk, replans_per_block
from vla_attention.capture.store.growing_arrays import GrowingArray, KeptArrays, ShardFile, SpilledArrays
from vla_attention.capture.store.replan_records import RecordedRows
from vla_attention.schemas.groupings.key_counts import stored_uniform_of_roles, uniform_of_roles
from vla_attention.schemas.jsonable import to_json
from vla_attention.schemas.layout import SiteLayout
from vla_attention.schemas.precision import FLOAT32_MANTISSA_BITS, to_stored
from vla_attention.schemas.segments import Segment, merge_segments, segment_masses, segment_members, segments_of
from vla_attention.schemas.stores.digest import ArrayDigest
from vla_attention.schemas.stores.store_format import (
    ATOM_AXES,
    CONTRIBUTION_AXES,
    ROW_AXES,
    ArrayRecord,
    Recording,
)

#: Numbers of more bytes wait on the disk for the rest of their chunks.
_MOST_WAITING = 64 << 20
#: The same of what a replan has beside its rows: until the end of the episode, when its segments are known.
_MOST_BESIDE = 32 << 10


def _waiting(folder: Path, dtype: str, spilled: bool) -> KeptArrays | SpilledArrays:
    return SpilledArrays(folder, dtype) if spilled else KeptArrays()


class ShardWriter:
    """An array (replan, layer, denoise, ..., key), whose file grows by blocks of replans."""

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
        self.file = ShardFile(folder, name, 1 + len(cells))
        self.num_replans = 0
        self.digest = ArrayDigest()
        spilled = self.block * math.prod(cells) * self.codec.itemsize > _MOST_WAITING
        self._waiting = _waiting(folder, self.codec.dtype, spilled)

    def _replans_per_block(self, count: int | None = None) -> int:
        rest = math.prod(self.cells[2:-1])
        return replans_per_block(self.codec.itemsize * rest * self.cells[-1], rest * self.keys, count)

    def append(self, values: NDArray[np.float32]) -> None:
        """Add the probabilities of the next replan, (layer, denoise, ..., key)."""
        stored = to_stored(values, self.bits)
        self.digest.update(stored)
        self._waiting.append(stored)
        if len(self._waiting) == self.block:
            self._flush()

    def _flush(self) -> None:
        count, num_keys = len(self._waiting), self.cells[-1]
        if not self.num_replans:
            self.block = self._replans_per_block(count)
        # What a chunk has beyond the last replan or key is never read. Beyond the last replan it is the fill value, as
        # zarr-python would write it; in every row zeros take less room.
        chunk = np.full((self.block, *self.cells[2:-1], self.keys), np.nan, dtype=self.codec.dtype)
        for cell in product(*map(range, self.cells[:2])):
            values = np.stack([self._waiting.part(replan, *cell) for replan in range(count)])
            for first in range(0, num_keys, self.keys):
                part = values[..., first : first + self.keys]
                chunk[:count, ..., : part.shape[-1]] = part
                chunk[:count, ..., part.shape[-1] :] = 0
                self.file.append(self.codec.encode(chunk))
        self.num_replans += count
        self._waiting.clear()

    def finish(self, axes: Sequence[str]) -> ArrayRecord:
        """Write the index (offset and length of every chunk, in the order of the chunk grid) and the metadata."""
        if self._waiting:
            self._flush()
        self.close()
        self.file.finish()
        shape = (self.num_replans, *self.cells)
        create_rows(self.group, self.name, shape, (self.block, self.keys), axes, self.codec)
        return ArrayRecord(shape, self.digest.hexdigest())

    def close(self) -> None:
        """Give back what waits on the disk."""
        self._waiting.close()


class SiteWriter:
    """Collects one site's replans, with one replan and the chunks that are not full in memory."""

    def __init__(self, group: zarr.Group, folder: Path, layout: SiteLayout, recording: Recording) -> None:
        """Begin the site's group in the episode's `group`, whose folder it is; `recording` is what is of the site."""
        self.group = group
        self.folder = folder
        self.layout = layout
        self.recording = recording
        self.shape = (len(recording.layers), len(recording.denoise_steps), len(recording.heads), recording.num_queries)
        self.segments: tuple[Segment, ...] = ()
        #: Of each replan its own segments, and what uniform attention gives, by its number among the different ones.
        self._segments: list[tuple[Segment, ...]] = []
        self._uniform: list[int] = []
        self._numbers: dict[bytes, int] = {}
        self._uniforms: KeptArrays | SpilledArrays | None = None
        self._roles: list[NDArray[np.uint8]] = []
        #: Of each replan the masses of its segments, with the sums of rows behind them, and its contributions.
        self._beside = _waiting(folder, "<f4", 8 * 4 * math.prod(self.shape) > _MOST_BESIDE)
        group.create_group(layout.name, attributes=to_json(recording.axis_numbers))
        cells, keys = (*self.shape, layout.num_keys), keys_per_chunk(layout)
        self.rows = ShardWriter(group, folder, f"{layout.name}/rows", cells, recording.mantissa_bits, keys)

    def arrays(self, recorded: RecordedRows, key_role: NDArray[np.uint8]) -> dict[str, NDArray[Any]]:
        """Path in the episode -> values of one replan, with an axis of length 1 for it; `append` adds them."""
        arrays: dict[str, NDArray[Any] | None] = {
            "key_role": key_role,
            "row_sum": recorded.row_sum,
            "uniform": self._given_uniform(recorded, key_role),
            "rows": recorded.rows,
            "contribution": recorded.contribution,
        }
        return {f"{self.layout.name}/{kind}": values[None] for kind, values in arrays.items() if values is not None}

    @staticmethod
    def _given_uniform(recorded: RecordedRows, key_role: NDArray[np.uint8]) -> NDArray[np.float32]:
        if recorded.uniform is not None:
            return recorded.uniform
        return uniform_of_roles(key_role).astype(np.float32)[None, None, None, None]

    def append(self, recorded: RecordedRows, key_role: NDArray[np.uint8]) -> None:
        """Add the next replan, whose `arrays` break no rule. Rows as in `RecordedRows`; roles (key,)."""
        segments = segments_of(self.layout, key_role)
        members = segment_members(self.layout, key_role[None], segments)[0]
        # Atoms and sums come from the rows as computed, so that the rounded rows can be compared with them.
        masses = np.asarray(segment_masses(recorded.rows, members), dtype=np.float32)
        self._beside.append(np.concatenate([masses, recorded.row_sum[..., None]], axis=-1))
        if recorded.contribution is not None:
            self._beside.append(recorded.contribution)
        self.rows.append(recorded.rows)
        self._segments.append(segments)
        # Roles and masks are mostly those of the replan before.
        same = bool(self._roles) and np.array_equal(self._roles[-1], key_role)
        self._roles.append(self._roles[-1] if same else key_role.copy())
        uniform = np.ascontiguousarray(self._given_uniform(recorded, key_role))
        known = hashlib.sha256(repr(uniform.shape).encode() + uniform.tobytes()).digest()
        if self._uniforms is None:
            self._uniforms = _waiting(self.folder, "<f4", uniform.nbytes > _MOST_BESIDE)
        if known not in self._numbers:
            self._numbers[known] = len(self._numbers)
            self._uniforms.append(uniform.copy())
        self._uniform.append(self._numbers[known])

    def close(self) -> None:
        """Give back what waits on the disk."""
        for waiting in (self.rows, self._beside, self._uniforms):
            if waiting is not None:
                waiting.close()

    def finish(self) -> dict[str, ArrayRecord]:
        """Write the last rows and all other arrays of the site; returns shapes and digests."""
        if not self._segments:
            raise ValueError("an episode without replans cannot be committed")
        name, written = self.layout.name, dict[str, ArrayRecord]()
        self.segments = merge_segments(self.layout, self._segments)
        column = {segment: i for i, segment in enumerate(self.segments)}
        given = 1 + self.recording.contributions

        def of_replans(kind: str, axes: tuple[str, ...], values_of: Callable[[int, list[int]], NDArray[Any]]) -> None:
            array = GrowingArray(self.group, self.folder, f"{name}/{kind}", axes)
            for replan, segments in enumerate(self._segments):
                array.append(values_of(replan, [*(column[segment] for segment in segments), len(column)])[None])
            written[f"{name}/{kind}"] = array.finish()

        def atoms(replan: int, places: list[int]) -> NDArray[np.float32]:
            values = np.zeros((*self.shape, len(column) + 1), dtype=np.float32)
            values[..., places] = self._beside.part(given * replan)
            return values

        def contributions(replan: int, places: list[int]) -> NDArray[np.float32]:
            # A segment that a replan lacks contributes nothing there; the last part is the whole attention update.
            values, parts = np.zeros((*self.shape[:2], *[len(column) + 1] * 2), dtype=np.float32), np.array(places)
            values[..., parts[:, None], parts] = self._beside.part(given * replan + 1)
            return values

        of_replans("atoms", ATOM_AXES, atoms)
        if self.recording.contributions:
            of_replans("contribution", CONTRIBUTION_AXES, contributions)
        of_replans("key_role", ("replan", "key"), lambda replan, _: self._roles[replan])
        written |= {f"{name}/rows": self.rows.finish(ROW_AXES)} | self._write_uniform()
        self.close()
        return written

    def _write_uniform(self) -> dict[str, ArrayRecord]:
        """Write what uniform attention gives, once along every axis along which it is the same.

        Nothing is written where every query sees all keys that the roles let it see.
        """
        uniforms = self._uniforms
        assert uniforms is not None

        def whole(number: int) -> NDArray[np.float32]:
            return np.broadcast_to(uniforms.part(number), cells)

        cells: tuple[int, ...] = np.broadcast_shapes(*(uniforms.part(number).shape for number in range(len(uniforms))))
        pairs = {(number, roles.tobytes()): roles for number, roles in zip(self._uniform, self._roles, strict=True)}
        if all(
            (whole(number) == stored_uniform_of_roles(roles[None])[0]).all() for (number, _), roles in pairs.items()
        ):
            return {}
        same = [True] * (len(cells) - 1)
        for number in range(len(uniforms)):
            uniform = whole(number)
            same = [one and bool((uniform == uniform.take([0], axis)).all()) for axis, one in enumerate(same)]
        once = tuple(slice(1) if one else slice(None) for one in same)
        alike = all((whole(number) == whole(0)).all() for number in range(1, len(uniforms)))
        numbers = self._uniform[:1] if alike else self._uniform
        # In the layout of rows: masks may differ in as many ways, and an analysis reads its layers only.
        name, lengths = f"{self.layout.name}/uniform", (len(numbers), *whole(0)[once].shape)
        shard = ShardWriter(self.group, self.folder, name, lengths[1:], FLOAT32_MANTISSA_BITS)
        for number in numbers:
            shard.append(whole(number)[once])
        # Axes of one name have one length in a group, or xarray does not open it.
        full = (len(self._uniform), *self.shape, self.layout.num_keys)
        axes = [axis if n == m else f"any_{axis}" for axis, n, m in zip(ROW_AXES, lengths, full, strict=True)]
        return {name: shard.finish(axes)}
