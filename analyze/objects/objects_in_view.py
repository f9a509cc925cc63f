"""What the objects of a scene are on the pictures, and how one layer's maps are held against them. Arrays only; no tables."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vla_attention.analyze.measures.patch_maps import seen_cameras
from vla_attention.analyze.measures.selected import SelectedEpisode
from vla_attention.analyze.objects.spatial import (
    centre_of_mass,
    distance_in_pictures,
    grown,
    intersection_over_union,
    mask_sizes,
    near_patches,
    object_masks,
    otsu_regions,
    patch_centres,
    percentile_regions,
    pointing_hits,
    random_iou,
)
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.groupings.vocabulary import SceneObject
from vla_attention.schemas.layout import PatchGrid, Span
from vla_attention.schemas.stores.store_format import RootAttributes

#: All cameras' pictures together, where one camera's name stands otherwise.
ALL_CAMERAS = "all"
#: The classes of objects, in the order in which they are shown.
CLASSES = ("of interest", "other objects", "robot", "background")
Array = NDArray[np.float64]


@dataclass(frozen=True)
class ObjectSettings:
    """How maps are held against objects.

    Attributes:
        percentiles: thresholds of the attended region, beside Otsu's.
        mask_coverage: a patch belongs to an object when the object covers at least this share of it.
        tolerance: in patch widths, how far beside the object the maximum may lie in the pointing game. One patch of 14 pixels is
            about the 15 pixels of Zhang et al. 2018.
        spatial: whether centres, pointing game and IoU are computed at all (they take most of the time).
    """

    percentiles: tuple[float, ...] = (80.0, 90.0, 95.0)
    mask_coverage: float = 0.5
    tolerance: float = 1.0
    spatial: bool = True

    def __post_init__(self) -> None:
        """Check the ranges."""
        for percentile in self.percentiles:
            if not 0.0 < percentile < 100.0:
                raise BadArgument(f"Percentile {percentile:g} was given; expected a number above 0 and below 100.")
        if len(set(self.percentiles)) != len(self.percentiles):
            raise BadArgument("A percentile was given twice.")
        if not 0.0 < self.mask_coverage <= 1.0:
            raise BadArgument(f"Mask coverage {self.mask_coverage:g} was given; expected a share above 0, at most 1.")
        if self.tolerance < 0.0:
            raise BadArgument(f"Tolerance {self.tolerance:g} was given; expected 0 or more patch widths.")

    @property
    def thresholds(self) -> tuple[str, ...]:
        """Names of the thresholds as in the columns `iou_p90`, `iou_otsu`."""
        return (*(f"p{percentile:g}" for percentile in self.percentiles), "otsu")


@dataclass(frozen=True)
class View:
    """One camera of one episode: its keys, and what its patches show.

    Attributes:
        camera: its name.
        span: its keys.
        grid: how they tile the picture.
        area: covered share of each patch (replan, patch, item) float32, 0..1.
        masks: 1 for the patches that belong to an item, else 0, (replan, patch, item) float32.
        hit_masks: `masks` with the patches that count as hits in the pointing game.
        sizes: number of patches of each mask, (replan, item).
        centres: of the patches, (patch, 2).
        item_centres: of the items, weighted by covered area, (replan, item, 2); NaN where there is none.
    """

    camera: str
    span: Span
    grid: PatchGrid
    area: NDArray[np.float32]
    masks: NDArray[np.float32]
    hit_masks: NDArray[np.float32]
    sizes: NDArray[np.int64]
    centres: Array
    item_centres: Array


def class_of(thing: SceneObject) -> str:
    """The class of an object in its task: what the task names as its subject comes before what it is."""
    if thing.of_interest:
        return CLASSES[0]
    return {"robot": CLASSES[2], "background": CLASSES[3]}.get(thing.kind, CLASSES[1])


def site_of_pictures(root: RootAttributes, wanted: str | None) -> str:
    """The wanted site, or the first one with cameras; an error when the wanted one has none."""
    seeing = [site.name for site in root.sites if site.cameras]
    if wanted is None and seeing:
        return seeing[0]
    if wanted is not None and (wanted in seeing or wanted not in [site.name for site in root.sites]):
        return wanted  # a name that does not exist is `choose_site`'s to refuse
    raise BadArgument(
        f"Site '{wanted or root.sites[0].name}' has no pictures; choose one with --site: {', '.join(seeing)}."
    )


def cameras_of(item: SelectedEpisode) -> tuple[str, ...]:
    """Cameras that show the policy something and whose patches' objects are known."""
    return tuple(camera for camera in seen_cameras(item) if camera in (item.tokens.coverage or {}))


def items_of(item: SelectedEpisode) -> tuple[list[tuple[str, str, str]], NDArray[np.float32]]:
    """(kind, name, class) of every item, and which objects make it up, shape (object, item)."""
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
        span = item.tokens.layout.camera_span(camera)
        grid = span.grid
        assert grid is not None
        # Areas of objects add up to that of their class; the sum may exceed 1 by rounding.
        area = np.minimum(coverage[camera] @ members, np.float32(1.0))
        masks = object_masks(area, settings.mask_coverage)
        near = near_patches(grid.rows, grid.columns, settings.tolerance)
        centres = patch_centres(grid.rows, grid.columns)
        views.append(
            View(
                camera=camera,
                span=span,
                grid=grid,
                area=area,
                masks=masks.astype(np.float32),
                hit_masks=(grown(masks, near) if settings.spatial else masks).astype(np.float32),
                sizes=mask_sizes(masks).astype(np.int64),
                centres=centres,
                item_centres=centre_of_mass(area.transpose(0, 2, 1), centres),
            )
        )
    return views


def measure_maps(
    maps: NDArray[np.float32], view: View, settings: ObjectSettings
) -> tuple[dict[str, Array], dict[str, Array]]:
    """Measures of maps (replan, head, patch): by item (replan, head, item), and by map (replan, head)."""
    by_item = {"mass": np.matmul(maps, view.area).astype(np.float64)}
    by_map = {"camera_mass": maps.sum(axis=-1, dtype=np.float64)}
    if not settings.spatial:
        return by_item, by_map
    rows, columns = view.grid.rows, view.grid.columns
    centre = centre_of_mass(maps, view.centres)
    by_map |= {"centre_row": centre[..., 0], "centre_column": centre[..., 1]}
    distance = distance_in_pictures(centre[:, :, None, :], view.item_centres[:, None], rows, columns)
    by_item["distance"] = np.where(view.sizes[:, None, :] > 0, distance, np.nan)
    by_item["pointing"] = pointing_hits(maps, view.hit_masks)
    regions = {f"p{value:g}": percentile_regions(maps, value) for value in settings.percentiles}
    regions["otsu"] = otsu_regions(maps)
    for name, region in regions.items():
        by_item[f"iou_{name}"] = intersection_over_union(region, view.masks)
        by_item[f"iou_{name}_chance"] = random_iou(
            region.sum(axis=-1)[..., None], view.sizes[:, None, :], view.grid.num_patches
        )
    return by_item, by_map


def distance_of_uniform(view: View) -> Array:
    """Distance from the picture's middle, where a uniform map has its centre, to every item's, shape (replan, item)."""
    rows, columns = view.grid.rows, view.grid.columns
    return distance_in_pictures(np.array([rows / 2, columns / 2]), view.item_centres, rows, columns)
