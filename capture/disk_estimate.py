"""How much disk a run will take, said before it starts."""

from __future__ import annotations

import itertools
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from schemas.layout import SiteLayout
from schemas.precision import FLOAT32_MANTISSA_BITS
from schemas.store import Recording

#: Stored bytes per recorded number by mantissa bits, on rows of trained models (measured; see docs/store.md). Keys that a
#: mask excludes are exact zeros and cost almost nothing, so a real store is smaller than the estimate.
_BYTES_PER_NUMBER = ((4, 1.0), (7, 1.43), (10, 1.79), (12, 2.04), (FLOAT32_MANTISSA_BITS, 3.4))
#: Compressed share of the model input images that simulators draw.
_PICTURE_SHARE = 0.6
#: Metadata and small arrays of one episode.
_EPISODE_OVERHEAD = 100_000


@dataclass(frozen=True)
class DiskEstimate:
    """Upper bound of a run's size, reached when every episode runs to its last step."""

    bytes_per_replan: int
    max_replans: int
    num_episodes: int

    @property
    def total_bytes(self) -> int:
        """Bytes of the whole run."""
        return (self.bytes_per_replan * self.max_replans + _EPISODE_OVERHEAD) * self.num_episodes


def bytes_per_number(mantissa_bits: int) -> float:
    """Stored bytes per recorded float32 at a precision, interpolated between the measured ones."""
    for (low, small), (high, large) in itertools.pairwise(_BYTES_PER_NUMBER):
        if mantissa_bits <= high:
            share = max(0, mantissa_bits - low) / (high - low)
            return small + share * (large - small)
    return _BYTES_PER_NUMBER[-1][1]


def estimate_disk(
    recording: Recording, sites: Sequence[SiteLayout], picture_sizes: Sequence[int], replans: int, episodes: int
) -> DiskEstimate:
    """Estimate a run's size; `picture_sizes` are the decoded bytes of each stored camera picture."""
    queries = 1 if recording.queries == "mean" else recording.num_action_queries
    cells = len(recording.layers) * len(recording.denoise_steps) * len(recording.heads) * queries
    rows = sum(site.num_keys * cells * bytes_per_number(recording.mantissa_bits) for site in sites)
    pictures = sum(picture_sizes) * _PICTURE_SHARE if recording.frames else 0.0
    return DiskEstimate(int(rows + pictures), replans, episodes)


def format_bytes(count: float) -> str:
    """A byte count for people: 3 significant digits, decimal units."""
    for unit in ("B", "kB", "MB", "GB"):
        if count < 1000:
            return f"{count:.3g} {unit}"
        count /= 1000
    return f"{count:.3g} TB"


def describe(estimate: DiskEstimate, path: Path) -> str:
    """The line printed before a run, with a warning when the disk has less room than that."""
    existing = next(folder for folder in (path, *path.parents) if folder.exists())
    free = shutil.disk_usage(existing).free
    line = (
        f"Disk: at most {format_bytes(estimate.total_bytes)} "
        f"({estimate.num_episodes} episodes x up to {estimate.max_replans} replans x {format_bytes(estimate.bytes_per_replan)}); "
        f"{format_bytes(free)} free."
    )
    if estimate.total_bytes > free:
        line += " WARNING: that is more than the disk has room for; record fewer layers, denoise steps or episodes."
    return line
