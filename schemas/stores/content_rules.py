"""What the numbers of an episode must satisfy. The writer refuses a replan that breaks a rule; `verify` reports it.

Every function yields sentences without a full stop. Arrays begin with the replan axis: the writer gives one replan, and
`verify` blocks of them. Places are named by the recorded numbers of layers, denoise steps and heads; the first place is
the one that the model computed first (denoise step by denoise step, layer by layer).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vla_attention.schemas.episode_steps import POSE, POSES
from vla_attention.schemas.errors import listing
from vla_attention.schemas.layout import (
    INVALID_ROLES,
    ROLES_OF_KIND,
    Piece,
    Prompt,
    Role,
    SiteLayout,
    Span,
    camera_grids,
    picture_size,
)
from vla_attention.schemas.precision import mass_error_bound
from vla_attention.schemas.stores.store_format import Recording

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
    """Whether rows (..., key) have the sums `row_sum` (...), within `row_sum_bound`: one product in float32.

    Where it says no, `row_problems` decides: sums in float32 err by some 1e-6.
    """
    with np.errstate(over="ignore", invalid="ignore"):  # of numbers that no row has
        sums = rows.reshape(-1, rows.shape[-1]) @ np.ones(rows.shape[-1], np.float32)
    expected = row_sum.reshape(-1)
    most = np.float32(row_sum_bound(mantissa_bits) - _SUMMATION_TOLERANCE / 2)
    return bool((np.abs(sums - expected) <= most * expected).all())  # a NaN is in no bound


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
    bad = ~np.isfinite(sums)
    if bad.any():
        yield f"{name} holds numbers that are NaN or infinite {_where(bad, recording, first_replan)}"
    lowest = values.min(axis=-1, initial=0)
    if (lowest < 0).any():
        yield f"{name} holds negative numbers {_where(lowest < 0, recording, first_replan)}"
    expected = row_sum.astype(np.float64)
    bound = row_sum_bound(mantissa_bits)
    error = np.abs(sums - expected) / np.maximum(np.abs(expected), 1e-30)
    differs = np.isfinite(error) & (error > bound)
    if differs.any():
        yield (
            f"{name} does not add up to the row sums: they differ by up to {error[differs].max():.2g} of them, allowed "
            f"is {bound:.2g}, {_where(differs, recording, first_replan)}"
        )


def absent_problems(
    layout: SiteLayout,
    rows: NDArray[np.float32],
    key_role: NDArray[np.integer],
    recording: Recording,
    first_replan: int = 0,
) -> Iterator[str]:
    """Rows (replan, layer, denoise, head, query, key) and roles (replan, key): a key that does not exist has no mass.

    Does not exist: a key with the role `absent`, and with all queries stored, a key of a growing span that is generated
    after the query.
    """
    name = f"{layout.name}/rows"
    absent = key_role == Role.ABSENT
    for replan in np.flatnonzero(absent.any(axis=1)).tolist():
        given = rows[replan][..., absent[replan]] != 0
        if given.any():
            yield f"{name} gives mass to a key with the role 'absent' at replan {first_replan + replan}"
            return
    growing = layout.growing_span
    if growing is None or recording.queries != "all":
        return
    for query in range(rows.shape[4]):
        later = rows[..., query, min(growing.start + query + growing.growing_offset, growing.stop) : growing.stop]
        if (later != 0).any():
            replan = int(np.argwhere(later.any(axis=(1, 2, 3, 4)))[0][0])
            yield (
                f"{name} gives query {query} mass of a key of the growing span '{growing.name}' that does not exist "
                f"for it yet, at replan {first_replan + replan}"
            )
            return


def uniform_problems(name: str, uniform: NDArray[np.float32], first_replan: int = 0) -> Iterator[str]:
    """What uniform attention gives (replan, layer, denoise, head, query, key): rows of a softmax, too."""
    bad = ~np.isfinite(uniform) | (uniform < 0)
    if bad.any():
        replan = first_replan + int(np.argwhere(bad)[0][0])
        yield f"{name} holds numbers that are NaN, infinite or negative, the first at replan {replan}"
        return
    sums = uniform.sum(axis=-1, dtype=np.float64)
    far = np.abs(sums - 1) > ROW_SUM_TOLERANCE
    if far.any():
        replan = first_replan + int(np.argwhere(far)[0][0])
        yield f"{name} sums to {sums[far][0]:.4g} instead of 1, the first time at replan {replan}"


def unseen_problems(
    name: str,
    rows: NDArray[np.float32],
    uniform: NDArray[np.float32],
    recording: Recording,
    first_replan: int = 0,
) -> Iterator[str]:
    """Rows (replan, layer, denoise, head, query, key): no mass for a key that no query behind the row sees.

    uniform: what uniform attention gives; axes along which nothing changes have length 1.
    """
    unseen = uniform == 0
    if not unseen.any():
        return
    if unseen.shape[1:-1] == (1, 1, 1, 1):
        keys = np.flatnonzero(unseen.any(axis=(0, 1, 2, 3, 4)))
        given = ((rows[..., keys] != 0) & unseen[..., keys]).any(axis=-1)
    else:
        given = ((rows != 0) & unseen).any(axis=-1)
    if given.any():
        yield (
            f"{name} gives mass to a key that no query sees, as {name.rpartition('/')[0]}/uniform says, "
            f"{_where(given, recording, first_replan)}"
        )


def row_sum_problems(
    name: str, row_sum: NDArray[np.floating], recording: Recording, first_replan: int = 0
) -> Iterator[str]:
    """Row sums (replan, layer, denoise, head, query): a row is a softmax over all keys of its site and sums to 1."""
    far = ~(np.abs(row_sum.astype(np.float64) - 1) <= ROW_SUM_TOLERANCE)  # also where it is NaN
    if far.any():
        values = row_sum[far]
        worst = values[np.argmax(np.abs(values - 1))]
        yield (
            f"{name} is {worst:.4g} instead of 1 (allowed is a difference of {ROW_SUM_TOLERANCE:g}) "
            f"{_where(far, recording, first_replan)}"
        )


def gram_problems(name: str, gram: NDArray[np.float32], recording: Recording, first_replan: int = 0) -> Iterator[str]:
    """Contributions (replan, layer, denoise, part, part): inner products of vectors, thus positive semi-definite."""
    matrices = gram.astype(np.float64)
    bad = ~np.isfinite(matrices.sum(axis=(-2, -1)))
    if bad.any():
        yield f"{name} holds numbers that are NaN or infinite {_where(bad, recording, first_replan)}"
        return
    diagonal = np.diagonal(matrices, axis1=-2, axis2=-1)
    allowed = _GRAM_TOLERANCE * np.abs(diagonal).sum(axis=-1)
    negative = (diagonal < -allowed[..., None]).any(axis=-1)
    asymmetry = np.abs(matrices - matrices.swapaxes(-2, -1)).max(axis=(-2, -1))
    if negative.any():
        yield f"{name} has negative squared norms on its diagonal {_where(negative, recording, first_replan)}"
    elif (asymmetry > allowed).any():
        yield f"{name} is not symmetric {_where(asymmetry > allowed, recording, first_replan)}"
    else:
        indefinite = np.linalg.eigvalsh(matrices)[..., 0] < -allowed
        if indefinite.any():
            where = _where(indefinite, recording, first_replan)
            yield f"{name} holds no inner products of vectors (it has negative eigenvalues) {where}"


def _where(mask: NDArray[np.bool_], recording: Recording, first_replan: int) -> str:
    """The first true place of (replan, layer, denoise[, head, query]) in the order of computation, and how many follow.

    Returns for instance `at replan 3, denoise step 9, layer 7, head 2, and at 143 of 288 places in all`.
    """
    replan, denoise, layer, *rest = np.argwhere(mask.swapaxes(1, 2))[0]
    words = [
        f"replan {first_replan + replan}",
        f"denoise step {recording.denoise_steps[denoise]}",
        f"layer {recording.layers[layer]}",
    ]
    if rest:
        words.append(f"head {recording.heads[rest[0]]}")
        words += [f"query {rest[1]}"] if mask.shape[-1] > 1 else []
    count = int(mask.sum())
    return f"at {', '.join(words)}" + (f", and at {count} of {mask.size} places in all" if count > 1 else "")


def role_problems(layout: SiteLayout, key_role: NDArray[np.integer], first_replan: int = 0) -> Iterator[str]:
    """Role codes (replan, key): each key has a role that a key of its span can have."""
    for span in layout.spans:
        allowed = ROLES_OF_KIND[span.kind]
        wrong = ~np.isin(key_role[:, span.start : span.stop], [int(role) for role in allowed])
        if wrong.any():
            replan, key = np.argwhere(wrong)[0]
            code = int(key_role[replan, span.start + key])
            given = f"the role '{Role(code).label}'" if code in set(Role) else f"the code {code}, which is no role,"
            yield (
                f"{layout.name}/key_role gives key {span.start + key} of span '{span.name}' {given} at replan "
                f"{first_replan + replan}; expected one of {listing(role.label for role in allowed)}"
            )


def prompt_problems(sites: Sequence[SiteLayout], prompt: Prompt) -> Iterator[str]:
    """A prompt: its pieces are different text keys, and lie with the instruction inside the text."""
    length = len(prompt.text)
    first, last = prompt.instruction
    if not 0 <= first <= last <= length:
        yield f"the instruction stands at characters {first} to {last} of a prompt with {length}"
    spans = [span for site in sites for span in site.spans if span.kind == "text"]
    keys = [piece.key for piece in prompt.pieces]
    if not all(any(_holds(span, piece) for span in spans) for piece in prompt.pieces):
        yield (
            f"the prompt's pieces are keys {min(keys)} to {max(keys)}, which are not all text keys; those are "
            f"{listing(f'{span.start} to {span.stop - 1}' for span in spans)}"
        )
    if len(set(keys)) != len(keys):
        yield "two pieces of the prompt are the same key"
    outside = [piece for piece in prompt.pieces if not 0 <= piece.start <= piece.stop <= length]
    if outside:
        piece = outside[0]
        yield f"the piece of key {piece.key} covers characters {piece.start} to {piece.stop} of a prompt with {length}"


def piece_role_problems(
    layout: SiteLayout, key_role: NDArray[np.integer], prompt: Prompt, replan: int, *, only_site: bool = True
) -> Iterator[str]:
    """Role codes (key,) of one replan and its prompt: a key that holds a piece of text is not padding.

    only_site: no other site has text. Of several, one may have all text masked: GR00T's blocks that read pictures.
    """
    held = [piece for piece in prompt.pieces if any(_holds(span, piece) for span in layout.spans)]
    if not only_site and all(key_role[piece.key] in INVALID_ROLES for piece in held):
        return
    for piece in held:
        if key_role[piece.key] in INVALID_ROLES:
            yield (
                f"{layout.name}/key_role gives key {piece.key} the role '{Role(key_role[piece.key]).label}' at replan "
                f"{replan}, but it holds the prompt's piece {piece.text!r}"
            )
            return


def sites_with_text(sites: Sequence[SiteLayout]) -> list[str]:
    """The names of the sites that have a span of text."""
    return [site.name for site in sites if any(span.kind == "text" for span in site.spans)]


def _holds(span: Span, piece: Piece) -> bool:
    return span.kind == "text" and span.start <= piece.key < span.stop


def picture_problems(
    sites: Sequence[SiteLayout], camera: str, shape: tuple[int, ...], dtype: np.dtype[Any]
) -> Iterator[str]:
    """A camera's picture (row, column, channel): of a known camera, uint8, and of the size that its patches tile."""
    if camera not in (cameras := _cameras(sites)):
        yield f"frames/{camera} is of a camera that no site has; existing: {listing(cameras)}"
        return
    expected = (*picture_size(sites, camera), 3)
    if (shape, dtype) != (expected, np.dtype(np.uint8)):
        yield f"frames/{camera} has pictures of shape {shape} and type {dtype}; expected {expected} and uint8"


