"""The disk space and inodes of a run, printed before it: an upper bound.

What rows, pictures and coverage compress to depends on the policy and the scene, so no formula says it: at 10 mantissa
bits a number takes 1.1 to 2 bytes, a picture a third of its pixels or a tenth. The bound needs no policy call; a run
says after its first episode what that took (`engine/progress.py`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from vla_attention.capture.store.codecs import FEWEST_KEYS
from vla_attention.schemas.command_line import format_bytes
from vla_attention.schemas.effects import EffectsRecorded
from vla_attention.schemas.layout import SiteLayout
from vla_attention.schemas.precision import FLOAT32_MANTISSA_BITS, HALF_MANTISSA_BITS, is_half
from vla_attention.schemas.stores.store_format import Recording
from vla_attention.schemas.stores.store_place import Room, room_at

#: Exponent bits that differ between probabilities: a float32 in [0, 2) has 0 as its sign and highest exponent bit, a
#: float16 of p x 2^15 has 0 as its sign.
_EXPONENT_BITS, _HALF_EXPONENT_BITS = 7, 5
#: Factor by which compression can enlarge numbers that it cannot make smaller.
_INCOMPRESSIBLE = 1.01
#: Header, checksum and place in the index of one chunk, and its checksum in the seal.
_CHUNK_OVERHEAD = 48
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

    `inodes_per_episode`: files and folders of an episode, however long it is.
    """

    bytes_per_replan: int
    max_replans: int
    num_episodes: int
    inodes_per_episode: int
    episode_overhead: int = EPISODE_OVERHEAD

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
    they take no space. At worst the others do not compress at all. Rows of trained models take 5 to 25 % less.
    """
    if mantissa_bits == HALF_MANTISSA_BITS:  # shuffled by bytes
        return _INCOMPRESSIBLE * 2
    exponent = _HALF_EXPONENT_BITS if is_half(mantissa_bits) else _EXPONENT_BITS
    return _INCOMPRESSIBLE * (exponent + min(mantissa_bits, FLOAT32_MANTISSA_BITS)) / 8


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
        total += rows_of_site * site.num_keys * bytes_per_number(recording.mantissa_bits)
        total += chunks * _CHUNK_OVERHEAD * -(-site.num_keys // FEWEST_KEYS)
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
    # Of a site: rows, atoms, roles, uniform attention. Once: actions and state, three arrays of the steps.
    arrays = len(sites) * (4 + recording.contributions + effects) + 2 + 3 + frames + cameras + effects
    arrays += 2 if recording.effects is not None and "map" in recording.effects.items else 0
    # The episode, its seal and steps, its sites; pictures twice, objects, effects.
    groups = 3 + len(sites) + (2 if frames else 0) + (1 if cameras else 0) + effects
    return 3 * arrays + 2 * groups


def _bytes_of_effects(effects: EffectsRecorded, horizon: int, sites: Sequence[SiteLayout]) -> float:
    """Bytes of the effects of one replan, with `_MOST_ITEMS` of each kind."""
    cameras = sum(len(site.cameras) for site in sites)
    tokens = sum(span.num_keys for site in sites for span in site.spans if span.kind == "text")
    # Each group is cut off, kept alone, and has a control.
    counts = {"cameras": 2 + 2 * cameras, "tokens": tokens, "groups": 3 * len(effects.groups)}
    counts |= {"prompts": effects.most_prompts, "map": 0}
    entries = len(effects.readers) * sum(counts.get(item, _MOST_ITEMS) for item in effects.items) + _MOST_ITEMS
    change = 4 * horizon * _ACTION_DIMENSIONS * _INCOMPRESSIBLE
    total = entries * (change + sum(site.num_keys for site in sites) / 8)
    if "map" in effects.items:  # a number a patch, and the exact changes of up to a fifth of them; or of all blocks
        patches = max(sum(span.num_keys for span in site.spans if span.grid is not None) for site in sites)
        blocks, exact = effects.blocks, patches / 5 + _MOST_ITEMS
        if blocks is not None:
            exact = min(patches, max(len(site.pictured) for site in sites) * blocks.rows * blocks.columns)
        total += 4 * patches * _INCOMPRESSIBLE + exact * change
    return total / effects.every


def describe(estimate: DiskEstimate, path: Path) -> str:
    """The line printed before a run, with a warning when the disk has less room, or fewer inodes, than that."""
    room, total = room_at(path), estimate.total_bytes
    usual = f"{format_bytes(total * _USUAL[0])} to {format_bytes(total * _USUAL[1])}"
    line = (
        f"Disk: at most {format_bytes(total)} "
        f"({estimate.num_episodes} episodes x up to {estimate.max_replans} replans "
        f"x {format_bytes(estimate.bytes_per_replan)}); mostly {usual}; {estimate.total_inodes:,} files and folders "
        f"({estimate.inodes_per_episode} each); {room.describe()} free."
    )
    if total > room.bytes:
        line += " WARNING: that is more than the disk has room for; record fewer layers, denoise steps or episodes."
    elif estimate.exceeds(room):
        line += " WARNING: that is more files and folders than inodes are free; record fewer episodes, or elsewhere."
    return line
