"""Which patches move the actions of a call: by first order and the strongest exactly, or all blocks of them exactly.

The first order is an order of the patches, and sizes are of exact knock-outs alone: the two are kept apart
(`EffectMap`). Some of the patches that are not the strongest, drawn at random, are knocked out too: how their order
agrees with their exact one says how far the map can be trusted. `benchmarks/effect_maps.py` measures both against the
exact knock-outs of every patch. Blocks need no backward pass: any call that can be made again has a map of them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
from numpy.typing import NDArray

from vla_attention.capture.interventions.changed_inputs import Picture, filled
from vla_attention.capture.interventions.factors import SiteEdit, SiteEditor
from vla_attention.capture.policies.policy import (
    CallVariant,
    MapPolicy,
    Policy,
    PolicyInput,
    UnitsPolicy,
    map_keys,
    map_site,
)
from vla_attention.capture.store.replan_records import ReplanMap
from vla_attention.schemas.effects import EffectMap, EffectReaders, EffectsRecorded, MapBlocks
from vla_attention.schemas.errors import BadArgument, listing
from vla_attention.schemas.interventions import Queries
from vla_attention.schemas.layout import PatchGrid, Role, camera_grids

#: Directions of the first order, the part of the patches that are knocked out exactly, and how many at random.
PROJECTIONS, STRONGEST, DRAWN = 8, 0.15, 10


@dataclass(frozen=True)
class PictureBlock:
    """A block of a camera's picture: place (row, column) among `rows` x `columns`; keys: of its patches, by site."""

    camera: str
    place: tuple[int, int]
    keys: Mapping[str, tuple[int, ...]]


def single_patches(policy: Policy) -> list[PictureBlock]:
    """Return every patch of the map's site as a block."""
    site = map_site(policy)
    return [PictureBlock("", (0, 0), {site.name: (key,)}) for key in map_keys(policy)]


def picture_blocks(policy: Policy, planned: MapBlocks) -> list[PictureBlock]:
    """Return the blocks in which a patch of the map's site has its centre, cameras in the policy's order, row by row.

    Raises:
        BadArgument: two sites have different patches of a camera, or a block of its picture has none.
    """
    blocks = []
    for camera in (one.name for one in policy.cameras if one.name in map_site(policy).pictured):
        number = _block_of(camera_grids(policy.sites, camera), planned)
        keys = {site.name: site.patch_keys(camera) for site in policy.sites if camera in site.pictured}
        known = np.unique(number)
        if planned.way == "picture" and len(known) < planned.rows * planned.columns:
            grids = listing(grid.describe() for grid in camera_grids(policy.sites, camera))
            raise BadArgument(
                f"Cannot fill {planned.rows} x {planned.columns} blocks of the picture of camera '{camera}', which has "
                f"{grids}: a block without a patch has no place on the map. Take fewer."
            )
        for block in known:
            of_block = {site: tuple(int(key) for key in own[number == block]) for site, own in keys.items()}
            blocks.append(PictureBlock(camera, divmod(int(block), planned.columns), of_block))
    return blocks


def _block_of(grids: Sequence[PatchGrid], planned: MapBlocks) -> NDArray[np.int64]:
    """Return in which block the centre of every patch lies, (patch,)."""
    found = []
    for grid in grids:
        down, across = grid.centres()
        row, column = np.floor(down * planned.rows), np.floor(across * planned.columns)
        found.append((row[:, None] * planned.columns + column[None, :]).astype(np.int64).ravel())
    return np.concatenate(found)


def check_map(planned: EffectsRecorded, policy: Policy) -> None:
    """Raise `BadArgument` if the policy has no such map."""
    if "map" not in planned.items:
        return
    if planned.blocks is None and not isinstance(policy, MapPolicy):
        raise BadArgument(
            f"Cannot use --effects map with {policy.family}: its calls have no backward pass here. --effects map:4x4 "
            "hides blocks of patches one at a time."
        )
    if planned.denoise_steps < policy.num_denoise_steps:
        raise BadArgument("Cannot use --effects-steps with a map: its rounding is that of a call of all denoise steps.")
    readers = ("all",) if planned.blocks is None else ("all", "action")
    if (planned.blocks is None or planned.blocks.way == "hidden") and not set(readers) & set(planned.readers):
        raise BadArgument(
            f"Cannot make this map for the readers {listing(planned.readers)}; add one of {listing(readers)} to "
            "--effects-readers."
        )
    if not any(site.pictured for site in policy.sites):
        raise BadArgument(f"Cannot make a map of {policy.name}: no key is a patch of a picture.")
    if planned.blocks is not None:
        picture_blocks(policy, planned.blocks)


