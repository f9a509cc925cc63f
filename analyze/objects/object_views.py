"""What each camera of an episode shows: areas and masks of objects and of their classes, by patch. Arrays only."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vla_attention.analyze.measures.patch_maps import PictureMap, seen_cameras
from vla_attention.analyze.measures.selected import SelectedEpisode
from vla_attention.analyze.objects.object_settings import ObjectSettings
from vla_attention.analyze.objects.pointing_and_iou import (
    centre_of_mass,
    distance_in_pictures,
    grown,
    mask_sizes,
    near_patches,
    object_masks,
    patch_centres,
)
from vla_attention.analyze.stores.selection import site_that
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.groupings.vocabulary import SceneObject
from vla_attention.schemas.stores.store_format import RootAttributes

#: Stands for all cameras together in the column `camera`.
ALL_CAMERAS = "all"
#: The classes of objects, in the order in which they are shown.
CLASSES = ("of interest", "other objects", "robot", "background")
Array = NDArray[np.float64]


@dataclass(frozen=True)
class View:
    """One camera of one episode: its keys, and the items that its patches show.

    Attributes:
        camera: its name.
        picture: its patches, and how they lie on the map of its picture, whose cells are counted below. Of one grid
            over the whole picture these are its patches; of several grids a cell shows what the smallest patch there
            shows.
        area: covered share of each patch (replan, patch, item) float32, 0..1.
        masks: 1 for the cells that belong to an item, else 0, (replan, cell, item) float32.
        hit_masks: `masks` with the cells that count as hits in the pointing game.
        sizes: number of cells of each mask, (replan, item).
        centres: of the cells, (cell, 2).
        item_centres: of the items, weighted by covered area, (replan, item, 2); NaN where there is none.
    """

    camera: str
    picture: PictureMap
    area: NDArray[np.float32]
    masks: NDArray[np.float32]
    hit_masks: NDArray[np.float32]
    sizes: NDArray[np.int64]
    centres: Array
    item_centres: Array


def class_of(thing: SceneObject) -> str:
    """The class of an object in its task: an object of interest belongs to that class, whatever its kind."""
    if thing.of_interest:
        return CLASSES[0]
    return {"robot": CLASSES[2], "background": CLASSES[3]}.get(thing.kind, CLASSES[1])


def site_of_pictures(root: RootAttributes, wanted: str | None) -> str:
    """The wanted site, or the first one with cameras.

    Raises:
        BadArgument: the wanted site, or every site, has no camera.
    """
    site = site_that(root, wanted, lambda site: bool(site.pictured))
    if site is None:
        seeing = [site.name for site in root.sites if site.pictured]
        raise BadArgument(
            f"Site '{wanted or root.sites[0].name}' has no pictures; choose one with --site: {', '.join(seeing)}."
        )
    return site


def cameras_of(item: SelectedEpisode) -> tuple[str, ...]:
    """The cameras that the policy sees and whose object coverage was stored."""
    return tuple(camera for camera in seen_cameras(item) if camera in (item.tokens.coverage or {}))


def items_of(item: SelectedEpisode) -> tuple[list[tuple[str, str, str]], NDArray[np.float32]]:
    """(kind, name, class) of every item, and the objects that belong to it, shape (object, item)."""
    things = item.tokens.objects
    classes = [class_of(thing) for thing in things]
    names = [("class", name, name) for name in CLASSES if name in classes]
    names += [("object", thing.name, of) for thing, of in zip(things, classes, strict=True)]
    members = np.array(
        [[(of if kind == "class" else thing.name) == name for kind, name, _ in names]
         for thing, of in zip(things, classes, strict=True)], dtype=np.float32,
    )  # fmt: skip
    return names, members


def views_of(item: SelectedEpisode, members: NDArray[np.float32], settings: ObjectSettings) -> list[View]:
    """What every camera shows of the items; `members` (object, item) is from `items_of`."""
    views = []
    coverage = item.tokens.coverage or {}
    for camera in cameras_of(item):
        picture = PictureMap.of(item.tokens.layout, camera)
        rows, columns = picture.rows, picture.columns
        # Areas of objects add up to that of their class; the sum may exceed 1 by rounding.
        area = np.minimum(coverage[camera] @ members, np.float32(1.0))
        shown = area if picture.cells_are_patches else picture.finest(area.swapaxes(1, 2)).swapaxes(1, 2)
        masks = object_masks(shown, settings.mask_coverage)
        near = near_patches(rows, columns, settings.tolerance)
        centres = patch_centres(rows, columns)
        views.append(
            View(
                camera=camera,
                picture=picture,
                area=area,
                masks=masks.astype(np.float32),
                hit_masks=(grown(masks, near) if settings.spatial else masks).astype(np.float32),
                sizes=mask_sizes(masks).astype(np.int64),
                centres=centres,
                item_centres=centre_of_mass(shown.transpose(0, 2, 1), centres),
            )
        )
    return views


def distance_of_uniform(view: View) -> Array:
    """Distance from the picture's middle, where a uniform map has its centre, to every item's, shape (replan, item)."""
    rows, columns = view.picture.rows, view.picture.columns
    return distance_in_pictures(np.array([rows / 2, columns / 2]), view.item_centres, rows, columns)


def item_name(row: Mapping[str, Any]) -> str:
    """The name of an item in texts and plots: classes in brackets, because an object may have the name of a class."""
    return f"[{row['item']}]" if row["kind"] == "class" else str(row["item"])