def camera_picture_problems(
    sites: Sequence[SiteLayout], camera: str, shape: tuple[int, ...], dtype: np.dtype[Any]
) -> Iterator[str]:
    """A camera's own picture (row, column, channel), of any size: of a known camera, uint8, three channels."""
    if camera not in (cameras := _cameras(sites)):
        yield f"camera_frames/{camera} is of a camera that no site has; existing: {listing(cameras)}"
    elif len(shape) != 3 or shape[-1] != 3 or dtype != np.dtype(np.uint8):
        yield (
            f"camera_frames/{camera} has pictures of shape {shape} and type {dtype}; expected (height, width, 3) and "
            "uint8"
        )


def coverage_problems(
    sites: Sequence[SiteLayout],
    camera: str,
    coverage: NDArray[np.floating],
    num_objects: int,
    first_replan: int = 0,
) -> Iterator[str]:
    """Coverage (replan, patch, object): of a known camera, float32; shares of each patch that sum to 1."""
    name = f"objects/{camera}"
    if camera not in (cameras := _cameras(sites)):
        yield f"{name} is of a camera that no site has; existing: {listing(cameras)}"
        return
    grids = camera_grids(sites, camera)
    expected = (sum(grid.num_patches for grid in grids), num_objects)
    if (coverage.shape[1:], coverage.dtype) != (expected, np.dtype(np.float32)):
        yield (
            f"{name} has the shape {coverage.shape[1:]} and type {coverage.dtype}; expected {expected} and float32: "
            f"the camera's {listing(grid.describe() for grid in grids)}, and the scene's objects"
        )
        return
    inside = (coverage >= 0) & (coverage <= 1 + _COVERAGE_TOLERANCE)
    if not inside.all():
        replan, patch, number = np.argwhere(~inside)[0]
        yield (
            f"{name} gives object {number} the share {coverage[replan, patch, number]:.4g} of patch {patch} at replan "
            f"{first_replan + replan}; expected 0 to 1"
        )
        return
    total = coverage.sum(axis=-1, dtype=np.float64)
    far = np.abs(total - 1) > _COVERAGE_TOLERANCE
    if far.any():
        replan, patch = np.argwhere(far)[0]
        yield (
            f"the shares of {name} sum to {total[replan, patch]:.4g} instead of 1 at patch {patch} of replan "
            f"{first_replan + replan}"
        )


