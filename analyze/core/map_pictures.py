"""Maps of which patches move the action (`schemas.effects.EffectMap`), as they are drawn on the pictures of a call.

Drawn is how many times the mean of the call's patches each of them has. By first order that is an order of all patches;
what single ones do was measured by exact calls without them: they are marked, and their sizes are said in words. The
two scales are never mixed in one map. Of other maps all sizes are exact, and each patch has that of its block.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.core.action_changes import ActionUnits
from vla_attention.analyze.core.camera_maps import EpisodeMaps, PictureMap, upright, view_of
from vla_attention.analyze.core.patch_maps import exact_changes, map_at_site
from vla_attention.analyze.measures.selected import SelectedEpisode
from vla_attention.schemas.effects import MAP, MapWay
from vla_attention.schemas.layout import Role
from vla_attention.schemas.stores.store_format import PolicyCameraView

Array = NDArray[np.float64]
#: What is drawn, by the way of the map.
HOW: dict[MapWay, str] = {
    "first order": "how far the action changes without a patch, by first order: an order of the patches, and no size",
    "hidden": "how far the action changes when a block of patches is hidden",
    "picture": "how far the action changes when a block of the picture is filled from its surroundings",
}
#: So many patches are compared: those that are read most, and those that move the action most.
MOST = 10


@dataclass(frozen=True)
class CameraMoves:
    """A map on one camera's pictures, in the orientation in which they are stored, as `CameraMap` has attention.

    Attributes:
        picture: how its patches lie on the map.
        view: how the picture was turned.
        lift: the map at every cell / its mean over all patches that the policy saw in the call, on all pictures,
            (map row, row, column); NaN where no patch shows a picture.
        sizes: exact change without each patch of `picture.keys`, first part of the units, (map row, patch); NaN where
            there was no exact call.
    """

    picture: PictureMap
    view: PolicyCameraView
    lift: Array
    sizes: Array

    @cached_property
    def exact(self) -> Array:
        """The largest exact change of the patches at each cell, (map row, row, column); NaN without one."""
        known = self.picture.highest(np.isfinite(self.sizes).astype(float)) > 0
        return np.where(known, self.picture.highest(np.nan_to_num(self.sizes)), np.nan)

    def marks(self, row: int) -> list[tuple[float, float, float]]:
        """The exact patches of a map row: centres x and y, parts of the picture as a person sees it; and sizes."""
        found = []
        for patch in np.flatnonzero(np.isfinite(self.sizes[row])):
            x, y = self._centres[patch]
            x, y = 1.0 - x if self.view.mirrored else x, y if self.view.upright else 1.0 - y
            found.append((float(x), float(y), float(self.sizes[row, patch])))
        return found

    @cached_property
    def _centres(self) -> Array:
        """The centres x and y of the patches in the stored picture, (patch, 2), parts of its sides."""
        found = []
        for grid in self.picture.grids:
            top, left, height, width = grid.part
            down, across = np.indices((grid.rows, grid.columns)) + 0.5
            found.append(np.stack([left + width * across / grid.columns, top + height * down / grid.rows], axis=-1))
        return np.concatenate([one.reshape(-1, 2) for one in found])


@dataclass(frozen=True)
class EpisodeMoves:
    """Which patches move the action in one episode.

    Attributes:
        replan: the policy calls that have a map, (map row,), increasing.
        cameras: by name, in key order.
        way: how it was made.
        marked: whether patches are marked: those of exact calls, where not all are.
        single: whether each block is one patch.
    """

    replan: tuple[int, ...]
    cameras: Mapping[str, CameraMoves]
    way: MapWay
    marked: bool
    single: bool

    def row(self, replan: int) -> int | None:
        """The map row of a replan; None without a map."""
        return self.replan.index(replan) if replan in self.replan else None

    @property
    def lifts(self) -> Array:
        """Of all cells of all calls, for a scale."""
        return np.concatenate([one.lift.ravel() for one in self.cameras.values()])


def has_map(item: SelectedEpisode) -> bool:
    """Whether an episode has a map of the patches of the site whose tokens it has."""
    return map_at_site(item) is not None


def episode_moves(item: SelectedEpisode, cameras: Sequence[str], units: ActionUnits) -> EpisodeMoves | None:
    """Read an episode's maps of some cameras, exact sizes in the first part of `units`; None where it has no map."""
    one = map_at_site(item)
    if one is None:
        return None
    blocks = list(one.blocks or range(len(one.keys)))
    values = item.episode.read(MAP).astype(np.float64)[:, blocks]  # (map row, patch)
    keys, roles, layout = list(one.keys), item.tokens.static_roles, item.tokens.layout
    sizes = exact_changes(item, one, units)[0][:, blocks]
    seen = roles[np.minimum(one.replan, len(roles) - 1)][:, keys] == Role.IMAGE
    if one.way != "first order":  # a block without an exact call has no size
        seen = seen & np.isfinite(sizes)
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = np.nanmean(np.where(seen, values, np.nan), axis=1, keepdims=True)
        lifts = np.where(mean > 0, values / mean, 0.0)  # where no patch does anything, none does more than others
        of_keys = {}
        for name, array in {"lift": np.where(seen, lifts, 0.0), "seen": seen, "size": sizes}.items():
            of_keys[name] = np.full((len(values), layout.num_keys), np.nan if name == "size" else 0.0)
            of_keys[name][:, keys] = array
        found = {}
        for camera in cameras:
            picture = PictureMap.of(layout, camera)
            own = {name: array[:, picture.keys] for name, array in of_keys.items()}
            # As the lift of attention: the sum of a cell over what it would be if all patches had the mean.
            lift = picture.spread(own["lift"]) / picture.spread(own["seen"])
            found[camera] = CameraMoves(picture, view_of(item, camera), lift, own["size"])
    single = one.num_blocks == len(one.keys)
    return EpisodeMoves(one.replan, found, one.way, one.way == "first order" and bool(one.patch), single)


