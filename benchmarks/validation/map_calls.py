"""Maps of the patches of stored policy calls: four ways to make one, and what the calls are given in other words."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from benchmarks.single_patches import every_patch, sizes, without
from benchmarks.validation.calls import chosen_replans
from benchmarks.validation.changes import BASE_CAMERA, WRIST_CAMERA
from vla_attention.capture.effects.patch_maps import first_order
from vla_attention.capture.environments.cubes.environment import MARK
from vla_attention.capture.environments.cubes.scene import MARK_VERBS, paste_mark
from vla_attention.capture.environments.cubes.tasks import CUBE_TASKS, NAMED_COLOURS, Target
from vla_attention.capture.interventions.changed_inputs import CallContext, patch_pixels
from vla_attention.capture.policies.policy import CallVariant, GivenInputs
from vla_attention.capture.recording.attention import RowCollector, RowSink
from vla_attention.capture.rerun.stored_calls import read_calls
from vla_attention.schemas.groupings.vocabulary import SceneObject
from vla_attention.schemas.layout import PatchGrid, camera_grids
from vla_attention.schemas.stores.reader import Store, StoredEpisode

Array = NDArray[np.float64]
#: Map -> what it is.
MAPS = {
    "exact": "exact knock-outs",
    "first": "first order",
    "attention": "attention of the action queries",
    "masks": "random blurred masks",
}
#: Masks of a map, the part of the patches that each blurs, and the blur's standard deviation in patches.
MASKS, CHANCE, BLUR = 100, 0.3, 1.0


@dataclass(frozen=True)
class Call:
    """A stored policy call. covers: object -> (patch,), the part of each patch of both cameras that it covers."""

    episode: StoredEpisode
    given: GivenInputs
    seed: int
    context: CallContext
    covers: Mapping[str, Array]

    @property
    def objects(self) -> Sequence[SceneObject]:
        """Those of the scene."""
        return self.context.objects

    @property
    def named(self) -> list[str]:
        """The cubes that the sentence, or the mark, names."""
        return [one.name for one in self.objects if one.of_interest and one.name != MARK]

    @property
    def others(self) -> list[str]:
        """The other cubes."""
        return [one.name for one in self.objects if one.kind == "object" and not one.of_interest and one.name != MARK]


class Measured:
    """A policy, and the maps of its calls."""

    def __init__(self, policy: Any, steps: int) -> None:
        self.policy, self.steps = policy, steps
        self.patches = every_patch(policy)[:, 0]
        self.cameras = [camera.name for camera in policy.cameras]
        grids = [camera_grids(policy.sites, camera) for camera in self.cameras]
        self.grids = dict(zip(self.cameras, grids, strict=True))
        self.wrist = np.repeat([one == WRIST_CAMERA for one in self.cameras], [_number(of) for of in grids])

    def calls(self, store: Store, replans: int, moved: int = 0) -> Iterator[Call]:
        """So many calls of every episode, evenly spaced; moved: see `Suite`."""
        for episode in store.episodes:
            calls = read_calls(episode)
            for replan in map(int, chosen_replans(calls.num_replans, replans)):
                context = calls.context(replan, {})
                shown = [
                    moved_cover(context.coverage[camera], grids[0], moved if camera == BASE_CAMERA else 0)
                    for camera, grids in self.grids.items()
                ]
                cover = np.concatenate(shown)
                covers = {thing.name: cover[:, i].astype(np.float64) for i, thing in enumerate(context.objects)}
                yield Call(episode, calls.given(replan), int(calls.noise_seed[replan]), context, covers)

    def variant(self, given: GivenInputs, seed: int) -> CallVariant:
        """The call with these inputs."""
        return CallVariant(self.policy.prepare_again(given), seed)

    def changes(self, call: Call, variants: Sequence[CallVariant]) -> Array:
        """Sizes (variant,) of the change of a call."""
        return sizes(self.policy, self.variant(call.given, call.seed), variants, self.steps)

    def exact(self, given: GivenInputs, seed: int) -> Array:
        """The change without each single patch, (patch,)."""
        base = self.variant(given, seed)
        hidden = [without(self.policy, base.policy_input, seed, [key]) for key in self.patches]
        return sizes(self.policy, base, hidden, self.steps)

    def maps(self, given: GivenInputs, seed: int, draw: int = 0) -> dict[str, Array]:
        """The `MAPS` (patch,) of a call; draw: of the directions, and of the masks."""
        base, generator = self.variant(given, seed), np.random.default_rng([draw, seed])
        horizon = self.policy.action_horizon
        order, _ = first_order(self.policy, base.policy_input, seed, self.steps, horizon, (draw, seed))
        rows = _MeanRows()
        self.policy.act(base.policy_input, seed, {self.policy.sites[0].name: rows})
        masks = generator.random((MASKS, len(self.patches))) < CHANCE
        changed = sizes(
            self.policy, base, [self.variant(self.blurred(given, mask), seed) for mask in masks], self.steps
        )
        found = {
            "exact": self.exact(given, seed),
            "first": order.astype(np.float64),
            "attention": rows.mean()[self.patches],
            "masks": mask_scores(masks, changed),
        }
        assert list(found) == list(MAPS)
        return found

    def blurred(self, given: GivenInputs, chosen: NDArray[np.bool_]) -> GivenInputs:
        """The inputs with some patches (patch,) blurred in the pictures."""
        from PIL import Image, ImageFilter

        frames, start = dict(given.frames), 0
        for camera, grids in self.grids.items():
            of_camera = chosen[start : (start := start + _number(grids))]
            picture = frames[camera]
            radius = BLUR * picture.shape[1] / grids[0].columns
            blur = np.asarray(Image.fromarray(picture).filter(ImageFilter.GaussianBlur(radius)))
            frames[camera] = np.where(patch_pixels(of_camera, grids, picture.shape)[..., None], blur, picture)
        return replace(given, frames=frames, camera_frames={})

    def told_otherwise(self, call: Call, colour: str, by: str) -> GivenInputs:
        """The inputs in which the sentence, or the mark, names another cube."""
        task = CUBE_TASKS[call.context.task_id]
        if by == "sentence":
            return replace(call.given, instruction=replace(task, target=cast(Target, colour)).instruction)
        marked = paste_mark(
            call.given.frames[BASE_CAMERA], list(NAMED_COLOURS).index(colour), MARK_VERBS.index(task.verb)
        )
        return replace(call.given, frames={**call.given.frames, BASE_CAMERA: marked}, camera_frames={})


def moved_cover(cover: NDArray[np.float32], grid: PatchGrid, columns: int) -> NDArray[np.float32]:
    """What objects cover (patch, object) of a picture that was moved to the right by whole patches."""
    from_columns = np.clip(np.arange(grid.columns) - columns, 0, None)
    return cover.reshape(grid.rows, grid.columns, -1)[:, from_columns].reshape(cover.shape)


def mask_scores(masks: NDArray[np.bool_], changed: Array) -> Array:
    """The mean change (mask,) with the masks (mask, patch) that hide a patch, minus that of the others: (patch,)."""
    found: Array = masks.T @ changed / masks.sum(axis=0) - ~masks.T @ changed / (~masks).sum(axis=0)
    return found


class _MeanRows(RowCollector):
    """The mean row of attention of the action queries over layers, heads, steps and queries."""

    def __init__(self) -> None:
        self.rows: list[Array] = []

    def sink(self, layer: int, denoise_step: int, action_queries: slice) -> RowSink:
        """See `RowCollector`."""
        return lambda rows: self.rows.append(rows[0, :, action_queries].mean(dim=(0, 1)).double().numpy())

    def mean(self) -> Array:
        """Of all calls, (key,)."""
        found: Array = np.mean(self.rows, axis=0)
        return found


def _number(grids: Sequence[Any]) -> int:
    return int(sum(grid.num_patches for grid in grids))
