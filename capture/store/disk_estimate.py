"""The disk space of a run that is printed before the run: an upper bound, or what was measured on some replans."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from vla_attention.schemas.command_line import format_bytes
from vla_attention.schemas.layout import SiteLayout
from vla_attention.schemas.precision import FLOAT32_MANTISSA_BITS
from vla_attention.schemas.stores.store_format import Recording

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
#: State, actions and numbers of a replan.
_SMALL_PER_REPLAN = 8_000
#: Metadata and small arrays of one episode: some fifty files and folders, each at least one block of the file system.
EPISODE_OVERHEAD = 300_000


@dataclass(frozen=True)
class DiskEstimate:
    """Upper bound of a run's size, reached when every episode runs to its last step.

    `measured`: on replans of this policy (`measured_size.py`), within 10 %. Otherwise no codec could give more.
    """

    bytes_per_replan: int
    max_replans: int
    num_episodes: int
    episode_overhead: int = EPISODE_OVERHEAD
    measured: bool = False

    @property
    def total_bytes(self) -> int:
        """Bytes of the whole run."""
        return (self.bytes_per_replan * self.max_replans + self.episode_overhead) * self.num_episodes


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
        total += sum(_COVERAGE_BYTES_PER_PATCH * span.num_keys for span in site.spans if span.camera is not None)
    return DiskEstimate(int(total), replans, episodes)


def describe(estimate: DiskEstimate, path: Path) -> str:
    """The line printed before a run, with a warning when the disk has less room than that."""
    existing = next(folder for folder in (path, *path.parents) if folder.exists())
    free = shutil.disk_usage(existing).free
    total = estimate.total_bytes
    measured, usual = f", measured, + {format_bytes(estimate.episode_overhead)} each", ""
    if not estimate.measured:
        measured, usual = "", f"; mostly {format_bytes(total * _USUAL[0])} to {format_bytes(total * _USUAL[1])}"
    line = (
        f"Disk: at most {format_bytes(total)} "
        f"({estimate.num_episodes} episodes x up to {estimate.max_replans} replans "
        f"x {format_bytes(estimate.bytes_per_replan)}{measured}){usual}; {format_bytes(free)} free."
    )
    if total > free:
        line += " WARNING: that is more than the disk has room for; record fewer layers, denoise steps or episodes."
    return line
