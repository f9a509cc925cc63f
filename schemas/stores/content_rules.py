"""What the arrays of an episode must satisfy. The writer refuses a replan that breaks a rule; `verify` reports it.

Every rule yields sentences without a full stop, of which the first one counts: the later ones may rest on what it
says is broken. Arrays begin with the replan axis: the writer gives one replan, and `verify` blocks of them. Places are
named by the recorded numbers of layers, denoise steps and heads; the first place is the one that the model computed
first (denoise step by denoise step, layer by layer).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from vla_attention.schemas.effects import CHANGE, CUT, MAP, PATCH_CHANGE, EffectMap
from vla_attention.schemas.episode_steps import EXECUTED, GRIPPER, POSE, POSES
from vla_attention.schemas.errors import listing
from vla_attention.schemas.layout import (
    INVALID_ROLES,
    ROLE_DTYPE,
    ROLES_OF_KIND,
    Piece,
    Prompt,
    Role,
    SiteLayout,
    Span,
    camera_grids,
    picture_size,
    prompt_at,
)
from vla_attention.schemas.precision import FLOAT32_MANTISSA_BITS, key_error_bound, mass_error_bound
from vla_attention.schemas.stores.store_format import Recording, RootAttributes

_NOT_FINITE = "holds numbers that are NaN or infinite"
#: Largest distance of a row's sum from 1. A float32 softmax over 5000 keys leaves 5e-7, a mean of rows less, weighted
#: means in TF32 5e-4; rows that were rounded to bfloat16 would leave 2e-3.
ROW_SUM_TOLERANCE = 1e-3
#: Largest relative difference of two float32 sums of the same numbers.
_SUMMATION_TOLERANCE = 1e-5
#: Largest distance of a patch's coverage from 1; float32 leaves 1e-6.
_COVERAGE_TOLERANCE = 1e-3
#: Largest distance of a quaternion's length from 1; float32 leaves 1e-7.
_QUATERNION_TOLERANCE = 1e-3
#: Asymmetry and negative eigenvalues that float32 products leave in a Gram matrix, as a share of its trace.
_GRAM_TOLERANCE = 1e-4


def row_sum_bound(mantissa_bits: int) -> float:
    """Largest difference between the sum of a row of that precision and its stored sum, as a share of it."""
    return _SUMMATION_TOLERANCE + mass_error_bound(mantissa_bits)


def add_up(rows: NDArray[np.float32], row_sum: NDArray[np.float32], mantissa_bits: int) -> bool:
    """Whether rows (..., key) have the sums `row_sum` (...), as closely as `row_problems` asks: one product in float32.

    Where it says no, `row_problems` decides: sums in float32 err by some 1e-6.
    """
    with np.errstate(over="ignore", invalid="ignore"):  # of numbers that no row has
        sums = rows.reshape(-1, rows.shape[-1]) @ np.ones(rows.shape[-1], np.float32)
    expected = row_sum.reshape(-1)
    most = np.float32(row_sum_bound(mantissa_bits) - _SUMMATION_TOLERANCE / 2)
    tiny = np.float32(rows.shape[-1] * key_error_bound(mantissa_bits))
    return bool((np.abs(sums - expected) <= most * expected + tiny).all())  # a NaN is in no bound


@dataclass(frozen=True)
class Block:
    """Some replans (or entries, moments, steps) of one array of an episode, and what its rule needs beside them.

    Attributes:
        root: of the run.
        num_objects: of the episode's scene.
        name: of the array, for instance `joint/rows`.
        values: the first axis is the replan.
        beside: the same replans of another array of the episode, by its name.
        first: number of the first replan in the episode.
    """

    root: RootAttributes
    num_objects: int
    name: str
    values: NDArray[Any]
    beside: Callable[[str], NDArray[Any]]
    first: int = 0

    @property
    def site(self) -> SiteLayout:
        """The site whose array it is."""
        return self.root.site(self.name.partition("/")[0])

    @property
    def recording(self) -> Recording:
        """What is recorded of the site."""
        return self.root.recording_of(self.site.name)

    def faults(
        self, says: str, wrong: NDArray[np.bool_], *axes: str, found: NDArray[Any] | None = None
    ) -> Iterator[str]:
        """`_faults` of this array; without names of axes, `wrong` begins with those of rows."""
        return _faults(self.name, says, wrong, axes or self.recording, self.first, found)


def _faults(
    name: str,
    says: str,
    wrong: NDArray[np.bool_],
    axes: tuple[str, ...] | Recording,
    first: int,
    found: NDArray[Any] | None = None,
) -> Iterator[str]:
    """One sentence if anything is wrong: what it is, its first place, and how many places there are.

    Args:
        name: of the array.
        says: what is wrong; `{}` in it stands for what `found` has at the first place.
        wrong: where it is.
        axes: names of the first axes of `wrong`; a recording: they are (replan, layer, denoise step, head, query), or
            the first of these.
        first: number of the first index along the first axis.
        found: numbers, of the shape of `wrong`.

    Yields:
        For instance `NAME SAYS at replan 3, denoise step 9, layer 7, head 2, and at 143 of 288 places in all`.
    """
    if not wrong.any():
        return
    numbers: dict[str, Sequence[int]] = {}
    if isinstance(axes, Recording):
        several_queries = wrong.ndim > 4 and wrong.shape[4] > 1
        wrong = wrong.swapaxes(1, 2)  # into the order of computation
        found = None if found is None else found.swapaxes(1, 2)
        numbers = {"denoise step": axes.denoise_steps, "layer": axes.layers, "head": axes.heads}
        axes = ("replan", *numbers, *(["query"] if several_queries else []))
    place = tuple(np.argwhere(wrong)[0].tolist())
    known = zip(axes, (first + place[0], *place[1:]), strict=False)
    words = ", ".join(f"{axis} {numbers[axis][index] if axis in numbers else index}" for axis, index in known)
    count = int(wrong.sum())
    said = says if found is None else says.format(found[place])
    yield f"{name} {said} at {words}" + (f", and at {count} of {wrong.size} places in all" if count > 1 else "")


def row_problems(
    name: str,
    values: NDArray[np.float32],
    row_sum: NDArray[np.floating],
    recording: Recording,
    mantissa_bits: int,
    first_replan: int = 0,
) -> Iterator[str]:
    """Rows, or masses that add up to them: finite, not negative, and with the sums `row_sum`.

    Args:
        name: of the array, for instance `joint/rows`.
        values: (replan, layer, denoise, head, query, key or segment).
        row_sum: (replan, layer, denoise, head, query).
        mantissa_bits: precision of `values`.
        first_replan: number of the first replan of `values` in the episode.
    """
    sums = values.sum(axis=-1, dtype=np.float64)  # NaN or infinite where a number is
    yield from _faults(name, _NOT_FINITE, ~np.isfinite(sums), recording, first_replan)
    negative = values.min(axis=-1, initial=0) < 0
    yield from _faults(name, "holds negative numbers", negative, recording, first_replan)
    expected = row_sum.astype(np.float64)
    bound = row_sum_bound(mantissa_bits)
    apart = np.maximum(np.abs(sums - expected) - values.shape[-1] * key_error_bound(mantissa_bits), 0)
    error = apart / np.maximum(np.abs(expected), 1e-30)
    differs = np.isfinite(error) & (error > bound)
    most = error.max(initial=0, where=differs)
    says = f"does not add up to the row sums: they differ by up to {most:.2g} of them, allowed is {bound:.2g},"
    yield from _faults(name, says, differs, recording, first_replan)


def _stored_row_problems(block: Block) -> Iterator[str]:
    """Rows as `row_problems` says, and no mass for a key that does not exist or that no query behind the row sees.

    A key does not exist that has the role `absent`, and with all queries stored, a key of a growing span that is
    generated after the query.
    """
    site, recording, rows = block.site, block.recording, block.values
    sums = block.beside(f"{site.name}/row_sum")
    yield from row_problems(block.name, rows, sums, recording, recording.mantissa_bits, block.first)
    absent = block.beside(f"{site.name}/key_role") == Role.ABSENT
    given = _given(rows, absent[:, None, None, None, None])
    yield from block.faults("gives mass to a key with the role 'absent'", given)
    growing = site.growing_span
    if growing is not None and recording.queries == "all":
        keys = np.arange(site.num_keys)
        first_later = growing.start + np.arange(rows.shape[4])[:, None] + growing.growing_offset
        later = (keys >= first_later) & (keys < growing.stop)
        says = f"gives mass to a key of the growing span '{growing.name}' that does not exist for the query yet,"
        yield from block.faults(says, _given(rows, later[None, None, None, None]))
    unseen = block.beside(f"{site.name}/uniform") == 0
    says = f"gives mass to a key that no query sees, as {site.name}/uniform says,"
    yield from block.faults(says, _given(rows, unseen))


def _given(rows: NDArray[np.float32], never: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which rows (..., key) give mass to keys that may `never` have any; its axes but the last may have length 1."""
    keys = np.flatnonzero(never.any(axis=tuple(range(never.ndim - 1))))
    given: NDArray[np.bool_] = ((rows[..., keys] != 0) & never[..., keys]).any(axis=-1)
    return given