def effect_problems(name: str, change: NDArray[np.float32], first_entry: int = 0) -> Iterator[str]:
    """Changes of actions (entry, horizon, action dim): finite."""
    bad = ~np.isfinite(change)
    if bad.any():
        entry = first_entry + int(np.argwhere(bad)[0][0])
        yield f"{name} holds numbers that are NaN or infinite, the first in entry {entry}"


def cut_problems(name: str, cut: NDArray[np.float32], first_entry: int = 0) -> Iterator[str]:
    """Weights of the keys that were cut off (entry, key): 0 to 1."""
    inside = (cut >= 0) & (cut <= 1)
    if not inside.all():
        entry, key = np.argwhere(~inside)[0]
        given = cut[entry, key]
        yield f"{name} gives key {key} the weight {given:.4g} in entry {first_entry + int(entry)}; expected 0 to 1"


def step_problems(name: str, values: NDArray[np.float32], first: int = 0) -> Iterator[str]:
    """Poses (moment, body, 7), finger joints (moment, finger) or executed actions (step, action dim): numbers.

    Of poses, quaternions have length 1.
    """
    if values.dtype != np.dtype(np.float32) or (name == POSES and values.shape[2:] != (POSE,)):
        yield f"{name} has the shape {values.shape} and type {values.dtype}; expected float32, and {POSE} for a pose"
        return
    place = "step" if name.endswith("actions") else "moment"
    bad = ~np.isfinite(values)
    if bad.any():
        number = first + int(np.argwhere(bad)[0][0])
        yield f"{name} holds numbers that are NaN or infinite, the first at {place} {number}"
        return
    if name == POSES:
        length = np.linalg.norm(values[..., 3:].astype(np.float64), axis=-1)
        far = np.abs(length - 1) > _QUATERNION_TOLERANCE
        if far.any():
            moment, body = np.argwhere(far)[0]
            yield (
                f"{name} has a quaternion of length {length[moment, body]:.4g} instead of 1 for body {body} at moment "
                f"{first + int(moment)}"
            )


def _cameras(sites: Sequence[SiteLayout]) -> list[str]:
    """The cameras that have patches at some site."""
    return list(dict.fromkeys(camera for site in sites for camera in site.pictured))


def counter_problems(env_step: NDArray[np.integer], noise_seed: NDArray[np.integer]) -> Iterator[str]:
    """Environment steps and noise seeds (replan,): steps increase, and neither is negative (-1 is a lost chunk)."""
    if (env_step < 0).any():
        yield f"env_step is {env_step.min()}; expected 0 or more"
    for i in np.flatnonzero(np.diff(env_step) <= 0)[:1]:
        yield f"env_step does not increase: {env_step[i + 1]} follows {env_step[i]}"
    if (noise_seed < 0).any():
        yield f"noise_seed is {noise_seed.min()}; expected 0 or more"
