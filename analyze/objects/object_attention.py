"""How much attention objects get: shares and enrichment per object and class, and how well maps find the objects."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import partial
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.measures.frames import (
    EPISODE_KEYS,
    Axis,
    LayerAxis,
    TableInParts,
    denoise_axis,
    head_axis,
    layer_axis,
    long_table,
    replan_axis,
)
from vla_attention.analyze.measures.masses import finite_mean
from vla_attention.analyze.measures.not_in_memory import MadeWhenAsked, OnDisk
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.measures.selected import SelectedEpisode
from vla_attention.analyze.objects.control_masks import ControlParts, control_columns, control_source
from vla_attention.analyze.objects.object_settings import ObjectSettings
from vla_attention.analyze.objects.object_views import (
    ALL_CAMERAS,
    View,
    cameras_of,
    distance_of_uniform,
    items_of,
    views_of,
)
from vla_attention.analyze.objects.pointing_and_iou import (
    centre_of_mass,
    distance_in_pictures,
    intersection_over_union,
    mask_sizes,
    otsu_regions,
    pointing_hits,
    regions_of_percentiles,
    shifted_iou,
    shifted_masks,
)
from vla_attention.analyze.stores.parallel import each_episode
from vla_attention.analyze.stores.rows import layer_rows
from vla_attention.analyze.stores.selection import Selection
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.groupings.vocabulary import NO_COVERAGE
from vla_attention.schemas.progress_bar import progress_bar

Array = NDArray[np.float64]
#: Maps of a replan that are compared with masks at once: of two denoise steps of 18 layers, or of as many heads.
_MAPS_TOGETHER = 36
#: Replans of a camera that are a part of the tables of steps: 30,000 rows for four thresholds and 14 items.
_REPLANS_TOGETHER = 16


@dataclass(frozen=True)
class ObjectTables:
    """Tables of objects, see `object_tables`; `pointing` and `iou` are None without `ObjectSettings.spatial`."""

    objects: TableInParts
    times: TableInParts
    pointing: TableInParts | None = None
    iou: TableInParts | None = None
    steps: TableInParts | None = None
    iou_steps: TableInParts | None = None


def object_tables(question: Question, settings: ObjectSettings | None = None, keep_steps: bool = False) -> ObjectTables:
    """Measure every object and class of objects in every selected episode; shows progress at a terminal.

    Items are the scene's objects (`kind` "object") and their classes in the task (`kind` "class": of interest, other
    objects, robot, background), by `camera` and for all cameras together ("all"). Rows are averaged over heads unless
    they are kept apart.

    Returns:
        objects: one row per (episode, layer or "layers_avg"[, head], camera, item), from masses averaged over denoise
            steps:
            mass        sum over patches of row x covered area, mean over replans
            share       mass / mass of all patches of all cameras, mean over replans
            area_share  covered area / area of all patches of these cameras, mean over replans
            enrichment  share of this camera's mass / area_share, of these means: 1 is what attention gives that is
                        uniform over the picture. A mean of quotients would give a sliver that is in sight at one
                        replan as much weight as all other replans. Of all cameras together: sum W S / sum W A, with W
                        the camera's share of all cameras' mass, S the item's share of the camera's mass, A its
                        area_share there. This is a mean of the cameras' enrichments and lies between them; to
                        prefer a camera that shows the item larger is no enrichment.
            control_enrichment  the same of these maps on the item's masks of other episodes of the task
            control_balanced    stands for it in intervals
            control_overlap     how much these masks overlap with the episode's own (see `control_masks` for all three;
                        null where there is no control)
        times: one row per (episode, replan, camera, item) of the layers' and heads' mean: `share`, `area_share`,
            `even_share` (the share if each camera's attention were uniform over its picture), `env_step`.
        pointing: with `settings.spatial`, one row per (episode, layer or "layers_avg"[, head], camera, item): means
            over denoise steps and over the replans at which the item has a mask (`mask_replans` of `num_replans`; null
            where there is none):
            mask_patches                          number of cells of the mask (`View`: patches, or those of the map)
            centre_row, centre_column             centre of attention in cells of this camera's map
            centre_row_share, centre_column_share the same as a part of the picture's height and width
            distance, distance_uniform            from it, and from the middle of the picture, to the object's centre
            pointing, pointing_chance             pointing game, and the share of patches that would score
            In "layers_avg" each is the mean of the layers' values, not the value of the layers' mean map.
        iou: with `settings.spatial`, the same rows once for each `threshold` (`settings.thresholds`):
            iou, iou_chance                       IoU with the mask, and mean IoU of the shifted region
        steps, iou_steps: with `keep_steps`, mass and the measures of `pointing` and of `iou` per (episode, replan,
            layer, denoise step, head, camera, item).

    Raises:
        BadArgument: no selected episode has object coverage at this site.
    """
    settings = settings or ObjectSettings()
    if not any(cameras_of(item) for item in question.selected):
        raise BadArgument(f"Site '{question.site}': {NO_COVERAGE}.")
    showing = [item for item in question.selected if cameras_of(item)]
    episodes_of = Counter(item.task for item in showing)
    measure = partial(
        _measure_episode,
        selection=question.selection,
        site=question.site,
        settings=settings,
        keep_steps=keep_steps,
        episodes_of=episodes_of,
    )
    tables: dict[str, OnDisk[pl.DataFrame]] = defaultdict(OnDisk)
    controls: OnDisk[ControlParts] = OnDisk()
    steps: OnDisk[_Steps] = OnDisk()
    with progress_bar(len(showing), "episodes") as advance:
        for of_episode, control, of_steps in each_episode(measure, showing, advance):
            for name, table in of_episode.items():
                tables[name].append(table)
            controls.append(control)
            if of_steps is not None:
                steps.append(of_steps)
    columns, objects = control_columns(showing, controls), tables["objects"]
    return ObjectTables(
        objects=TableInParts(MadeWhenAsked(lambda i: objects[i].hstack(columns[i]), range(len(showing)))),
        times=TableInParts(tables["times"]),
        pointing=TableInParts(tables["pointing"]) if settings.spatial else None,
        iou=TableInParts(tables["iou"]) if settings.spatial else None,
        steps=_step_tables(showing, steps, question.selection) if keep_steps else None,
        iou_steps=_step_tables(showing, steps, question.selection, settings.thresholds)
        if keep_steps and settings.spatial
        else None,
    )


@dataclass(frozen=True)
class _Steps:
    """The columns of one episode's tables of steps, which are far larger.

    Attributes:
        items: labels of the axis of items.
        columns: camera -> column of `steps` -> (replan, layer or 1, denoise or 1, head or 1, item or 1).
        iou_columns: camera -> column of `iou_steps` -> (replan, layer, denoise, head, threshold, item).
    """

    items: Axis
    columns: Mapping[str, Mapping[str, NDArray[Any]]]
    iou_columns: Mapping[str, Mapping[str, NDArray[Any]]]


def _step_tables(
    items: Sequence[SelectedEpisode],
    steps: Sequence[_Steps],
    selection: Selection,
    thresholds: Sequence[str] | None = None,
) -> TableInParts:
    """`steps`, or with `thresholds` `iou_steps`, in parts of some replans of one camera of an episode."""
    parts = [
        (i, camera, slice(first, first + _REPLANS_TOGETHER))
        for i, item in enumerate(items)
        for camera in cameras_of(item)
        for first in range(0, item.tokens.num_replans, _REPLANS_TOGETHER)
    ]

    def part(number: int) -> pl.DataFrame:
        i, camera, replans = parts[number]
        item, found = items[i], steps[i]
        replan = {name: labels[replans] for name, labels in replan_axis(item).items()}
        axes: list[Axis] = [{"camera": (camera,)}, replan, layer_axis(selection), denoise_axis(selection)]
        axes.append(head_axis(selection))
        if thresholds is not None:
            axes.append({"threshold": thresholds})
        columns = (found.columns if thresholds is None else found.iou_columns)[camera]
        values = {name: array[replans] for name, array in columns.items()}
        return long_table(item, [*axes, found.items], values, EPISODE_KEYS)

    return TableInParts(MadeWhenAsked(part, range(len(parts))))


@dataclass
class _Measured:
    """Arrays of one camera.

    `by_map` are (replan, layer, denoise, head), `by_item` have a further axis item, and `by_threshold` two: threshold,
    item.
    """

    by_map: dict[str, Array] = field(default_factory=dict)
    by_item: dict[str, Array] = field(default_factory=dict)
    by_threshold: dict[str, Array] = field(default_factory=dict)


@dataclass(frozen=True)
class _Episode:
    """One episode with what was measured of it, by camera, and the axes of its tables."""

    item: SelectedEpisode
    selection: Selection
    settings: ObjectSettings
    views: Sequence[View]
    measured: Mapping[str, _Measured]
    layers: LayerAxis
    items: Axis

    def table(self, camera: str, axes: Sequence[Axis], values: Mapping[str, Array]) -> pl.DataFrame:
        """Rows of one camera; the last axis of the arrays is the item."""
        return long_table(self.item, [{"camera": (camera,)}, *axes, self.items], values, EPISODE_KEYS)


def _measure_episode(
    item: SelectedEpisode,
    selection: Selection,
    site: str,
    settings: ObjectSettings,
    keep_steps: bool,
    episodes_of: Mapping[tuple[str, int], int],
) -> tuple[dict[str, pl.DataFrame], ControlParts, _Steps | None]:
    """The tables of one episode without their control, what the control needs, and with `keep_steps` the steps."""
    names, members = items_of(item)
    views = views_of(item, members, settings)
    measured = {view.camera: _Measured() for view in views}
    heads = len(selection.heads) if selection.per_head else 1
    cells = (item.tokens.num_replans, len(selection.layers), len(selection.denoise), heads)
    maps = {view.camera: np.zeros((*cells[:2], heads, len(view.picture.keys))) for view in views}
    waiting: dict[str, list[NDArray[np.float32]]] = {view.camera: [] for view in views}
    places: list[tuple[int, int]] = []
    done = 0
    for part in layer_rows(item.store.attributes, item.episode, selection, site):
        rows = part.rows
        if item.without:
            rows = rows.copy()
            rows[:, :, list(item.without)] = 0.0
        for view in views:
            own = rows.take(view.picture.keys, axis=-1)
            maps[view.camera][:, part.layer] += own / len(selection.denoise)
            mass = np.matmul(own, view.area).astype(np.float64)
            _put(measured[view.camera].by_item, "mass", mass[:, None], [(part.layer, part.denoise)], cells)
            waiting[view.camera].append(own)
        places.append((part.layer, part.denoise))
        if len(places) * heads >= _MAPS_TOGETHER or len(places) == cells[1] * cells[2] - done:
            for view in views:
                together = np.concatenate(waiting[view.camera], axis=1)
                waiting[view.camera].clear()
                values = _measure_maps(together, view, settings)
                for one in fields(_Measured):
                    for name, array in getattr(values, one.name).items():
                        of_places = array.reshape(len(array), len(places), heads, *array.shape[2:])
                        _put(getattr(measured[view.camera], one.name), name, of_places, places, cells)
            done += len(places)
            places.clear()
    items = {label: [name[i] for name in names] for i, label in enumerate(("kind", "item", "object_class"))}
    layers = LayerAxis.of(selection, average_one=False)
    averaged = {camera: layers.with_average(values) for camera, values in maps.items()}
    episode = _Episode(item, selection, settings, views, measured, layers, items)
    tables = {"objects": _objects_part(episode), "times": _times_part(episode)}
    if settings.spatial:
        tables |= {"pointing": _pointing_part(episode), "iou": _iou_part(episode)}
    pictures = {ALL_CAMERAS: views, **{view.camera: [view] for view in views}}
    sources = {
        name: control_source([(averaged[view.camera], view.area) for view in seen], episodes_of[item.task] - 1)
        for name, seen in pictures.items()
    }
    axes = [layers.columns, head_axis(selection), items]
    return tables, ControlParts(sources, axes, names), _steps(episode) if keep_steps else None


def _put(
    target: dict[str, Array], name: str, values: Array, places: Sequence[tuple[int, int]], cells: tuple[int, ...]
) -> None:
    """Put values (replan, place, head, ...) where they belong in an array (replan, layer, denoise, head, ...)."""
    whole = target.setdefault(name, np.empty((*cells, *values.shape[3:])))
    layers, steps = zip(*places, strict=True)
    whole[:, layers, steps] = values


def _measure_maps(maps: NDArray[np.float32], view: View, settings: ObjectSettings) -> _Measured:
    """Measures of maps (replan, map, patch), each (replan, map, ...), but for the masses of items.

    Maps of many layers and heads at once: masks at many places are megabytes, which each call has to go through.
    """
    by_item: dict[str, Array] = {}
    by_map = {"camera_mass": maps.sum(axis=-1, dtype=np.float64)}
    if not settings.spatial:
        return _Measured(by_map, by_item)
    picture = view.picture
    rows, columns = picture.rows, picture.columns
    if not picture.cells_are_patches:
        maps = picture.spread(maps).reshape(*maps.shape[:-1], -1)
    centre = centre_of_mass(maps, view.centres)
    by_map |= {"centre_row": centre[..., 0], "centre_column": centre[..., 1]}
    distance = distance_in_pictures(centre[:, :, None, :], view.item_centres[:, None], rows, columns)
    by_item["distance"] = np.where(view.sizes[:, None, :] > 0, distance, np.nan)
    by_item["pointing"] = pointing_hits(maps, view.hit_masks)
    regions = [*regions_of_percentiles(maps, settings.percentiles), otsu_regions(maps)]
    shifted = shifted_masks(view.masks, rows, columns)
    by_threshold = {
        "iou": np.stack([intersection_over_union(region, view.masks) for region in regions], axis=2),
        "iou_chance": np.stack([shifted_iou(region, shifted) for region in regions], axis=2),
    }
    return _Measured(by_map, by_item, by_threshold)


@dataclass(frozen=True)
class _Shares:
    """Per replan, with "layers_avg": (replan, layer, head, item) or, for areas, (replan, item).

    even_share: of attention that is uniform over each camera's picture. enrichment: (layer, head, item).
    """

    mass: Array
    share: Array
    even_share: Array
    area_share: Array
    enrichment: Array


def _shares(episode: _Episode) -> dict[str, _Shares]:
    """Shares of all cameras together, and by camera."""

    def over_denoise(values: Array) -> Array:
        return episode.layers.with_average(values.mean(axis=2), mean=finite_mean)

    measured, views = episode.measured, episode.views
    mass = {view.camera: over_denoise(measured[view.camera].by_item["mass"]) for view in views}
    of_camera = {view.camera: over_denoise(measured[view.camera].by_map["camera_mass"])[..., None] for view in views}
    image = np.asarray(sum(of_camera.values()))
    area = {view.camera: view.area.sum(axis=1, dtype=np.float64) for view in views}
    patches = {view.camera: len(view.picture.keys) for view in views}

    def enrichment(cameras: Sequence[str]) -> Array:
        """Sum W S / sum W A over cameras, see `object_tables`."""
        attended, even = np.zeros((2, *mass[cameras[0]].shape[1:]))
        for camera in cameras:
            weight, covered = finite_mean(of_camera[camera] / image), (area[camera] / patches[camera]).mean(axis=0)
            attended += weight * np.nan_to_num(finite_mean(mass[camera] / of_camera[camera]))
            even += weight * covered
        return np.where(even > 0, attended / even, np.nan)

    result = {}
    with np.errstate(invalid="ignore", divide="ignore"):
        even = {camera: of_camera[camera] / image * (area[camera] / patches[camera])[:, None, None] for camera in mass}
        total = np.asarray(sum(mass.values()))
        whole = np.asarray(sum(area.values())) / sum(patches.values())
        evenly = np.asarray(sum(even.values()))
        result[ALL_CAMERAS] = _Shares(total, total / image, evenly, whole, enrichment(list(mass)))
        for camera, values in mass.items():
            covered = area[camera] / patches[camera]
            result[camera] = _Shares(values, values / image, even[camera], covered, enrichment([camera]))
    return result


def _objects_part(episode: _Episode) -> pl.DataFrame:
    parts = []
    for camera, shares in _shares(episode).items():
        values = {
            "mass": shares.mass.mean(axis=0),
            "share": finite_mean(shares.share),
            "area_share": shares.area_share.mean(axis=0),
            "enrichment": shares.enrichment,
        }
        parts.append(episode.table(camera, [episode.layers.columns, head_axis(episode.selection)], values))
    return pl.concat(parts)


def _times_part(episode: _Episode) -> pl.DataFrame:
    replans = replan_axis(episode.item)
    parts = []
    for camera, shares in _shares(episode).items():
        # The last layer is "layers_avg", or the only one; heads that were kept apart are averaged.
        values = {
            "share": finite_mean(shares.share[:, -1], 1),
            "area_share": shares.area_share,
            "even_share": finite_mean(shares.even_share[:, -1], 1),
        }
        parts.append(episode.table(camera, [replans], values))
    return pl.concat(parts)


def _pointing_part(episode: _Episode) -> pl.DataFrame:
    parts = []
    for view in episode.views:
        measured, there = episode.measured[view.camera], view.sizes > 0  # (replan, item)
        by_replan = {
            "mask_patches": view.sizes.astype(np.float64),
            "distance_uniform": distance_of_uniform(view),
            "pointing_chance": mask_sizes(view.hit_masks) / (view.picture.rows * view.picture.columns),
        }
        values: dict[str, NDArray[np.float64] | NDArray[np.int64]] = {
            "num_replans": np.array([len(there)]),
            "mask_replans": there.sum(axis=0),
            **{name: finite_mean(np.where(there, array, np.nan)) for name, array in by_replan.items()},
            **{name: _over_steps(episode, array)[..., None] for name, array in _centres(view, measured).items()},
            **{name: _over_steps(episode, measured.by_item[name]) for name in ("distance", "pointing")},
        }
        axes = [episode.layers.columns, head_axis(episode.selection)]
        parts.append(episode.table(view.camera, axes, values))  # type: ignore[arg-type]  # counts are whole numbers
    return pl.concat(parts)


def _iou_part(episode: _Episode) -> pl.DataFrame:
    axes = [episode.layers.columns, head_axis(episode.selection), {"threshold": episode.settings.thresholds}]
    parts = []
    for view in episode.views:
        values = {
            name: _over_steps(episode, array) for name, array in episode.measured[view.camera].by_threshold.items()
        }
        parts.append(episode.table(view.camera, axes, values))
    return pl.concat(parts)


def _over_steps(episode: _Episode, values: Array) -> Array:
    """Mean of (replan, layer, denoise, ...) over replans and denoise steps: (layer or "layers_avg", ...)."""
    return episode.layers.with_average(finite_mean(values, (0, 2)), axis=0, mean=finite_mean)


def _centres(view: View, measured: _Measured) -> dict[str, Array]:
    sides = {"centre_row": view.picture.rows, "centre_column": view.picture.columns}
    places = {name: measured.by_map[name] for name in sides}
    return places | {f"{name}_share": places[name] / length for name, length in sides.items()}


def _steps(episode: _Episode) -> _Steps:
    columns = {}
    for view in episode.views:
        measured = episode.measured[view.camera]
        columns[view.camera] = {
            "area_share": view.area.mean(axis=1)[:, None, None, None, :],
            **measured.by_item,
            **{name: array[..., None] for name, array in measured.by_map.items()},
        }
    by_threshold = {view.camera: episode.measured[view.camera].by_threshold for view in episode.views}
    return _Steps(episode.items, columns, by_threshold)
