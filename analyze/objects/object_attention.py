"""Which objects are looked at: shares of the image attention and lifts per object and class, and how well maps find the objects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.measures.aggregate import EPISODE_KEYS, LAYERS_AVG
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.measures.selected import SelectedEpisode
from vla_attention.analyze.objects.objects_in_view import (
    ALL_CAMERAS,
    ObjectSettings,
    View,
    cameras_of,
    distance_of_uniform,
    items_of,
    measure_maps,
    views_of,
)
from vla_attention.analyze.objects.spatial import mask_sizes
from vla_attention.analyze.show.progress import progress_bar
from vla_attention.analyze.stores.parallel import map_episodes
from vla_attention.analyze.stores.rows import layer_rows
from vla_attention.analyze.stores.selection import Selection
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.groupings.vocabulary import NO_COVERAGE

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ObjectTables:
    """What was measured; see `object_tables`."""

    objects: pl.DataFrame
    times: pl.DataFrame
    iou: pl.DataFrame | None
    steps: pl.DataFrame | None


@dataclass
class _Measured:
    """Arrays of one camera: `by_item` are (replan, layer, denoise, head, item), `by_map` lack the last axis."""

    by_item: dict[str, Array] = field(default_factory=dict)
    by_map: dict[str, Array] = field(default_factory=dict)


def object_tables(question: Question, settings: ObjectSettings | None = None, keep_steps: bool = False) -> ObjectTables:
    """Measure every object and class of objects in every selected episode; shows progress at a terminal.

    Items are the scene's objects (`kind` "object") and their classes in the task (`kind` "class": of interest, other objects, robot,
    background), by `camera` and for all cameras together ("all"). Rows are averaged over heads unless they are kept apart.

    Returns:
        objects: one row per (episode, layer or "layers_avg"[, head], camera, item), from masses averaged over denoise steps:
            mass        sum over patches of row x covered area, mean over replans
            share       mass / mass of all patches of all cameras, mean over replans
            area_share  covered area / area of these cameras' pictures, mean over replans
            lift        share of this camera's mass / area_share, of these means: 1 is what uniform attention gives. A sliver that
                        is in sight at one replan cannot outweigh the others, as in a mean of quotients it would.
        times: one row per (episode, replan, camera, item) of the layers' and heads' mean: `share`, `area_share`, `env_step`.
        iou: with `settings.spatial`, one row per (episode, layer or "layers_avg"[, head], camera, item): means over denoise steps and
            over the replans at which the item has a mask (`mask_replans` of `num_replans`; null where there is none), of
            mask_patches                          number of patches of the mask
            centre_row, centre_column             centre of attention in patch units, of this camera's map
            centre_row_share, centre_column_share the same as a part of the picture's height and width
            distance, distance_uniform            from it, and from the middle of the picture, to the object's centre
            pointing, pointing_chance             pointing game, and the share of patches that would score
            iou_T, iou_T_chance                   IoU at threshold T, and of a random region of the same size
            In "layers_avg" each is the mean of the layers' values, not the value of the layers' mean map.
        steps: with `keep_steps`, mass and the measures of `iou` per (episode, replan, layer, denoise step, head, camera, item).

    Raises:
        BadArgument: no selected episode has object coverage at this site.
    """
    settings = settings or ObjectSettings()
    if not any(cameras_of(item) for item in question.selected):
        raise BadArgument(f"Site '{question.site}': {NO_COVERAGE}.")
    with progress_bar(len(question.selected), "episodes") as advance:

        def measure(item: SelectedEpisode) -> ObjectTables:
            return _measure_episode(item, question.selection, question.site, settings, keep_steps)

        parts = map_episodes(measure, [item for item in question.selected if cameras_of(item)], advance)
    return ObjectTables(
        objects=pl.concat([part.objects for part in parts]),
        times=pl.concat([part.times for part in parts]),
        iou=pl.concat([part.iou for part in parts if part.iou is not None]) if settings.spatial else None,
        steps=pl.concat([part.steps for part in parts if part.steps is not None]) if keep_steps else None,
    )


def objects_table(question: Question) -> pl.DataFrame:
    """Shares and lifts per object; see `object_tables`, `objects`."""
    return object_tables(question, ObjectSettings(spatial=False)).objects


def iou_table(question: Question, settings: ObjectSettings | None = None) -> pl.DataFrame:
    """Centre of attention, pointing game and IoU per object; see `object_tables`, `iou`."""
    table = object_tables(question, settings).iou
    if table is None:
        raise BadArgument("ObjectSettings.spatial is False, and IoU was asked for.")
    return table


def _measure_episode(
    item: SelectedEpisode, selection: Selection, site: str, settings: ObjectSettings, keep_steps: bool
) -> ObjectTables:
    names, members = items_of(item)
    views = views_of(item, members, settings)
    measured = {view.camera: _Measured() for view in views}
    heads = len(selection.heads) if selection.per_head else 1
    cells = (item.tokens.num_replans, len(selection.layers), len(selection.denoise), heads)
    for part in layer_rows(item.episode, selection, site):
        rows = part.rows if selection.per_head else part.rows.mean(axis=1, keepdims=True)
        if item.without:
            rows = rows.copy()
            rows[:, :, list(item.without)] = 0.0
        for view in views:
            maps = rows[:, :, view.span.start : view.span.stop]
            by_item, by_map = measure_maps(maps, view, settings)
            store = measured[view.camera]
            for target, values in ((store.by_item, by_item), (store.by_map, by_map)):
                for name, value in values.items():
                    array = target.setdefault(name, np.empty((*cells, *value.shape[2:])))
                    array[:, part.layer, part.denoise] = value
    layers = _layers(selection)
    rows_of = _RowMaker(item, names, layers, selection)
    return ObjectTables(
        objects=_objects_part(rows_of, views, measured, layers),
        times=_times_part(item, rows_of, views, measured, layers),
        iou=_iou_part(rows_of, views, measured, layers) if settings.spatial else None,
        steps=_steps_part(item, rows_of, views, measured, selection) if keep_steps else None,
    )


@dataclass(frozen=True)
class _Layers:
    """Labels of the rows' layers: the selected ones, then "layers_avg" when there are several (over `once`, each block once)."""

    labels: tuple[str, ...]
    blocks: tuple[int | None, ...]
    once: tuple[int, ...]

    @property
    def numbers(self) -> list[int | None]:
        """The layers' numbers, None for the average."""
        return [None if label == LAYERS_AVG else int(label) for label in self.labels]

    def with_average(self, values: Array, axis: int = 1) -> Array:
        """Append the mean over layers along the layer axis, leaving NaN out."""
        if len(self.labels) == values.shape[axis]:
            return values
        chosen = np.take(values, list(self.once), axis=axis)
        return np.concatenate([values, np.expand_dims(_mean(chosen, axis), axis)], axis=axis)


