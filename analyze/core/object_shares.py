"""How much of the attention to the pictures objects get, beside the part of the pictures that they cover."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.core.axes import OF_ROWS, weighted, with_time
from vla_attention.analyze.core.camera_maps import seen_cameras
from vla_attention.analyze.core.measure import Items, Measured, look_at, table_of
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.measures.scan import Look
from vla_attention.analyze.measures.selected import SelectedEpisode
from vla_attention.analyze.measures.tables import EPISODE_ID, EPISODE_KEYS, LAYERS_AVG
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.groupings.vocabulary import NO_COVERAGE, SceneObject

#: Stands for all cameras together in the column `camera`.
ALL_CAMERAS = "all"
#: The classes of objects, in the order in which they are shown; the first are those that the task names.
CLASSES = ("of interest", "other objects", "robot", "background")
#: The columns that name an object or a class on a camera.
ITEM = ("camera", "kind", "item", "object_class")
#: Columns of `core.measure` that tell cells of an episode apart.
_CELL = ("layer", "layer_number", "block", "denoise_step", "head")


def class_of(thing: SceneObject) -> str:
    """The class of an object in its task: an object of interest belongs to that class, whatever its kind."""
    if thing.of_interest:
        return CLASSES[0]
    return {"robot": CLASSES[2], "background": CLASSES[3]}.get(thing.kind, CLASSES[1])


def cameras_of(item: SelectedEpisode) -> tuple[str, ...]:
    """The cameras that the policy sees and whose object coverage was stored."""
    return tuple(camera for camera in seen_cameras(item) if camera in (item.tokens.coverage or {}))


def with_coverage(question: Question) -> Question:
    """The question about the episodes whose pictures tell which objects they show.

    Raises:
        BadArgument: no episode has object coverage at this site.
    """
    showing = positions_with_coverage(question)
    if not showing:
        raise BadArgument(f"Site '{question.site}': {NO_COVERAGE}.")
    return replace(question, selected=tuple(question.selected[i] for i in showing))


def positions_with_coverage(question: Question) -> list[int]:
    """Positions of the episodes whose pictures tell which objects they show."""
    return [i for i, item in enumerate(question.selected) if cameras_of(item)]


def names_of(item: SelectedEpisode) -> tuple[list[tuple[str, str, str]], NDArray[np.float32]]:
    """(kind, name, class) of every class and object, and the objects that belong to each, (object, item)."""
    things = item.tokens.objects
    classes = [class_of(thing) for thing in things]
    names = [("class", name, name) for name in CLASSES if name in classes]
    names += [("object", thing.name, of) for thing, of in zip(things, classes, strict=True)]
    members = [
        [(of if kind == "class" else thing.name) == name for kind, name, _ in names]
        for thing, of in zip(things, classes, strict=True)
    ]
    return names, np.array(members, dtype=np.float32)


def covered(item: SelectedEpisode, camera: str, members: NDArray[np.float32]) -> NDArray[np.float32]:
    """The share of each patch that each item covers, (replan, patch, item); `members` is from `names_of`."""
    # Areas of objects add up to that of their class; the sum may exceed 1 by rounding.
    area: NDArray[np.float32] = np.minimum((item.tokens.coverage or {})[camera] @ members, np.float32(1.0))
    return area


def items_of(item: SelectedEpisode) -> Items:
    """Each camera whole (`kind` "camera"), then every class and object on every camera, by covered area.

    A share is of the mass of these cameras together.
    """
    layout, cameras = item.tokens.layout, cameras_of(item)
    names, members = names_of(item)
    labels: list[tuple[str | None, ...]] = [(camera, "camera", camera, None) for camera in cameras]
    labels += [(camera, *name) for camera in cameras for name in names]
    weights = np.zeros((item.tokens.num_replans, layout.num_keys, len(labels)), np.float32)
    for i, camera in enumerate(cameras):
        keys, first = layout.patch_keys(camera), len(cameras) + i * len(names)
        weights[:, keys, i] = 1.0
        weights[:, keys, first : first + len(names)] = covered(item, camera, members)
    columns = {name: pl.Series(name, [label[i] for label in labels], dtype=pl.String) for i, name in enumerate(ITEM)}
    return Items(columns, weights, len(cameras), absent="zero")


def look_at_objects(
    question: Question, by: Collection[str] = (), positions: Sequence[int] | None = None
) -> Look[Measured]:
    """The look at the masses of `items_of`; positions: of episodes with coverage, all unless given."""
    return look_at(question, items_of, [axis for axis in OF_ROWS if axis in by], positions=positions)


def object_times(measured: Sequence[Measured]) -> pl.LazyFrame:
    """One row per (episode, replan, camera or all together, item), mean over layers: share, area_share, even_share.

    even_share: the share if each camera's attention were uniform over its picture.
    """

    def then(rows: pl.DataFrame) -> pl.DataFrame:
        found = _together(_of_replans(rows), ["replan", "env_step"])
        kept = ("camera", "replan", "env_step", *ITEM[1:], "share", "area_share", "even_share")
        return found.select(*EPISODE_KEYS, *kept)

    return table_of(measured, {"replan"}, then=then)


def object_episodes(measured: Sequence[Measured], by: Collection[str] = ()) -> pl.LazyFrame:
    """One row per (episode, cell of the axes, camera or all together, item), means over replans:

        mass        sum over patches of row x covered area
        share       mass / mass of all patches of all cameras
        area_share  covered area / area of all patches of these cameras
        enrichment  share of this camera's mass / area_share, of these means: 1 is what attention gives that is uniform
                    over the picture. A mean of quotients would give a sliver that is in sight at one replan as much
                    weight as all other replans. Of all cameras together: sum W S / sum W A, with W the camera's share
                    of all cameras' mass, S the item's share of the camera's mass, A its area_share there. This is a
                    mean of the cameras' enrichments: to prefer a camera that shows the item larger is no enrichment.

    Layers stand beside their mean ("layers_avg") unless `by` has "layer": then they stand alone.
    """  # fmt: skip
    axes = [axis for axis in OF_ROWS if axis in by]
    cell = [*_CELL, *(("replan", "env_step") if "replan" in by else ()), *(("phase",) if "time" in by else ())]

    def then(rows: pl.DataFrame) -> pl.DataFrame:
        if "layer" in by:
            rows = rows.filter(pl.col("layer") != LAYERS_AVG)
        rows = _of_replans(rows)
        if "time" in by:
            rows = with_time(rows, measured)
        weight = pl.col("weight") if "time" in by else pl.lit(1.0)
        means = rows.group_by(*EPISODE_KEYS, *cell, *ITEM, maintain_order=True).agg(
            weighted(pl.col(name), weight).alias(name)
            for name in ("mass", "share", "keys", "patches", "area_share", "within", "camera_share")
        )
        found = _together(means, cell)
        return found.select(*EPISODE_KEYS, "camera", *cell, *ITEM[1:], "mass", "share", "area_share", "enrichment")

    inner = {"replan", *axes, *(() if {*axes, "time"} & {*by} else ("layer",))}
    return table_of(measured, inner, then=then)


def object_values(measured: Sequence[Measured]) -> pl.DataFrame:
    """Log2 of the attention to every object over what its area gives it.

    Returns:
        suite, task_id, episode_index, item, value: of all cameras together, mean over layers and policy calls.
    """
    rows = object_episodes(measured)
    rows = rows.filter(camera=ALL_CAMERAS, layer=LAYERS_AVG, kind="object")
    return rows.select(*EPISODE_ID, "item", value=pl.col("enrichment").log(2.0)).collect()


def _of_replans(rows: pl.DataFrame) -> pl.DataFrame:
    """The rows of items with what their camera gets and covers."""
    cell = [*EPISODE_ID, "replan", *_CELL, "camera"]
    is_camera = pl.col("kind") == "camera"
    cameras = rows.filter(is_camera).select(*cell, camera_mass="mass", camera_share="share", patches="keys")
    items = rows.filter(~is_camera).join(cameras, on=cell, nulls_equal=True, maintain_order="left")
    return items.with_columns(
        area_share=pl.col("keys") / pl.col("patches"),
        within=(pl.col("mass") / pl.col("camera_mass")).fill_nan(None),
    ).with_columns(even_share=pl.col("camera_share") * pl.col("area_share"))


def _together(rows: pl.DataFrame, cell: Sequence[str]) -> pl.DataFrame:
    """The rows of all cameras together, then those of each; with `enrichment` where there are means over replans."""
    attended = (pl.col("camera_share") * pl.col("within").fill_null(0.0)).sum()
    even = (pl.col("camera_share") * pl.col("area_share")).sum()
    share = pl.col("share")
    sums = [pl.when(share.is_not_null().any()).then(share.sum()).alias("share"), pl.col("keys", "patches").sum()]
    sums += [pl.col(name).sum() for name in ("mass", "even_share") if name in rows.columns]
    every = rows.with_columns(camera=pl.lit(ALL_CAMERAS))
    return (
        pl.concat([every, rows])
        .group_by(*EPISODE_KEYS, *cell, *ITEM, maintain_order=True)
        .agg(*sums, enrichment=pl.when(even > 0).then(attended / even))
        .with_columns(area_share=pl.col("keys") / pl.col("patches"))
    )