def _atom_problems(block: Block) -> Iterator[str]:
    """Masses (replan, layer, denoise, head, query, segment) add up to the row sums, which stand behind them."""
    masses, sums = block.values[..., :-1], block.values[..., -1]
    yield from row_problems(block.name, masses, sums, block.recording, FLOAT32_MANTISSA_BITS, block.first)
    yield from _row_sum_problems(replace(block, values=sums))


def _uniform_problems(block: Block) -> Iterator[str]:
    """What uniform attention gives (replan, layer, denoise, head, query, key): rows of a softmax, too."""
    yield from block.faults("holds numbers that are NaN or negative", ~(block.values >= 0), "replan")
    sums = block.values.sum(axis=-1, dtype=np.float64)
    far = ~(np.abs(sums - 1) <= ROW_SUM_TOLERANCE)
    yield from block.faults("sums to {:.4g} instead of 1", far, "replan", found=sums)


def _row_sum_problems(block: Block) -> Iterator[str]:
    """Row sums (replan, layer, denoise, head, query): a row is a softmax over all keys of its site and sums to 1."""
    far = ~(np.abs(block.values.astype(np.float64) - 1) <= ROW_SUM_TOLERANCE)  # also where it is NaN
    says = f"is {{:.4g}} instead of 1 (allowed is a difference of {ROW_SUM_TOLERANCE:g})"
    return block.faults(says, far, found=block.values)


