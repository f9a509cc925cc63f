"""What a policy call is given, with the prompt and the pictures that interventions change.

Pictures are (height, width, 3) uint8, as the model sees them. Masks are (height, width) bool, True where a pixel is
replaced.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from vla_attention.capture.interventions.prompts import changed_instruction
from vla_attention.capture.policies.policy import GivenInputs
from vla_attention.schemas.errors import BadArgument, listing, unknown_name
from vla_attention.schemas.groupings.resolve import EmptyGroup
from vla_attention.schemas.groupings.vocabulary import SceneObject
from vla_attention.schemas.interventions import ImageChange, Interventions
from vla_attention.schemas.layout import PatchGrid, SiteLayout, camera_grids
from vla_attention.schemas.stores.store_format import episode_name


@dataclass(frozen=True)
class CallContext:
    """Where a policy call is in its run, and what is known of its scene.

    instructions: of the suite's tasks, by task id. coverage: camera -> (patch, object), the share of each patch that
    each of `objects` covers. mean_pictures: camera -> the mean of the task's pictures, where it is known.
    """

    task_id: int
    episode_index: int
    replan: int
    instructions: Mapping[int, str] = field(default_factory=dict)
    objects: Sequence[SceneObject] = ()
    coverage: Mapping[str, NDArray[np.float32]] = field(default_factory=dict)
    mean_pictures: Mapping[str, NDArray[np.uint8]] = field(default_factory=dict)


def changed_inputs(
    given: GivenInputs,
    interventions: Interventions,
    sites: Sequence[SiteLayout],
    context: CallContext,
    *,
    allow_empty: bool = False,
) -> GivenInputs:
    """Return what the policy is given instead. Everything drawn at random depends on the seeds and the place only.

    A changed picture is one of whole grey levels, also for policies whose own pictures have finer ones. allow_empty:
    leave a picture as it is where the object to be masked or filled is not there or out of view.

    Raises:
        UnknownName: a camera or an object does not exist.
        EmptyGroup: an object is out of view, unless `allow_empty`.
        BadArgument: there is no coverage to find an object's patches, or no instruction of the named task.
    """
    frames, camera_frames = dict(given.frames), dict(given.camera_frames)
    for change in interventions.images:
        if change.camera not in frames:
            raise unknown_name("camera", change.camera, frames)
        frames[change.camera] = changed_picture(frames[change.camera], change, sites, context, allow_empty=allow_empty)
        camera_frames.pop(change.camera, None)
    instruction = given.instruction
    if interventions.prompt is not None:
        instruction = changed_instruction(
            instruction,
            interventions.prompt,
            task_id=context.task_id,
            episode_index=context.episode_index,
            instructions=context.instructions,
        )
    return replace(given, frames=frames, camera_frames=camera_frames, instruction=instruction)


def changed_picture(
    picture: NDArray[np.uint8],
    change: ImageChange,
    sites: Sequence[SiteLayout],
    context: CallContext,
    *,
    allow_empty: bool = False,
) -> NDArray[np.uint8]:
    """Return a camera's other picture, (height, width, 3) uint8 as the model sees it; errors as `changed_inputs`."""
    if change.kind == "blank":
        return blank(picture)
    if change.kind == "mean":
        if change.camera not in context.mean_pictures:
            raise BadArgument(
                f"No mean picture of camera '{change.camera}' is known: only effects use it (vla-attention capture "
                "rerun STORE "
                "--effects cameras)."
            )
        return context.mean_pictures[change.camera]
    if change.kind == "noise":
        place = (context.task_id, context.episode_index, context.replan, zlib.crc32(change.camera.encode()))
        return noise(picture, np.random.default_rng((change.seed, *place)))
    if change.kind == "rotated":
        return rotated(picture)
    grids = camera_grids(sites, change.camera)
    if change.kind == "shifted":
        if len(grids) > 1 or not grids[0].covers_all:
            raise BadArgument(
                f"Cannot shift the picture of camera '{change.camera}' by patches: it has "
                f"{listing(grid.describe() for grid in grids)}, and a shift needs one grid over the whole picture."
            )
        return shifted(picture, grids[0], change.rows, change.columns)
    patches = object_patches(change, context, known=allow_empty)
    if not patches.any() and not allow_empty:
        raise EmptyGroup(
            f"The object '{change.object}' is out of view of camera '{change.camera}' at replan {context.replan} of "
            f"{episode_name(context.task_id, context.episode_index)}; add --allow-empty to leave such pictures as they "
            "are."
        )
    mask = patch_pixels(patches, grids, picture.shape)
    return masked(picture, mask) if change.kind == "masked" else filled(picture, mask)


def object_patches(change: ImageChange, context: CallContext, *, known: bool = False) -> NDArray[np.bool_]:
    """Return which patches (patch,) of the camera show some of the object; none where it is out of view.

    known: the object is known to exist in another scene of the run, and its absence here is no mistake.
    """
    if change.camera not in context.coverage:
        raise BadArgument(
            f"Cannot find the patches of '{change.object}' in camera '{change.camera}': there is no object coverage of "
            "it; use a store as vla-attention capture wrote it, not a copy without objects."
        )
    covered, names = context.coverage[change.camera], [thing.name for thing in context.objects]
    if change.object not in names and known:
        return np.zeros(len(covered), dtype=bool)
    if change.object not in names:
        raise unknown_name("object", change.object, names)
    patches: NDArray[np.bool_] = covered[:, names.index(change.object)] > 0
    return patches