def _layers(selection: Selection) -> _Layers:
    once = tuple(i for i, block in enumerate(selection.blocks) if selection.blocks.index(block) == i)
    labels = tuple(str(label) for label in selection.layer_labels)
    if len(labels) == 1:
        return _Layers(labels, selection.blocks, once)
    return _Layers((*labels, LAYERS_AVG), (*selection.blocks, None), once)


def _mean(values: Array, axis: int | tuple[int, ...]) -> Array:
    """Mean of the numbers along some axes; NaN where there is none."""
    known = ~np.isnan(values)
    count = known.sum(axis=axis)
    return np.where(count > 0, np.where(known, values, 0.0).sum(axis=axis) / np.maximum(count, 1), np.nan)


@dataclass(frozen=True)
class _RowMaker:
    """Turns arrays (layer, head, item) of one episode and camera into table rows."""

    item: SelectedEpisode
    names: Sequence[tuple[str, str, str]]
    layers: _Layers
    selection: Selection

    def constants(self) -> dict[str, Any]:
        """The episode's own columns."""
        attributes = self.item.episode.attributes
        values: dict[str, Any] = {"suite": self.item.store.suite}
        return values | {name: getattr(attributes, name) for name in EPISODE_KEYS if name != "suite"}

    def heads(self) -> list[int | None]:
        """Numbers of the heads, or a single None when they were averaged."""
        return list(self.selection.head_numbers) if self.selection.per_head else [None]

    def table(
        self, camera: str, axes: Mapping[str, tuple[int, Sequence[Any], Any]], columns: Mapping[str, Array]
    ) -> pl.DataFrame:
        """Rows of arrays of one shape (..., item); `axes`: column to (axis of the arrays, labels along it, type)."""
        shape = next(iter(columns.values())).shape
        height = int(np.prod(shape))
        frame: dict[str, Any] = {
            name: pl.repeat(value, height, eager=True)
            for name, value in (*self.constants().items(), ("camera", camera))
        }
        items = (("kind", 0), ("item", 1), ("object_class", 2))
        labelled = {name: (len(shape) - 1, [entry[i] for entry in self.names], pl.String) for name, i in items}
        for name, (axis, labels, kind) in (*axes.items(), *labelled.items()):
            index = np.broadcast_to(
                np.arange(shape[axis]).reshape([-1 if i == axis else 1 for i in range(len(shape))]), shape
            )
            frame[name] = pl.Series(list(labels), dtype=kind).gather(index.ravel())
        frame |= {name: np.ascontiguousarray(values).ravel() for name, values in columns.items()}
        return pl.DataFrame(frame).with_columns(pl.col(pl.Float64).fill_nan(None), pl.col(pl.Int32).cast(pl.Int64))

    def by_layer(self, camera: str, columns: Mapping[str, Array]) -> pl.DataFrame:
        """Rows of arrays (layer, head, item)."""
        axes = {
            "layer": (0, self.layers.labels, pl.String),
            "layer_number": (0, self.layers.numbers, pl.Int64),
            "block": (0, self.layers.blocks, pl.Int64),
            "head": (1, self.heads(), pl.Int64),
        }
        return self.table(camera, axes, columns)


