"""The disk space and inodes of a run, printed before it: an upper bound, or what was measured on some replans.

What rows, pictures and coverage compress to depends on the policy and the scene, so no formula says it: at 10 mantissa
bits a number takes 1.4 to 2.1 bytes, a picture a third of its pixels or a tenth. `estimate_disk` gives a bound that
needs no policy call. `SampleOfReplans` writes a few replans with the store's own writer, and is within 10 % of what is
written (docs/store.md).
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
from vla_attention.capture.store.replan_records import EpisodeStart, RecordedRows, RecordedSteps, ReplanRecord
from vla_attention.capture.store.store_writer import open_run
from vla_attention.schemas.command_line import format_bytes
from vla_attention.schemas.effects import EffectsRecorded
from vla_attention.schemas.layout import SiteLayout
from vla_attention.schemas.precision import FLOAT32_MANTISSA_BITS
from vla_attention.schemas.stores.store_format import STORE_SUFFIX, Recording, RootAttributes
from vla_attention.schemas.stores.store_place import Room, room_at

#: Exponent bits that differ between probabilities: a float32 in [0, 2) has 0 as its sign and highest exponent bit.
_EXPONENT_BITS = 7
#: Factor by which compression can enlarge numbers that it cannot make smaller.
_INCOMPRESSIBLE = 1.01
#: Header, checksum and place in the index of one chunk.
_CHUNK_OVERHEAD = 40
#: Most segments (keys of one span and one role) that a span has in an episode, where it is more than one.
_SEGMENTS_OF_SPAN = {"text": 6, "latent": 2}
#: One token of a prompt in the attributes, as JSON.
_BYTES_PER_PIECE = 150
#: Object coverage of one patch, compressed: most patches show one object or two.
_COVERAGE_BYTES_PER_PATCH = 8
#: What episodes of so many replans take, as shares of the bound: in `benchmarks/disk_estimate.py` 0.20 to 0.50.
_USUAL = (0.2, 0.5)
#: State, actions and numbers of a replan, and the poses of the steps until the next: 110 numbers a step in LIBERO.
_SMALL_PER_REPLAN = 12_000
#: Words of an instruction, exchanges of them, or objects of a scene, whose effects are measured; LIBERO has up to 20.
_MOST_ITEMS = 25
#: Numbers of an action: arms have 7, two arms 14.
_ACTION_DIMENSIONS = 14
#: Metadata and small arrays of one episode: some fifty files and folders, each at least one block of the file system.
EPISODE_OVERHEAD = 300_000


@dataclass(frozen=True)
class DiskEstimate:
    """Upper bound of a run's size, reached when every episode runs to its last step.

    `inodes_per_episode`: files and folders of an episode, however long it is. `measured`: on replans of this policy
    (`SampleOfReplans`), within 10 %. Otherwise no codec could give more.
    """

    bytes_per_replan: int
    max_replans: int
    num_episodes: int
    inodes_per_episode: int
    episode_overhead: int = EPISODE_OVERHEAD
    measured: bool = False

    @property
    def total_bytes(self) -> int:
        """Bytes of the whole run."""
        return (self.bytes_per_replan * self.max_replans + self.episode_overhead) * self.num_episodes

    @property
    def total_inodes(self) -> int:
        """Files and folders of the whole run."""
        return self.inodes_per_episode * self.num_episodes

    def exceeds(self, room: Room) -> bool:
        """Whether the run may need more than there is."""
        return self.total_bytes > room.bytes or (room.inodes is not None and self.total_inodes > room.inodes)


def bytes_per_number(mantissa_bits: int) -> float:
    """Largest number of stored bytes per recorded float32 at a precision.

    Bit shuffle puts side by side the bits that rounding cleared and those that are the same in all probabilities; there
    they take no space. At worst the others do not compress at all. Rows of trained models take 10 to 25 % less.
    """
    return _INCOMPRESSIBLE * (_EXPONENT_BITS + min(mantissa_bits, FLOAT32_MANTISSA_BITS)) / 8


def estimate_disk(
    recording: Recording, sites: Sequence[SiteLayout], picture_sizes: Sequence[int], replans: int, episodes: int
) -> DiskEstimate:
    """Estimate a run's size; `picture_sizes` are the decoded bytes of each stored camera picture."""
    # A picture may be noise; those that simulators draw take about a third of this.
    total = float(_SMALL_PER_REPLAN) + (_INCOMPRESSIBLE * sum(picture_sizes) if recording.frames else 0)
    if recording.effects is not None:
        total += _bytes_of_effects(recording.effects, recording.num_action_queries, sites)
    for site in sites:
        of_site = recording.of_site(site)
        chunks = len(of_site.layers) * len(of_site.denoise_steps)
        rows_of_site = chunks * len(of_site.heads) * of_site.num_queries
        segments = sum(_SEGMENTS_OF_SPAN.get(span.kind, 1) for span in site.spans)
        total += rows_of_site * site.num_keys * bytes_per_number(recording.mantissa_bits) + chunks * _CHUNK_OVERHEAD
        total += rows_of_site * 4 * (segments + 1) * _INCOMPRESSIBLE + site.num_keys
        # What uniform attention gives is one row a replan where all queries see the same keys.
        total += 4 * site.num_keys * _INCOMPRESSIBLE + _CHUNK_OVERHEAD
        total += chunks * 4 * (segments + 1) ** 2 * _INCOMPRESSIBLE if recording.contributions else 0
        total += sum(_BYTES_PER_PIECE * span.num_keys for span in site.spans if span.kind == "text")
        total += sum(_COVERAGE_BYTES_PER_PATCH * span.num_keys for span in site.spans if span.grid is not None)
    return DiskEstimate(int(total), replans, episodes, _most_inodes(recording, sites, len(picture_sizes)))


