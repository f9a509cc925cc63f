"""Does it look for what the instruction names? Which objects are looked at, over area and place, and which move it."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import polars as pl

from vla_attention.analyze.commands.effects.maps import maps_where_recorded
from vla_attention.analyze.commands.naming_tables import (
    ASKS,
    figures_of_naming,
    of_naming,
    of_objects,
    tables_of_naming,
)
from vla_attention.analyze.core.about import about, enough, notes
from vla_attention.analyze.core.axes import COLUMNS, check_axes, columns_of, with_families
from vla_attention.analyze.core.estimate import Scale, estimate
from vla_attention.analyze.core.naming import at_objects, course, naming
from vla_attention.analyze.core.object_maps import look_at_maps, over_place
from vla_attention.analyze.core.object_shares import (
    CLASSES,
    ITEM,
    look_at_objects,
    object_episodes,
    object_times,
    with_coverage,
)
from vla_attention.analyze.core.result import Column, Figure, Finding, Result, Table
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.measures.scan import scan
from vla_attention.analyze.measures.tables import EPISODE_ID, LAYERS_AVG, frame_of_episodes
from vla_attention.schemas.errors import plural

_AVERAGE = pl.col("layer") == LAYERS_AVG
_OBJECT = ITEM[:3]
#: The threshold that texts and pictures show.
_SHOWN = "p90"
#: Axes along which maps are compared with objects; the others have shares only.
_OF_MAPS = ("layer", "head", "task", "family", "episode", "camera")
_SHARES: dict[str, Scale] = {"share": "share", "area_share": "share", "enrichment": "positive"}
_POINTING: dict[str, Scale] = {
    "mask_patches": "positive", "distance": "positive", "distance_uniform": "positive", "pointing": "share",
    "pointing_chance": "share",
}  # fmt: skip
_IOU: dict[str, Scale] = {"iou": "share", "iou_chance": "share"}
_OVER_PLACE = ("at_place", "elsewhere")


def objects(question: Question, by: Collection[str] = (), iou: bool = True) -> Result:
    """What is named against what is not; shares of objects and classes, over their area and what their places explain.

    Args:
        question: stores, selection and a site with cameras.
        by: axes that are kept apart, of `axes.COLUMNS` and "camera".
        iou: also pointing game and IoU of maps with the objects' masks, with chance; it takes most of the time.

    Raises:
        BadArgument: no episode has object coverage, or an axis cannot be kept.
    """
    check_axes(by, (*COLUMNS, "camera"))
    given, question = len(question.selected), with_coverage(question)
    sampling, kept, of_layers = question.sampling, columns_of(by), "layer" in by
    looks = [*(["layer_number"] if of_layers else []), *(column.name for column in kept)]
    of_maps = not set(by) - set(_OF_MAPS)
    maps = [look_at_maps(question, "head" in by, of_layers, iou)] if of_maps else []
    measured, *rest = scan(question, [look_at_objects(question, by), *maps])
    found = rest[0] if rest else []
    episodes, values, quotients = object_episodes(measured, by), _SHARES, {}
    if of_maps:
        place, keys = over_place(question, found).lazy(), [*EPISODE_ID, "layer", "head", *_OBJECT]
        episodes = episodes.join(place, keys, "left", nulls_equal=True, maintain_order="left")
        values, quotients = {**values, **dict.fromkeys(_OVER_PLACE, "positive")}, {"over_place": _OVER_PLACE}
    shown_layer = ~_AVERAGE if of_layers else _AVERAGE
    rows = with_families(episodes.filter(shown_layer).collect(), sampling)
    nulls = dict.fromkeys(quotients, 1.0)
    summary = estimate(rows, [*looks, *_OBJECT], values, sampling, nulls, [*looks, *_OBJECT[:2]], quotients)
    summary = _ordered(summary, looks, "enrichment")
    together = pl.lit(True) if "camera" in by else pl.col("camera") == summary["camera"][0]
    known = of_maps and summary["over_place"].null_count() < summary.height
    columns = [*kept, *([_CAMERA] if "camera" in by else []), *_columns(known, question.num_tasks)]
    is_class = pl.col("kind") == "class"
    tables = [
        Table("objects", summary, columns, "Kinds of objects", is_class & together),
        Table("objects_each", summary, columns, "Objects", ~is_class & together & ~_IS_WHOLE_CLASS, of="objects"),
    ]
    bars = summary.filter(together & ~_IS_WHOLE_CLASS)
    figures = [Figure("objects_enrichment", "forest", bars, *_BARS_SAY, _BARS)]
    step = f"vla-attention overlay {question.stores[0].path}"
    rows_of = f"Below, a row for each kind of object and {' and '.join(by)}."
    findings = [Finding(rows_of, ASKS, {}, enough(question), step)]
    if not by:
        named, times = naming(question, measured, found), course(question, measured)
        finding = of_naming(question, named) or of_objects(question, named, at_objects(question, measured, found))
        moves, of_patches = maps_where_recorded(question)
        findings, (first, last) = [replace(finding, next_step=step), *moves], tables_of_naming(named, times)
        tables, figures = [*first, *tables, *last, *of_patches], [*figures_of_naming(named, times), *figures]
    if iou and of_maps:
        pointing, overlaps = (
            frame_of_episodes(found, lambda one: one.pointing), frame_of_episodes(found, lambda one: one.iou)
        )  # fmt: skip
        seen = with_families(pointing.filter(shown_layer & (pl.col("mask_replans") > 0)).collect(), sampling)
        pointed = _ordered(estimate(seen, [*looks, *_OBJECT], _POINTING, sampling), looks, "pointing")
        seen = with_families(overlaps.filter(shown_layer & pl.col("iou").is_not_null()).collect(), sampling)
        regions = _ordered(estimate(seen, [*looks, *_OBJECT, "threshold"], _IOU, sampling), looks, "iou")
        shown = pl.col("threshold") == _SHOWN
        tables += [
            Table("pointing", pointed, [*kept, _CAMERA, *_POINTED], "The patch with the most attention", is_class),
            Table("iou", regions, [*kept, _CAMERA, *_OVERLAPS], "The attended region", shown & is_class),
            Table("pointing_episodes", pointing),
            Table("iou_episodes", overlaps),
        ]
    tables += [Table("objects_episodes", episodes), *([] if by else [Table("object_times", object_times(measured))])]
    left_out = given - len(question.selected)
    none = [f"No object is marked in the pictures of {plural(left_out, 'more episode')}."] if left_out else []
    return Result(
        "Which objects are looked at", about(question), findings, tables, [] if by else figures,
        [*notes(question), *none],
    )  # fmt: skip


def _ordered(summary: pl.DataFrame, looks: list[str], by: str) -> pl.DataFrame:
    """Cameras in their order, all together first; in each the classes in theirs, then objects by falling values."""
    cameras = summary["camera"].unique(maintain_order=True).to_list()
    rank = pl.when(pl.col("kind") == "class").then(pl.col("item").replace_strict(_RANKS, default=None)).otherwise(9)
    keys = [*looks, pl.col("camera").replace_strict({name: i for i, name in enumerate(cameras)}), rank, by]
    falling = [*(False for _ in looks), False, False, True]
    return summary.sort(keys, descending=falling, nulls_last=True, maintain_order=True)


_RANKS = {name: i for i, name in enumerate(CLASSES)}


#: An object that is a whole class of the same name: the robot, the background.
_IS_WHOLE_CLASS = (pl.col("kind") == "object") & pl.col("item").is_in(CLASSES)
_CAMERA = Column("camera", "text")


def _columns(known: bool, num_tasks: int) -> list[Column]:
    place = (
        Column("over_place", "factor", "over its place",
               "at the first policy call, attention to the object over the attention to where it stands in the task's "
               "other episodes; 1: the place alone explains it, as for an object that hardly moves"),
        Column("over_place_q", "p", "q", "p of no difference, adjusted for the number of rows (Benjamini-Hochberg)"),
    )  # fmt: skip
    return [
        Column("item", "text", "object"),
        Column("share", "percent", "of image attention"),
        Column("area_share", "percent", "of the area"),
        Column("enrichment", "factor", "over its area",
               "share of the attention to each picture over the part of it that the object covers"),
        *(place if known else ()),
        Column("num_episodes", "count", "episodes"),
        *([Column("num_tasks", "count", "tasks", screen=False)] if num_tasks > 1 else []),
    ]  # fmt: skip


_POINTED = (
    Column("item", "text", "object"),
    Column("pointing", "percent", "on the object", "how often the patch with the most attention is the object's or one "
           "beside it, mean over layers"),
    Column("pointing_chance", "percent", "by chance"),
    Column("distance", "number", "", "from the centre of attention to the object's, in picture sides", False),
    Column("distance_uniform", "number", "from the middle", screen=False),
    Column("mask_patches", "number", "patches"),
)  # fmt: skip
_OVERLAPS = (
    Column("item", "text", "object"),
    Column("iou", "number", "IoU", "of the object's patches and the tenth of the patches with the most attention, mean "
           "over layers"),
    Column("iou_chance", "number", "by chance", "the same with the map moved about the picture"),
)  # fmt: skip


_BARS_SAY = (
    "Attention to each object, over what its area would give",
    "Points: means over episodes, every task weighing the same; bars: 95% intervals. Dashed: attention that is even "
    "over each picture.",
)
_BARS = {
    "value": "enrichment",
    "label": "item",
    "color": "kind",
    "colors": {"class": "#0072B2", "object": "#9A9A9A"},
    "names": {"class": "kind of object", "object": "object"},
    "baseline": 1.0,
    "baseline_name": "even over each picture",
    "log": True,
    "xlabel": "attention / area (logarithmic)",
}
