"""How many bytes an episode takes, measured: a sample of replans is written with the store's own writer.

What rows, pictures and coverage compress to depends on the policy and the scene, so no formula says it: at 10 mantissa
bits a number takes 1.4 to 2.1 bytes, a picture a third of its pixels or a tenth. `estimate_disk` gives a bound that
needs no policy call; the numbers here need a few, and are within 10 % of what is written (docs/store.md).
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray

from vla_attention.capture.store.codecs import TARGET_CHUNK_BYTES
from vla_attention.capture.store.disk_estimate import DiskEstimate
from vla_attention.capture.store.episode_writer import EpisodeStart, ReplanRecord
from vla_attention.capture.store.recorded_rows import RecordedRows
from vla_attention.capture.store.store_writer import open_run
from vla_attention.schemas.layout import SiteLayout
from vla_attention.schemas.stores.store_format import STORE_SUFFIX, Recording, RootAttributes

#: Fewest replans of a sample: it is written once as it is and once by half, and the difference is what replans take.
FEWEST_REPLANS = 2


@dataclass(frozen=True)
class ArraySize:
    """Bytes of one array: `per_chunk` for each of its chunks along the replans, and `per_replan`.

    A chunk's own bytes are more than its header where replans resemble each other: of pictures in front of one
    background, the first in a chunk takes more than those that follow. `chunk`: replans in a chunk of a long episode.
    """

    per_chunk: float
    per_replan: float
    chunk: int

    def bytes_of(self, replans: int) -> float:
        """Bytes of the array in an episode of that many replans."""
        return self.per_chunk * math.ceil(replans / self.chunk) + self.per_replan * replans


@dataclass(frozen=True)
class EpisodeSize:
    """Bytes of an episode by its number of replans, as measured on a sample of replans."""

    arrays: Mapping[str, ArraySize]

    def bytes_of(self, replans: int) -> int:
        """Bytes of an episode of that many replans, everything included."""
        return round(sum(array.bytes_of(replans) for array in self.arrays.values()))

    def estimate(self, replans: int, episodes: int) -> DiskEstimate:
        """Bytes of a run of that many episodes, each of that many replans."""
        fixed = round(sum(array.per_chunk for array in self.arrays.values()))
        per_replan = round((self.bytes_of(replans) - fixed) / max(1, replans))
        return DiskEstimate(per_replan, replans, episodes, episode_overhead=fixed, measured=True)


def mean_size(sizes: Sequence[EpisodeSize]) -> EpisodeSize:
    """Return the mean size of episodes that were measured on different tasks of one run."""
    arrays = {}
    for name in dict.fromkeys(name for size in sizes for name in size.arrays):
        found = [size.arrays[name] for size in sizes if name in size.arrays]
        arrays[name] = ArraySize(
            sum(array.per_chunk for array in found) / len(sizes),
            sum(array.per_replan for array in found) / len(sizes),
            round(sum(array.chunk for array in found) / len(found)),
        )
    return EpisodeSize(arrays)


@dataclass(frozen=True)
class SampleOfReplans:
    """Replans of one episode, recorded in full precision.

    `attributes`: of the run. Its recording has at least the layers, denoise steps and heads of every recording whose
    size is asked for.
    """

    attributes: RootAttributes
    start: EpisodeStart
    denoise_times: NDArray[np.float64]
    records: Sequence[ReplanRecord]

    def size(self, recording: Recording) -> EpisodeSize:
        """Return what episodes take when they are recorded like this; writes the sample into a temporary folder."""
        count = len(self.records)
        if count < FEWEST_REPLANS:
            raise ValueError(f"a sample of {count} replans says nothing; it needs {FEWEST_REPLANS}")
        half = count // 2
        of_half, of_all = self._written(recording, half), self._written(recording, count)
        sizes = {}
        for name, (measured, chunk) in of_all.items():
            before = of_half.get(name, (0, 1))[0]
            slope = max(0.0, (measured - before) / (count - half))
            sizes[name] = ArraySize(max(0.0, measured - slope * count), slope, chunk)
        return EpisodeSize(sizes)

    def bytes_written(self, recording: Recording) -> int:
        """Return the bytes of one episode of all replans of the sample, when they are recorded like this."""
        return sum(measured for measured, _ in self._written(recording, len(self.records)).values())

    def _written(self, recording: Recording, count: int) -> dict[str, tuple[int, int]]:
        full, sites = self.attributes.recording, self.attributes.sites
        records = [smaller_record(record, full, recording, sites) for record in self.records[:count]]
        times = self.denoise_times[_places(full.denoise_steps, recording.denoise_steps)]
        attributes = replace(self.attributes, recording=recording)
        with tempfile.TemporaryDirectory(prefix="vla-size-") as folder:
            return _write(Path(folder) / f"sample{STORE_SUFFIX}", attributes, self.start, times, records)


def smaller_record(
    record: ReplanRecord, full: Recording, wanted: Recording, sites: Sequence[SiteLayout]
) -> ReplanRecord:
    """Return what a recording of fewer layers, denoise steps or heads would have had of a replan."""
    rows = {}
    for site in sites:
        given, chosen, recorded = full.of_site(site), wanted.of_site(site), record.rows[site.name]
        layers, steps = _places(given.layers, chosen.layers), _places(given.denoise_steps, chosen.denoise_steps)
        heads = _places(given.heads, chosen.heads)
        gram = recorded.contribution if wanted.contributions else None
        rows[site.name] = RecordedRows(
            recorded.rows[np.ix_(layers, steps, heads)],
            recorded.row_sum[np.ix_(layers, steps, heads)],
            None if gram is None else gram[np.ix_(layers, steps)],
        )
    return replace(record, rows=rows)


def _places(given: Sequence[int], wanted: Sequence[int]) -> list[int]:
    return [given.index(number) for number in wanted]


def _write(
    path: Path,
    attributes: RootAttributes,
    start: EpisodeStart,
    denoise_times: NDArray[np.float64],
    records: Sequence[ReplanRecord],
) -> dict[str, tuple[int, int]]:
    """Write one episode; return array -> (its bytes, its replans per chunk), with everything else under ''."""
    store = open_run(path, attributes, "new", durable=False)
    with store.episode(start, denoise_times, len(records)) as writer:
        for record in records:
            writer.append(record)
        folder = writer.commit(success=None, num_steps=0)
    sizes = {}
    for name, array in _arrays(zarr.open_group(folder, mode="r")):
        # Its metadata is not among its chunks, and counts with everything else.
        files = [file for file in (folder / name).rglob("*") if file.is_file() and file.name != "zarr.json"]
        measured = sum(file.stat().st_size for file in files)
        of_replan = math.prod(array.chunks[1:]) * array.dtype.itemsize
        sizes[name] = (measured, max(1, TARGET_CHUNK_BYTES // max(1, of_replan)))
    everything = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
    # What a long episode repeats with every replan here are its prompts; there is one such part per episode.
    sizes[""] = (everything - sum(measured for measured, _ in sizes.values()), 1 << 62)
    return sizes


def _arrays(group: zarr.Group, above: str = "") -> list[tuple[str, zarr.Array[Any]]]:
    found = [(above + name, array) for name, array in group.arrays()]
    for name, inner in group.groups():
        found += _arrays(inner, f"{above}{name}/")
    return found