def _most_inodes(recording: Recording, sites: Sequence[SiteLayout], pictures: int) -> int:
    """Most files and folders of an episode: an array is a folder with two files, a group a folder with one."""
    effects, frames = recording.effects is not None, pictures if recording.frames else 0
    cameras = sum(span.grid is not None for site in sites for span in site.spans)
    # Of a site: rows, sums, atoms, roles, uniform attention. Once: actions and state, three arrays of the steps.
    arrays = len(sites) * (5 + recording.contributions + effects) + 2 + 3 + frames + cameras + effects
    # The episode, its seal and steps, its sites; pictures twice, objects, effects.
    groups = 3 + len(sites) + (2 if frames else 0) + (1 if cameras else 0) + effects
    return 3 * arrays + 2 * groups


def _bytes_of_effects(effects: EffectsRecorded, horizon: int, sites: Sequence[SiteLayout]) -> float:
    """Bytes of the effects of one replan, with `_MOST_ITEMS` of each kind."""
    cameras = sum(len(site.cameras) for site in sites)
    tokens = sum(span.num_keys for site in sites for span in site.spans if span.kind == "text")
    counts = {"text": _MOST_ITEMS, "cameras": 2 + 2 * cameras, "objects": _MOST_ITEMS, "tokens": tokens}
    entries = len(effects.readers) * sum(counts[item] for item in effects.items) + _MOST_ITEMS
    of_entry = 4 * horizon * _ACTION_DIMENSIONS * _INCOMPRESSIBLE + sum(site.num_keys for site in sites) / 8
    return entries * of_entry / effects.every


def describe(estimate: DiskEstimate, path: Path) -> str:
    """The line printed before a run, with a warning when the disk has less room, or fewer inodes, than that."""
    room, total = room_at(path), estimate.total_bytes
    measured, usual = f", measured, + {format_bytes(estimate.episode_overhead)} each", ""
    if not estimate.measured:
        measured, usual = "", f"; mostly {format_bytes(total * _USUAL[0])} to {format_bytes(total * _USUAL[1])}"
    line = (
        f"Disk: at most {format_bytes(total)} "
        f"({estimate.num_episodes} episodes x up to {estimate.max_replans} replans "
        f"x {format_bytes(estimate.bytes_per_replan)}{measured}){usual}; {estimate.total_inodes:,} files and folders "
        f"({estimate.inodes_per_episode} each); {room.describe()} free."
    )
    if total > room.bytes:
        line += " WARNING: that is more than the disk has room for; record fewer layers, denoise steps or episodes."
    elif estimate.exceeds(room):
        line += " WARNING: that is more files and folders than inodes are free; record fewer episodes, or elsewhere."
    return line


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
    """Bytes of an episode by its number of replans, as measured on a sample of replans, and its files and folders."""

    arrays: Mapping[str, ArraySize]
    inodes: int

    def bytes_of(self, replans: int) -> int:
        """Bytes of an episode of that many replans, everything included."""
        return round(sum(array.bytes_of(replans) for array in self.arrays.values()))

    def estimate(self, replans: int, episodes: int) -> DiskEstimate:
        """Bytes of a run of that many episodes, each of that many replans."""
        fixed = round(sum(array.per_chunk for array in self.arrays.values()))
        per_replan = round((self.bytes_of(replans) - fixed) / max(1, replans))
        return DiskEstimate(per_replan, replans, episodes, self.inodes, episode_overhead=fixed, measured=True)