Picture = NDArray[np.uint8]

#: Grey level of a blank picture: the middle of the model's range.
GREY = 128
#: Rounds of averaging neighbours that smooth a filled region.
_SMOOTHING_ROUNDS = 60


def blank(picture: Picture) -> Picture:
    """Return an even grey picture."""
    return np.full_like(picture, GREY)


def noise(picture: Picture, generator: np.random.Generator) -> Picture:
    """Return even noise: every number 0 to 255, independently."""
    return generator.integers(0, 256, picture.shape, dtype=np.uint8)


def rotated(picture: Picture) -> Picture:
    """Return the picture turned by 180 degrees."""
    return np.ascontiguousarray(picture[::-1, ::-1])


def shifted(picture: Picture, grid: PatchGrid, rows: int, columns: int) -> Picture:
    """Return the picture moved by whole patches, down and to the right; the edge's pixels fill what becomes free.

    Raises:
        BadArgument: nothing of the picture would be left.
    """
    if abs(rows) >= grid.rows or abs(columns) >= grid.columns:
        raise BadArgument(
            f"A shift by {rows} rows and {columns} columns of patches leaves nothing of a picture of {grid.rows} x "
            f"{grid.columns} patches."
        )
    height, width = picture.shape[:2]
    down, right = round(rows * height / grid.rows), round(columns * width / grid.columns)
    row = np.clip(np.arange(height) - down, 0, height - 1)
    column = np.clip(np.arange(width) - right, 0, width - 1)
    return np.ascontiguousarray(picture[row[:, None], column[None, :]])


def patch_pixels(patches: NDArray[np.bool_], grids: Sequence[PatchGrid], shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Return the mask of the pixels that belong to the chosen patches (patch,) of a camera's grids, in order."""
    mask = np.zeros(shape[:2], dtype=bool)
    for grid in grids:
        own, patches = patches[: grid.num_patches], patches[grid.num_patches :]
        if grid.covers_all:
            row = np.arange(shape[0]) * grid.rows // shape[0]
            column = np.arange(shape[1]) * grid.columns // shape[1]
            mask |= own.reshape(grid.rows, grid.columns)[row[:, None], column[None, :]]
        else:
            down, across = grid.shares(*shape[:2])
            mask |= (down > 0).T @ own.reshape(grid.rows, grid.columns) @ (across > 0)
    return mask


def masked(picture: Picture, mask: NDArray[np.bool_]) -> Picture:
    """Return the picture with the mean colour of the pixels outside of the mask inside of it; grey if there are none.

    A picture without a pixel in the mask is returned as it is.
    """
    if not mask.any():
        return picture
    result = picture.copy()
    result[mask] = GREY if mask.all() else np.rint(picture[~mask].mean(axis=0)).astype(np.uint8)
    return result


def filled(picture: Picture, mask: NDArray[np.bool_]) -> Picture:
    """Return the picture with the mask filled from its surroundings by push and pull, then smoothed.

    Pull: pictures of half, a quarter ... of the size, each pixel the mean of the known ones among its four. Push: from
    the coarsest to the finest, unknown pixels take the colour of the coarser one. Then every pixel of the mask becomes
    the mean of its four neighbours, some sixty times. The method of Gortler and others, The Lumigraph (1996), section
    3.4.3, with weights 0 and 1. A mask over everything gives a grey picture.
    """
    if not mask.any():
        return picture
    if mask.all():
        return blank(picture)
    colour = np.where(mask[..., None], 0.0, picture.astype(np.float64))
    smooth = _push_pull(colour, ~mask)
    for _ in range(_SMOOTHING_ROUNDS):
        framed = np.pad(smooth, ((1, 1), (1, 1), (0, 0)), mode="edge")
        mean = (framed[:-2, 1:-1] + framed[2:, 1:-1] + framed[1:-1, :-2] + framed[1:-1, 2:]) / 4
        smooth[mask] = mean[mask]
    result = picture.copy()
    result[mask] = np.rint(smooth[mask]).clip(0, 255).astype(np.uint8)
    return result


def _push_pull(colour: NDArray[np.float64], known: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return (height, width, 3) with the unknown pixels filled; at least one pixel is known."""
    if known.all():
        return colour
    height, width = known.shape
    even = ((0, height % 2), (0, width % 2))
    weight = np.pad(known.astype(np.float64), even)
    weighted = np.pad(colour * known[..., None], (*even, (0, 0)))
    quarter = (weight.shape[0] // 2, 2, weight.shape[1] // 2, 2)
    count = weight.reshape(quarter).sum(axis=(1, 3))
    total = weighted.reshape(*quarter, 3).sum(axis=(1, 3))
    coarse = _push_pull(total / np.maximum(count, 1)[..., None], count > 0)
    enlarged = coarse.repeat(2, axis=0).repeat(2, axis=1)[:height, :width]
    return np.where(known[..., None], colour, enlarged)