def _gram_problems(block: Block) -> Iterator[str]:
    """Contributions (replan, layer, denoise, part, part): inner products of vectors, thus positive semi-definite."""
    matrices = block.values.astype(np.float64)
    bad = ~np.isfinite(matrices.sum(axis=(-2, -1)))
    yield from block.faults(_NOT_FINITE, bad)
    diagonal = np.diagonal(matrices, axis1=-2, axis2=-1)
    allowed = _GRAM_TOLERANCE * np.abs(diagonal).sum(axis=-1)
    negative = (diagonal < -allowed[..., None]).any(axis=-1)
    yield from block.faults("has negative squared norms on its diagonal", negative)
    asymmetry = np.abs(matrices - matrices.swapaxes(-2, -1)).max(axis=(-2, -1))
    yield from block.faults("is not symmetric", asymmetry > allowed)
    indefinite = np.linalg.eigvalsh(matrices)[..., 0] < -allowed
    yield from block.faults("holds no inner products of vectors (it has negative eigenvalues)", indefinite)


def _role_problems(block: Block) -> Iterator[str]:
    """Role codes (replan, key): each key has a role that a key of its span can have."""
    roles = block.values
    names = {role: f"the role '{role.label}'" for role in Role}
    for span in block.site.spans:
        allowed = ROLES_OF_KIND[span.kind]
        wrong = np.zeros(roles.shape, dtype=bool)
        wrong[:, span.start : span.stop] = ~np.isin(roles[:, span.start : span.stop], [int(role) for role in allowed])
        given = [names.get(code, f"the code {code}, which is no role") for code in roles[wrong][:1].tolist()]
        says = f"gives a key of span '{span.name}' {listing(given)}; expected {listing(one.label for one in allowed)},"
        yield from block.faults(says, wrong, "replan", "key")


def prompt_problems(sites: Sequence[SiteLayout], prompt: Prompt) -> Iterator[str]:
    """A prompt: its pieces are different text keys, and lie with the instruction inside the text."""
    length = len(prompt.text)
    first, last = prompt.instruction
    if not 0 <= first <= last <= length:
        yield f"the instruction stands at characters {first} to {last} of a prompt with {length}"
    spans = [span for site in sites for span in site.spans if span.kind == "text"]
    for piece in prompt.pieces:
        if not any(_holds(span, piece) for span in spans):
            existing = listing(f"{span.start} to {span.stop - 1}" for span in spans)
            yield f"the prompt's piece {piece.text!r} is key {piece.key}, which is no text key; those are {existing}"
        if not 0 <= piece.start <= piece.stop <= length:
            covered = f"characters {piece.start} to {piece.stop} of a prompt with {length}"
            yield f"the prompt's piece of key {piece.key} covers {covered}"
    if len({piece.key for piece in prompt.pieces}) != len(prompt.pieces):
        yield "two pieces of the prompt are the same key"