@dataclass(frozen=True)
class _Shares:
    """Per replan, with "layers_avg": (replan, layer, head, item) or, for areas, (replan, item)."""

    mass: Array
    share: Array
    camera_share: Array
    area_share: Array


def _shares(views: Sequence[View], measured: Mapping[str, _Measured], layers: _Layers) -> dict[str, _Shares]:
    """Shares by camera, and of all of them together when there are several."""
    mass = {view.camera: layers.with_average(measured[view.camera].by_item["mass"].mean(axis=2)) for view in views}
    of_camera = {
        view.camera: layers.with_average(measured[view.camera].by_map["camera_mass"].mean(axis=2))[..., None]
        for view in views
    }
    image = np.asarray(sum(of_camera.values()))
    area = {view.camera: view.area.sum(axis=1, dtype=np.float64) for view in views}
    patches = {view.camera: view.grid.num_patches for view in views}
    result = {}
    with np.errstate(invalid="ignore", divide="ignore"):
        total = np.asarray(sum(mass.values()))
        whole = np.asarray(sum(area.values())) / sum(patches.values())
        result[ALL_CAMERAS] = _Shares(total, total / image, total / image, whole)
        for camera, values in mass.items():
            result[camera] = _Shares(values, values / image, values / of_camera[camera], area[camera] / patches[camera])
    return result


def _objects_part(
    rows_of: _RowMaker, views: Sequence[View], measured: Mapping[str, _Measured], layers: _Layers
) -> pl.DataFrame:
    parts = []
    for camera, shares in _shares(views, measured, layers).items():
        camera_share, area_share = _mean(shares.camera_share, 0), shares.area_share.mean(axis=0)
        with np.errstate(invalid="ignore", divide="ignore"):
            lift = np.where(area_share > 0, camera_share / area_share, np.nan)
        columns = {
            "mass": shares.mass.mean(axis=0),
            "share": _mean(shares.share, 0),
            "area_share": np.broadcast_to(area_share, lift.shape),
            "lift": lift,
        }
        parts.append(rows_of.by_layer(camera, columns))
    return pl.concat(parts)


