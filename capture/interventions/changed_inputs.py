"""What a policy call is given, with the prompt and the pictures that interventions change."""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from vla_attention.capture.interventions import images
from vla_attention.capture.interventions.prompts import changed_instruction
from vla_attention.capture.policies.policy import GivenInputs, camera_grid
from vla_attention.schemas.errors import BadArgument, unknown_name
from vla_attention.schemas.groupings.resolve import EmptyGroup
from vla_attention.schemas.groupings.vocabulary import SceneObject
from vla_attention.schemas.interventions import ImageChange, Interventions
from vla_attention.schemas.layout import SiteLayout
from vla_attention.schemas.stores.store_format import episode_name


@dataclass(frozen=True)
class CallContext:
    """Where a policy call is in its run, and what is known of its scene.

    instructions: of the suite's tasks, by task id. coverage: camera -> (patch, object), the share of each patch that
    each of `objects` covers.
    """

    task_id: int
    episode_index: int
    replan: int
    instructions: Mapping[int, str] = field(default_factory=dict)
    objects: Sequence[SceneObject] = ()
    coverage: Mapping[str, NDArray[np.float32]] = field(default_factory=dict)


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
        return images.blank(picture)
    if change.kind == "noise":
        place = (context.task_id, context.episode_index, context.replan, zlib.crc32(change.camera.encode()))
        return images.noise(picture, np.random.default_rng((change.seed, *place)))
    if change.kind == "rotated":
        return images.rotated(picture)
    grid = camera_grid(sites, change.camera)
    if change.kind == "shifted":
        return images.shifted(picture, grid, change.rows, change.columns)
    patches = object_patches(change, context, known=allow_empty)
    if not patches.any() and not allow_empty:
        raise EmptyGroup(
            f"The object '{change.object}' is out of view of camera '{change.camera}' at replan {context.replan} of "
            f"{episode_name(context.task_id, context.episode_index)}; add --allow-empty to leave such pictures as they "
            "are."
        )
    mask = images.patch_pixels(patches, grid, picture.shape)
    return images.masked(picture, mask) if change.kind == "masked" else images.filled(picture, mask)


def object_patches(change: ImageChange, context: CallContext, *, known: bool = False) -> NDArray[np.bool_]:
    """Return which patches (patch,) of the camera show some of the object; none where it is out of view.

    known: the object is known to exist in another scene of the run, and its absence here is no mistake.
    """
    if change.camera not in context.coverage:
        raise BadArgument(
            f"Cannot find the patches of '{change.object}' in camera '{change.camera}': there is no object coverage of "
            "it; use a store as vla-capture wrote it, not a copy without objects."
        )
    covered, names = context.coverage[change.camera], [thing.name for thing in context.objects]
    if change.object not in names and known:
        return np.zeros(len(covered), dtype=bool)
    if change.object not in names:
        raise unknown_name("object", change.object, names)
    patches: NDArray[np.bool_] = covered[:, names.index(change.object)] > 0
    return patches