def piece_role_problems(
    sites: Sequence[SiteLayout], site: SiteLayout, key_role: NDArray[np.integer], prompt: Prompt, replan: int
) -> Iterator[str]:
    """Role codes (key,) of one replan at a site, and its prompt: a key that holds a piece of text is not padding.

    Of several sites with text, one may have all of it masked: GR00T's blocks that read pictures.
    """
    pieces = prompt_at(sites, site, prompt).pieces
    held = [piece for piece in pieces if any(_holds(span, piece) for span in site.spans)]
    hidden = [piece for piece in held if key_role[piece.key] in INVALID_ROLES]
    only_site = sum(any(span.kind == "text" for span in one.spans) for one in sites) == 1
    if hidden and (only_site or len(hidden) < len(held)):
        key, text = hidden[0].key, hidden[0].text
        yield (
            f"{site.name}/key_role gives key {key} the role '{Role(key_role[key]).label}' at replan {replan}, but it "
            f"holds the prompt's piece {text!r}"
        )


def _holds(span: Span, piece: Piece) -> bool:
    return span.kind == "text" and span.start <= piece.key < span.stop


def _camera_problems(block: Block) -> Iterator[str]:
    """Pictures: of a camera of some site; coverage: of one that has patches there."""
    group, _, name = block.name.partition("/")
    of_patches = group == "objects"
    cameras = dict.fromkeys(
        name for site in block.root.sites for name in (site.pictured if of_patches else site.cameras)
    )
    if name not in cameras:
        yield f"{block.name} is of a camera that no site has; existing: {listing(cameras)}"


def _picture_problems(block: Block) -> Iterator[str]:
    """Pictures (replan, row, column, channel): of the size that the camera's patches tile; without any, of any size."""
    yield from _camera_problems(block)
    group, _, camera = block.name.partition("/")
    tiled = group == "frames" and any(camera in site.pictured for site in block.root.sites)
    size = picture_size(block.root.sites, camera) if tiled else block.values.shape[1:3]
    yield from shape_problems(block.name, block.values.shape, (len(block.values), *size, 3))


def _coverage_problems(block: Block) -> Iterator[str]:
    """Coverage (replan, patch, object): shares of each patch, which sum to 1."""
    yield from _camera_problems(block)
    values, grids = block.values, camera_grids(block.root.sites, block.name.partition("/")[2])
    expected = (len(values), sum(grid.num_patches for grid in grids), block.num_objects)
    for problem in shape_problems(block.name, values.shape, expected):
        yield f"{problem}: the camera's {listing(grid.describe() for grid in grids)}, and the scene's objects"
    outside = ~((values >= 0) & (values <= 1 + _COVERAGE_TOLERANCE))
    yield from block.faults(
        "has the share {:.4g}; expected 0 to 1,", outside, "replan", "patch", "object", found=values
    )
    total = values.sum(axis=-1, dtype=np.float64)
    far = np.abs(total - 1) > _COVERAGE_TOLERANCE
    yield from block.faults("has shares that sum to {:.4g} instead of 1", far, "replan", "patch", found=total)


def _cut_problems(block: Block) -> Iterator[str]:
    """Weights of the keys that were cut off (entry, key): 0 to 1."""
    outside = ~((block.values >= 0) & (block.values <= 1))
    return block.faults("has the weight {:.4g}; expected 0 to 1,", outside, "entry", "key", found=block.values)


def _map_problems(block: Block) -> Iterator[str]:
    """Sizes of a map (map_row, block): 0 or more."""
    outside = ~((block.values >= 0) & np.isfinite(block.values))
    return block.faults("has the size {:.4g}; expected 0 or more,", outside, "map_row", "block", found=block.values)


def _pose_problems(block: Block) -> Iterator[str]:
    """Poses (moment, body, 7): finite, and with quaternions of length 1."""
    yield from _finite("moment", "body")(block)
    length = np.linalg.norm(block.values[..., POSE - 4 :].astype(np.float64), axis=-1)
    far = np.abs(length - 1) > _QUATERNION_TOLERANCE
    yield from block.faults("has a quaternion of length {:.4g} instead of 1", far, "moment", "body", found=length)


def _finite(*axes: str) -> Callable[[Block], Iterator[str]]:
    """The rule of an array that may hold any numbers; places are named by its axes of these names."""
    return lambda block: block.faults(_NOT_FINITE, ~np.isfinite(block.values), *axes)


