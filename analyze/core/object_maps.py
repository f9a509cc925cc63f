"""How well attention maps find objects (pointing game, IoU), and what the same maps get where objects do not stand.

What an object's place explains. Attention that is fixed to the middle of the picture covers an object there better than
uniform attention does, whatever it is. Objects stand elsewhere in other episodes of the task, so the same map is put on
the places that the object has there. Both sides are of the first policy call, at which nothing has moved: with M the
episode's map (those of each camera scaled to the sum 1, times W, the camera's share of the attention to the pictures),
and A(patch) the area that the object covers in the episode, or its mean over the task's other episodes,

    at_place, elsewhere = sum over patches of M A / sum over cameras of W (mean of A over the camera's patches)

A map that does not depend on where the object is gets the same of both, and episodes that are the same one have exactly
the same. An object that hardly moves between episodes has nearly the same: then the two cannot be told apart.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.core.camera_maps import PictureMap
from vla_attention.analyze.core.object_shares import ALL_CAMERAS, ITEM, cameras_of, covered, names_of
from vla_attention.analyze.core.pointing_and_iou import (
    centre_of_mass,
    distance_in_pictures,
    grown,
    intersection_over_union,
    mask_sizes,
    near_patches,
    object_masks,
    patch_centres,
    pointing_hits,
    regions_of_percentiles,
    shifted_iou,
    shifted_masks,
)
from vla_attention.analyze.measures.masses import finite_mean
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.measures.scan import Look
from vla_attention.analyze.measures.selected import SelectedEpisode, positions_by_task
from vla_attention.analyze.measures.tables import EPISODE_KEYS, Axis, head_axis, layer_axis, long_table, with_average
from vla_attention.analyze.stores.rows import LayerRows
from vla_attention.analyze.stores.selection import Selection

Array = NDArray[np.float64]
#: Percentiles of a map from which on its patches are the attended region.
PERCENTILES = (80.0, 90.0, 95.0)
#: A patch is the object's when it covers at least this share of it.
MASK_COVERAGE = 0.5
#: How far beside the object the highest patch may lie, in patch widths: one of 14 pixels is about the 15 pixels of
#: Zhang et al. 2018.
TOLERANCE = 1.0
#: Maps of a replan that are compared with masks at once: of two denoise steps of 18 layers, or of as many heads.
_MAPS_TOGETHER = 36
_OVER_PLACE = ("at_place", "elsewhere")
#: Less area than this is none: what is left of a sum from which another was taken.
_NO_AREA = 1e-9


@dataclass(frozen=True)
class ObjectMaps:
    """What the maps of one episode give.

    Attributes:
        pointing: one row per (layer or "layers_avg"[, head], camera, class or object); empty unless it was asked for:
            num_replans, mask_replans             all, and those at which the item has a mask: means are over these, and
                                                  over denoise steps
            mask_patches                          number of patches of the mask
            centre_row, centre_column             centre of attention in patches
            distance, distance_uniform            from it, and from the picture's middle, to the object's centre, in
                                                  picture sides
            pointing, pointing_chance             pointing game, and the share of patches that would score
            In "layers_avg" each is the mean of the layers' values, not the value of the layers' mean map.
        iou: the same rows once for each `threshold` (p80, p90, p95): iou, and iou_chance, the mean IoU with the mask
            moved about the picture. Empty as above.
        maps: M above of all cameras, (layer or 1, head or 1, patch); patches of each camera as in `num_patches`.
        area: covered share of the patches at the first call, (patch, item).
        axes: labels of the layers, the heads and the items.
    """

    pointing: pl.DataFrame
    iou: pl.DataFrame
    maps: NDArray[np.float32]
    area: NDArray[np.float32]
    num_patches: Mapping[str, int]
    axes: tuple[Axis, Axis, Axis]


def look_at_maps(
    question: Question, heads: bool, layers: bool, iou: bool, positions: Sequence[int] | None = None
) -> Look[ObjectMaps]:
    """The look at the maps of episodes with coverage.

    Args:
        question: stores, selection and site.
        heads: keep heads apart instead of averaging their maps.
        layers: keep the layers of `maps` apart; the other tables always do.
        iou: compare maps with masks, which takes most of the time.
        positions: of the episodes; all unless given.
    """
    begin = partial(_EpisodeMaps, layers=layers, iou=iou)
    return Look("maps", begin, heads, lambda _position, found: found, positions=positions)


def over_place(question: Question, found: Sequence[ObjectMaps]) -> pl.DataFrame:
    """The enrichment of each episode's first map where its objects stand, and where they do in the other episodes.

    Returns:
        One row per (episode, layer[, head], camera or all together, item) of which there are both: at_place, elsewhere.
    """
    parts = []
    for positions in positions_by_task(question.selected).values():
        members = [found[i] for i in positions]
        if len(members) < 2:
            continue
        total = _sum_by_item(members)
        for i, one in zip(positions, members, strict=True):
            parts += list(_both(question.selected[i], one, total))
    schema = {**dict.fromkeys(("suite", "layer", *ITEM[:3]), pl.String), **dict.fromkeys(("task_id", "episode_index",
              "head"), pl.Int64), **dict.fromkeys(_OVER_PLACE, pl.Float64)}  # fmt: skip
    return pl.concat(parts) if parts else pl.DataFrame(schema=schema)


def _sum_by_item(members: Sequence[ObjectMaps]) -> dict[tuple[str, str], Array]:
    """The areas of all episodes of a task by kind and name, each (patch,)."""
    total: dict[tuple[str, str], Array] = {}
    for one in members:
        for i, name in enumerate(_names(one)):
            total[name] = total.get(name, 0.0) + one.area[:, i].astype(np.float64)
    return total


def _names(one: ObjectMaps) -> list[tuple[str, str]]:
    return list(zip(one.axes[2]["kind"], one.axes[2]["item"], strict=True))


def _both(item: SelectedEpisode, one: ObjectMaps, total: Mapping[tuple[str, str], Array]) -> Iterator[pl.DataFrame]:
    own = one.area.astype(np.float64)
    others = np.stack([total[name] for name in _names(one)], axis=-1) - own
    cameras = np.repeat(list(one.num_patches), list(one.num_patches.values()))
    for camera in (ALL_CAMERAS, *one.num_patches):
        shown = cameras == camera if camera != ALL_CAMERAS else np.ones(len(cameras), dtype=bool)
        counts = list(one.num_patches.values()) if camera == ALL_CAMERAS else [one.num_patches[camera]]
        both = [enrichment_on(one.maps[..., shown], area[shown], counts)[None] for area in (own, others)]
        axes: list[Axis] = [{"camera": (camera,)}, {"layer": one.axes[0]["layer"]}, *one.axes[1:]]
        rows = long_table(item, axes, dict(zip(_OVER_PLACE, both, strict=True)))
        yield rows.drop("object_class").drop_nulls(_OVER_PLACE)


def enrichment_on(maps: NDArray[np.floating], area: NDArray[np.floating], num_patches: Sequence[int]) -> Array:
    """What maps give an area / what the same attention to each camera gives it, spread evenly over the picture.

    Args:
        maps: (..., patch), the patches of each camera in order.
        area: covered share of the patches, (patch, item).
        num_patches: of each camera.

    Returns:
        (..., item); NaN where the area is 0.
    """
    even: Array = np.zeros((*maps.shape[:-1], area.shape[1]))
    for own in np.split(np.arange(len(area)), np.cumsum(num_patches)[:-1]):
        even += maps[..., own].sum(axis=-1, keepdims=True, dtype=np.float64) * area[own].mean(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(even > _NO_AREA, (maps.astype(np.float64) @ area) / even, np.nan)


@dataclass(frozen=True)
class _View:
    """What one camera shows of the items. Cells are its patches, or those of a map of several grids (`PictureMap`).

    masks, hit_masks: 1 for cells of an item, and for those that count as hits, (replan, cell, item).
    """

    picture: PictureMap
    area: NDArray[np.float32]
    masks: NDArray[np.float32]
    hit_masks: NDArray[np.float32]
    item_centres: Array


def _view(item: SelectedEpisode, camera: str, members: NDArray[np.float32]) -> _View:
    picture, area = PictureMap.of(item.tokens.layout, camera), covered(item, camera, members)
    shown = area if picture.cells_are_patches else picture.finest(area.swapaxes(1, 2)).swapaxes(1, 2)
    masks = object_masks(shown, MASK_COVERAGE)
    hits = grown(masks, near_patches(picture.rows, picture.columns, TOLERANCE))
    centres = centre_of_mass(shown.transpose(0, 2, 1), patch_centres(picture.rows, picture.columns))
    return _View(picture, area, masks.astype(np.float32), hits.astype(np.float32), centres)


class _EpisodeMaps:
    """The `ObjectMaps` of an episode."""

    def __init__(
        self, item: SelectedEpisode, selection: Selection, _site: str, _given: None, layers: bool, iou: bool
    ) -> None:
        self.item, self.selection, self.layers, self.iou = item, selection, layers, iou
        self.names, members = names_of(item)
        self.views = {camera: _view(item, camera, members) for camera in cameras_of(item)}
        heads = len(selection.heads) if selection.per_head else 1
        cells = (item.tokens.num_replans, len(selection.layers), len(selection.denoise), heads)
        keys = {camera: view.picture.keys for camera, view in self.views.items()}
        self.maps = {camera: np.zeros((*cells, len(own)), np.float32) for camera, own in keys.items()}
        every = np.concatenate([*keys.values()])
        self.keys: range | None = range(every.min(), every.max() + 1)

    def add(self, part: LayerRows) -> None:
        """Keep what the patches get."""
        for camera, view in self.views.items():
            self.maps[camera][:, part.layer, part.denoise] = part.rows[..., view.picture.keys - part.keys.start]

    def content(self) -> ObjectMaps:
        """The maps, and how they lie on the objects."""
        item, selection, maps = self.item, self.selection, self.maps
        of_layers = layer_axis(selection)
        items: Axis = {label: [name[i] for name in self.names] for i, label in enumerate(ITEM[1:])}
        heads_axis = head_axis(selection)
        pointing, overlaps = [], []
        for camera, view in self.views.items() if self.iou else ():
            scores = _compared(maps[camera], view)
            averaged = {name: with_average(array, selection, 0, finite_mean)[None] for name, array in scores.items()}
            of_regions = {name: averaged.pop(name) for name in ("iou", "iou_chance")}
            axes: list[Axis] = [{"camera": (camera,)}, of_layers, heads_axis]
            pointing.append(long_table(item, [*axes, items], {**_of_masks(view), **averaged}, EPISODE_KEYS))
            thresholds: Axis = {"threshold": [f"p{percentile:g}" for percentile in PERCENTILES]}
            overlaps.append(long_table(item, [*axes, thresholds, items], of_regions, EPISODE_KEYS))
        place = slice(None, -1) if self.layers else slice(-1, None)
        means = [with_average(array[:1].mean(axis=2, dtype=np.float64), selection)[0, place] for array in maps.values()]
        of_camera = [array.sum(axis=-1, keepdims=True) for array in means]
        with np.errstate(invalid="ignore", divide="ignore"):
            whole = [array / sum(of_camera) for array in means]
        return ObjectMaps(
            pl.concat(pointing) if pointing else pl.DataFrame(),
            pl.concat(overlaps) if overlaps else pl.DataFrame(),
            np.concatenate(whole, axis=-1).astype(np.float32),
            np.concatenate([view.area[0] for view in self.views.values()]),
            {camera: len(view.picture.keys) for camera, view in self.views.items()},
            ({name: list(labels)[place] for name, labels in of_layers.items()}, heads_axis, items),
        )


def _of_masks(view: _View) -> dict[str, NDArray[np.float64]]:
    """What does not depend on maps, means over the replans at which an item has a mask: (1, 1, 1, item) each."""
    rows, columns = view.picture.rows, view.picture.columns
    sizes = mask_sizes(view.masks)
    there = sizes > 0  # (replan, item)
    by_replan = {
        "mask_patches": sizes,
        "distance_uniform": distance_in_pictures(np.array([rows / 2, columns / 2]), view.item_centres, rows, columns),
        "pointing_chance": mask_sizes(view.hit_masks) / (rows * columns),
    }
    counts = {"num_replans": np.full(there.shape[1], len(there)), "mask_replans": there.sum(axis=0)}
    means = {name: finite_mean(np.where(there, array, np.nan)) for name, array in by_replan.items()}
    return {name: array[None, None, None] for name, array in (counts | means).items()}


def _compared(maps: NDArray[np.float32], view: _View) -> dict[str, Array]:
    """Scores of maps (replan, layer, denoise, head, patch), means over replans and denoise steps.

    Returns:
        Those of `pointing` (layer, head, item or 1) and of `iou` (layer, head, threshold, item) by name.
    """
    picture = view.picture
    rows, columns = picture.rows, picture.columns
    shifted = shifted_masks(view.masks, rows, columns)
    there = mask_sizes(view.masks) > 0
    centres = patch_centres(rows, columns)
    parts: dict[str, list[Array]] = {}
    together = max(1, _MAPS_TOGETHER // (maps.shape[2] * maps.shape[3]))
    for first in range(0, maps.shape[1], together):
        own = maps[:, first : first + together]
        if not picture.cells_are_patches:
            own = picture.spread(own).reshape(*own.shape[:-1], -1)
        centre = centre_of_mass(own, centres)
        distance = distance_in_pictures(centre[..., None, :], view.item_centres[:, None, None, None], rows, columns)
        regions = regions_of_percentiles(own, PERCENTILES)
        found = {
            "centre_row": centre[..., :1],
            "centre_column": centre[..., 1:],
            "distance": np.where(there[:, None, None, None], distance, np.nan),
            "pointing": pointing_hits(own, view.hit_masks),
            "iou": np.stack([intersection_over_union(region, view.masks) for region in regions], axis=4),
            "iou_chance": np.stack([shifted_iou(region, shifted) for region in regions], axis=4),
        }
        for name, array in found.items():
            parts.setdefault(name, []).append(finite_mean(array, (0, 2)))
    return {name: np.concatenate(arrays) for name, arrays in parts.items()}