def _times_part(
    item: SelectedEpisode,
    rows_of: _RowMaker,
    views: Sequence[View],
    measured: Mapping[str, _Measured],
    layers: _Layers,
) -> pl.DataFrame:
    steps = item.episode.read("env_step").astype(np.int64)
    axes = {
        "replan": (0, range(len(steps)), pl.Int64),
        "env_step": (0, steps.tolist(), pl.Int64),
    }
    parts = []
    for camera, shares in _shares(views, measured, layers).items():
        # The last layer is "layers_avg", or the only one; heads that were kept apart are averaged.
        columns = {"share": _mean(shares.share[:, -1], 1), "area_share": shares.area_share}
        parts.append(rows_of.table(camera, axes, columns))
    return pl.concat(parts)


def _iou_part(
    rows_of: _RowMaker, views: Sequence[View], measured: Mapping[str, _Measured], layers: _Layers
) -> pl.DataFrame:
    parts = []
    for view in views:
        store, there = measured[view.camera], view.sizes > 0  # (replan, item)
        shape = (len(layers.labels), len(rows_of.heads()), there.shape[1])
        by_replan = {
            "mask_patches": view.sizes.astype(np.float64),
            "distance_uniform": distance_of_uniform(view),
            "pointing_chance": mask_sizes(view.hit_masks) / view.grid.num_patches,
        }
        columns = {
            "num_replans": np.full(shape, float(len(there))),
            "mask_replans": np.broadcast_to(there.sum(axis=0).astype(np.float64), shape),
        }
        for name, values in by_replan.items():
            columns[name] = np.broadcast_to(_mean(np.where(there, values, np.nan), 0), shape)
        for name, values in _centres(view, store).items():
            mean = layers.with_average(_mean(values, (0, 2)), axis=0)
            columns[name] = np.broadcast_to(mean[..., None], shape)
        for name, values in store.by_item.items():
            if name != "mass":
                columns[name] = layers.with_average(_mean(values, (0, 2)), axis=0)
        parts.append(rows_of.by_layer(view.camera, columns))
    return pl.concat(parts).with_columns(pl.col("num_replans", "mask_replans").cast(pl.Int64))


def _centres(view: View, store: _Measured) -> dict[str, Array]:
    row, column = store.by_map["centre_row"], store.by_map["centre_column"]
    return {
        "centre_row": row,
        "centre_column": column,
        "centre_row_share": row / view.grid.rows,
        "centre_column_share": column / view.grid.columns,
    }


def _steps_part(
    item: SelectedEpisode,
    rows_of: _RowMaker,
    views: Sequence[View],
    measured: Mapping[str, _Measured],
    selection: Selection,
) -> pl.DataFrame:
    steps = item.episode.read("env_step").astype(np.int64)
    axes = {
        "replan": (0, range(len(steps)), pl.Int64),
        "env_step": (0, steps.tolist(), pl.Int64),
        "layer": (1, selection.layer_labels, pl.Int64),
        "block": (1, selection.blocks, pl.Int64),
        "denoise_step": (2, selection.denoise_steps, pl.Int64),
        "head": (3, rows_of.heads(), pl.Int64),
    }
    parts = []
    for view in views:
        store = measured[view.camera]
        shape = store.by_item["mass"].shape
        columns = {"area_share": np.broadcast_to(view.area.mean(axis=1)[:, None, None, None, :], shape)}
        columns |= store.by_item
        for name, values in store.by_map.items():
            columns[name] = np.broadcast_to(values[..., None], shape)
        parts.append(rows_of.table(view.camera, axes, columns))
    return pl.concat(parts)