def counter_problems(env_step: NDArray[np.integer], noise_seed: NDArray[np.integer]) -> Iterator[str]:
    """Environment steps and noise seeds (replan,): steps increase, and neither is negative (-1 is a lost chunk)."""
    for name, values in (("env_step", env_step), ("noise_seed", noise_seed)):
        if (values < 0).any():
            yield f"{name} is {values.min()}; expected 0 or more"
    for i in np.flatnonzero(np.diff(env_step) <= 0)[:1]:
        yield f"env_step does not increase: {env_step[i + 1]} follows {env_step[i]}"


def site_shapes(site: SiteLayout, recording: Recording, replans: int, segments: int) -> dict[str, tuple[int, ...]]:
    """Shapes of the arrays of a site; `recording` is what is of the site, `segments` the episode's number of them."""
    plan = (replans, len(recording.layers), len(recording.denoise_steps))
    cells = (*plan, len(recording.heads), recording.num_queries)
    shapes = {
        "rows": (*cells, site.num_keys),
        "atoms": (*cells, segments + 1),
        "key_role": (replans, site.num_keys),
        "uniform": (*cells, site.num_keys),
    }
    if recording.contributions:
        shapes["contribution"] = (*plan, segments + 1, segments + 1)
    return {f"{site.name}/{kind}": shape for kind, shape in shapes.items()}


def effect_shapes(sites: Sequence[SiteLayout], entries: int, horizon: int, dims: int) -> dict[str, tuple[int, ...]]:
    """Shapes of the arrays of effects; `dims` is the number of dimensions of an action."""
    cuts: dict[str, tuple[int, ...]] = {f"{site.name}/{CUT}": (entries, site.num_keys) for site in sites}
    return {CHANGE: (entries, horizon, dims)} | cuts


def map_shapes(of: EffectMap, horizon: int, dims: int) -> dict[str, tuple[int, ...]]:
    """Shapes of the arrays of a map of patches; `dims` is the number of dimensions of an action."""
    return {MAP: (len(of.replan), of.num_blocks), PATCH_CHANGE: (len(of.entries), horizon, dims)}


def shape_problems(name: str, shape: tuple[int, ...], expected: tuple[int, ...]) -> Iterator[str]:
    """Whether an array has another shape than it must have; a single length is that of the first axis."""
    # Axes of `uniform` but the last have length 1 where nothing changes along them.
    if name.endswith("/uniform") and len(shape) == len(expected) and shape[-1:] == expected[-1:]:
        if not all(given in (1, length) for given, length in zip(shape, expected, strict=True)):
            yield f"{name} has the shape {shape}; expected {expected}, or 1 in place of a length but the last"
    elif (shape[:1] if len(expected) == 1 else shape) != expected:
        yield f"{name} has the shape {shape}; expected {expected}"


#: Arrays of an episode -> the type of their numbers (None: any), and what these must satisfy. SITE stands for the name
#: of a site, `*` for that of a camera.
_RULES: dict[str, tuple[DTypeLike | None, Callable[[Block], Iterator[str]]]] = {
    "SITE/key_role": (ROLE_DTYPE, _role_problems),
    "SITE/rows": (np.float32, _stored_row_problems),
    "SITE/atoms": (np.float32, _atom_problems),
    "SITE/row_sum": (np.float32, _row_sum_problems),
    "SITE/uniform": (np.float32, _uniform_problems),
    "SITE/contribution": (np.float32, _gram_problems),
    f"SITE/{CUT}": (np.float32, _cut_problems),
    CHANGE: (np.float32, _finite("entry")),
    MAP: (np.float32, _map_problems),
    PATCH_CHANGE: (np.float32, _finite("map_entry")),
    POSES: (np.float32, _pose_problems),
    GRIPPER: (np.float32, _finite("moment")),
    EXECUTED: (np.float32, _finite("step")),
    "frames/*": (np.uint8, _picture_problems),
    "camera_frames/*": (np.uint8, _picture_problems),
    "objects/*": (np.float32, _coverage_problems),
    **dict.fromkeys(("state", "actions", "dataset_actions", "base_actions"), (None, _finite("replan"))),
}


def value_problems(block: Block) -> Iterator[str]:
    """The first rule that the numbers of an array break; nothing without any, and of arrays that have no rule.

    Raises:
        CorruptEpisode: an array beside it cannot be read.
    """
    group, _, kind = block.name.partition("/")
    of_site = any(site.name == group for site in block.root.sites)
    for key in (f"SITE/{kind}" if of_site else block.name, f"{group}/*"):
        dtype, rule = _RULES.get(key, (None, lambda _: iter(())))
        if dtype is not None and block.values.dtype != np.dtype(dtype):
            yield f"{block.name} has the type {block.values.dtype}; expected {np.dtype(dtype)}"
        else:
            yield from islice(rule(block), 1)