@dataclass(frozen=True)
class CallMap:
    """What is measured of one call.

    Attributes:
        blocks: of the map.
        planned: how they are taken away; None: every patch, by first order.
        chosen: the places of the blocks that are taken away exactly, and whether each was drawn at random.
        first_order: (block,) float32; None where all are exact.
        steps: of the chunk that count.
        reader: see `EffectMap`.
    """

    blocks: Sequence[PictureBlock]
    planned: MapBlocks | None
    chosen: Mapping[int, bool]
    first_order: NDArray[np.float32] | None
    steps: int
    reader: EffectReaders

    def variants(self, policy: Policy, policy_input: PolicyInput, noise_seed: int) -> dict[int, CallVariant]:
        """The calls without each chosen block, by its place."""
        make = self._another_picture if self.planned and self.planned.way == "picture" else self._hidden
        return {place: make(self.blocks[place], policy, policy_input, noise_seed) for place in self.chosen}

    def _hidden(self, block: PictureBlock, policy: Policy, given: PolicyInput, noise_seed: int) -> CallVariant:
        editors = {}
        for site in policy.sites:
            if keys := block.keys.get(site.name):
                factors = np.ones(site.num_keys)
                factors[list(keys)] = 0.0
                queries: Queries = "all" if self.reader == "all" else "action"
                editors[site.name] = SiteEditor(site.name, [SiteEdit("a patch", "factor", factors, queries)])
        return CallVariant(given, noise_seed, editors)

    def _another_picture(self, block: PictureBlock, policy: Policy, given: PolicyInput, noise_seed: int) -> CallVariant:
        assert self.planned is not None
        was = given.given
        frames = {**was.frames, block.camera: without_block(was.frames[block.camera], block.place, self.planned)}
        others = {camera: one for camera, one in was.camera_frames.items() if camera != block.camera}
        return CallVariant(policy.prepare_again(replace(was, frames=frames, camera_frames=others)), noise_seed, {})

    def stored(
        self, policy: Policy, changes: Mapping[int, NDArray[np.float32]], shape: tuple[int, ...]
    ) -> ReplanMap | None:
        """What is stored, with the changes of blocks by their places, each of a shape (horizon, action dim).

        Those that are not finite are left out; None where nothing is left.
        """
        kept = [place for place in self.chosen if place in changes and np.isfinite(changes[place]).all()]
        if not kept and self.first_order is None:
            return None
        change = np.stack([changes[place] for place in kept]) if kept else np.zeros((0, *shape), np.float32)
        site = map_site(policy).name
        keys = [(key, place) for place, block in enumerate(self.blocks) for key in block.keys[site]]
        if self.planned is None:
            form = EffectMap(site, tuple(key for key, _ in keys), PROJECTIONS, self.steps, (), (), (), ())
        else:
            keys.sort()
            form = EffectMap(
                site, tuple(key for key, _ in keys), 0, self.steps, (), (), (), (), self.planned.way,
                tuple(place for _, place in keys), "" if self.planned.way == "picture" else self.reader,
                (self.planned.rows, self.planned.columns),
            )  # fmt: skip
        sizes = self.first_order
        if sizes is None:
            sizes = np.zeros(len(self.blocks), np.float32)
            sizes[kept] = np.sqrt((change[:, : self.steps].astype(np.float64) ** 2).mean(axis=(1, 2)))
        return ReplanMap(form, sizes, tuple(kept), tuple(self.chosen[place] for place in kept), change)


def map_blocks(planned: EffectsRecorded, policy: Policy) -> list[PictureBlock]:
    """Return the blocks of a run's map, which are the same at all of its calls."""
    return single_patches(policy) if planned.blocks is None else picture_blocks(policy, planned.blocks)


def call_map(
    planned: EffectsRecorded, blocks: Sequence[PictureBlock], policy: Policy, policy_input: PolicyInput,
    noise_seed: int, steps: int, horizon: int, seed: tuple[int, ...],
) -> CallMap | None:  # fmt: skip
    """Return what is measured of a call; None where its first order is not finite.

    blocks: `map_blocks`. steps: of the chunk of `horizon` actions that are executed. seed: of the directions, and of
    the patches that are drawn.
    """
    site = map_site(policy)
    is_shown = policy_input.key_role[site.name] == Role.IMAGE
    if planned.blocks is not None:
        shown = [place for place, block in enumerate(blocks) if is_shown[list(block.keys[site.name])].any()]
        reader: EffectReaders = "all" if "all" in planned.readers else "action"
        return CallMap(blocks, planned.blocks, dict.fromkeys(shown, False), None, steps, reader)
    sizes, generator = first_order(policy, policy_input, noise_seed, steps, horizon, seed)
    if not np.isfinite(sizes).all():
        return None
    seen = np.flatnonzero(is_shown[list(map_keys(policy))])
    by_size = seen[np.argsort(-sizes[seen], kind="stable")]
    strongest = round(STRONGEST * len(seen))
    chosen = {int(place): False for place in by_size[:strongest]}
    chosen |= {int(place): True for place in generator.permutation(by_size[strongest:])[:DRAWN]}
    return CallMap(blocks, None, chosen, sizes, steps, "all")


def first_order(
    policy: Policy, policy_input: PolicyInput, noise_seed: int, steps: int, horizon: int, seed: tuple[int, ...]
) -> tuple[NDArray[np.float32], np.random.Generator]:
    """Return the size of each patch (patch,), and the generator that drew the directions."""
    generator = np.random.default_rng(seed)
    units, made_by = cast(UnitsPolicy, policy).action_units(), cast(MapPolicy, policy)
    signs = np.zeros((PROJECTIONS, horizon, len(units)), np.float32)
    moved = np.flatnonzero(units)
    signs[:, :steps, moved] = generator.choice([-1.0, 1.0], (PROJECTIONS, steps, len(moved)))
    gradients = made_by.patch_gradients(policy_input, noise_seed, signs / np.float32((steps * len(moved)) ** 0.5))
    return np.sqrt((gradients.astype(np.float64) ** 2).mean(axis=0)).astype(np.float32), generator


def without_block(picture: Picture, place: tuple[int, int], planned: MapBlocks) -> Picture:
    """Return a picture (height, width, 3) uint8 with a block filled from what is around it, as far as a block goes."""
    inside, around = [], []
    for at, number, pixels in zip(place, (planned.rows, planned.columns), picture.shape, strict=False):
        first, last = round(at * pixels / number), max(round((at + 1) * pixels / number), at * pixels // number + 1)
        begins = max(0, first - (last - first))
        around.append(slice(begins, min(pixels, last + (last - first))))
        inside.append(slice(first - begins, last - begins))
    mask = np.zeros(picture[tuple(around)].shape[:2], dtype=bool)
    mask[tuple(inside)] = True
    result = picture.copy()
    result[tuple(around)] = filled(picture[tuple(around)], mask)
    return result