def mean_size(sizes: Sequence[EpisodeSize]) -> EpisodeSize:
    """Return the mean size of episodes that were measured on different tasks of one run."""
    arrays = {}
    for name in dict.fromkeys(name for size in sizes for name in size.arrays):
        sizes_of_array = [size.arrays[name] for size in sizes if name in size.arrays]
        arrays[name] = ArraySize(
            sum(array.per_chunk for array in sizes_of_array) / len(sizes),
            sum(array.per_replan for array in sizes_of_array) / len(sizes),
            round(sum(array.chunk for array in sizes_of_array) / len(sizes_of_array)),
        )
    return EpisodeSize(arrays, max(size.inodes for size in sizes))


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
    steps: RecordedSteps | None = None

    def size(self, recording: Recording) -> EpisodeSize:
        """Return what episodes take when they are recorded like this; writes the sample into a temporary folder."""
        count = len(self.records)
        if count < FEWEST_REPLANS:
            raise ValueError(f"a sample of {count} replans says nothing; it needs {FEWEST_REPLANS}")
        half = count // 2
        (of_half, _), (of_all, inodes) = self._written(recording, half), self._written(recording, count)
        sizes = {}
        for name, (measured, chunk) in of_all.items():
            before = of_half.get(name, (0, 1))[0]
            slope = max(0.0, (measured - before) / (count - half))
            sizes[name] = ArraySize(max(0.0, measured - slope * count), slope, chunk)
        return EpisodeSize(sizes, inodes)

    def bytes_written(self, recording: Recording) -> int:
        """Return the bytes of one episode of all replans of the sample, when they are recorded like this."""
        return sum(measured for measured, _ in self._written(recording, len(self.records))[0].values())

    def _written(self, recording: Recording, count: int) -> tuple[dict[str, tuple[int, int]], int]:
        full, sites = self.attributes.recording, self.attributes.sites
        records = [smaller_record(record, full, recording, sites) for record in self.records[:count]]
        times = self.denoise_times[_places(full.denoise_steps, recording.denoise_steps)]
        attributes = replace(self.attributes, recording=recording)
        with tempfile.TemporaryDirectory(prefix="vla-size-") as folder:
            path = Path(folder) / f"sample{STORE_SUFFIX}"
            return _write(path, attributes, self.start, times, records, self._steps_of(count))

    def _steps_of(self, count: int) -> RecordedSteps | None:
        """What was told of the steps of the first replans."""
        if self.steps is None:
            return None
        steps = min(count * self.attributes.protocol.replan_steps, len(self.steps.actions))
        said = self.steps.attributes
        said = replace(
            said,
            first_touch=(None,) * len(said.bodies),
            goals=tuple(replace(goal, first_held=None) for goal in said.goals),
        )
        moments = slice(steps + 1)
        return RecordedSteps(said, self.steps.poses[moments], self.steps.gripper[moments], self.steps.actions[:steps])


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
    steps: RecordedSteps | None,
) -> tuple[dict[str, tuple[int, int]], int]:
    """Write one episode; return array -> (its bytes, its replans per chunk), with everything else under ''.

    Also returns the number of its files and folders.
    """
    store = open_run(path, attributes, "new", durable=False)
    with store.episode(start, denoise_times, len(records)) as writer:
        for record in records:
            writer.append(record)
        folder = writer.commit(success=None, num_steps=0 if steps is None else len(steps.actions), steps=steps)
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
    return sizes, 1 + sum(1 for _ in folder.rglob("*"))


def _arrays(group: zarr.Group, above: str = "") -> list[tuple[str, zarr.Array[Any]]]:
    arrays = [(above + name, array) for name, array in group.arrays()]
    for name, inner in group.groups():
        arrays += _arrays(inner, f"{above}{name}/")
    return arrays