def in_both(maps: EpisodeMaps, moves: EpisodeMoves, replan: int) -> tuple[int, int, int] | None:
    """Of the patches that are read most, how many are among those that move the action most; of a call with a map.

    Returns:
        that number; the number of patches that are compared on each side, at most `MOST`; and of all patches. None
        without a map, and where blocks, or cells of the pictures' maps, are not single patches.
    """
    row = moves.row(replan)
    if row is None or not moves.single or not all(one.picture.cells_are_patches for one in moves.cameras.values()):
        return None
    read = np.concatenate([maps.cameras[camera].mass[replan].ravel() for camera in moves.cameras])
    moved = np.concatenate([one.lift[row].ravel() for one in moves.cameras.values()])
    read, moved = (values[np.isfinite(moved)] for values in (read, moved))
    number = min(MOST, len(moved) // 2)
    tops = [set(np.argsort(-values, kind="stable")[:number].tolist()) for values in (read, moved)]
    return len(tops[0] & tops[1]), number, len(moved)


def with_moves(patches: pl.DataFrame, moves: EpisodeMoves | None) -> pl.DataFrame:
    """A table of `patch_table` with columns of the map: moves, times the mean patch; exact, see `CameraMoves.exact`.

    Both are null where there is no map, and exact where there was no exact call.
    """
    arrays = {name: np.full(patches.height, np.nan) for name in ("moves", "exact")}
    for number, (camera, replan, *cell) in enumerate(patches.select("camera", "replan", "row", "column").iter_rows()):
        if moves is not None and (at := moves.row(replan)) is not None:
            own = moves.cameras[camera]
            arrays["moves"][number], arrays["exact"][number] = (one[at, *cell] for one in (own.lift, own.exact))
    return patches.with_columns(pl.Series(name, array, nan_to_null=True) for name, array in arrays.items())


def shown_lift(one: CameraMoves, row: int) -> Array:
    """The lift of a map row the way a person sees the scene, (row, column)."""
    return upright(one.lift[row], one.view)
