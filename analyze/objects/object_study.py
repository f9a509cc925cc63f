"""Objects over episodes: means with intervals, and the layers and heads that attend to an object or find it best."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import polars as pl

from vla_attention.analyze.measures.aggregate import overall_layer
from vla_attention.analyze.measures.frames import EPISODE_ID, LAYERS_AVG, TableInParts
from vla_attention.analyze.measures.question import Question, ask
from vla_attention.analyze.measures.question_settings import AnalysisSettings
from vla_attention.analyze.measures.selected import SelectedEpisode, find_episode
from vla_attention.analyze.objects.control_masks import STILL_OVERLAP
from vla_attention.analyze.objects.object_attention import ObjectTables, object_tables
from vla_attention.analyze.objects.object_settings import ObjectSettings
from vla_attention.analyze.objects.object_views import ALL_CAMERAS, CLASSES, site_of_pictures
from vla_attention.analyze.statistics.episode_intervals import Sampling, means_with_intervals, task_number
from vla_attention.analyze.statistics.intervals import POSITIVE, SHARE, quotient_by_episode
from vla_attention.analyze.statistics.many_looks import NamedLeader, adjusted_p_values, leader_of_table
from vla_attention.schemas.stores.reader import Store

#: An item that covers less than this part of the pictures (one patch of 512) is not ranked by its enrichment.
_LEAST_AREA = 0.002
_ITEM = ("camera", "kind", "item")
_OVER_CONTROL = "enrichment_over_control"


@dataclass(frozen=True)
class ObjectStudy:
    """The objects of the selected episodes.

    Attributes:
        question: what was asked, at a site with cameras.
        settings: how maps were compared with objects.
        example: the episode that a picture shows.
        tables: per episode; see `object_tables`.
    """

    question: Question
    settings: ObjectSettings
    example: SelectedEpisode
    tables: ObjectTables

    @property
    def layer(self) -> str:
        """The layer that the summaries are of."""
        return overall_layer(self.tables.objects.parts[0])

    @cached_property
    def summary(self) -> pl.DataFrame:
        """Shares, enrichment and control; see `objects_summary`."""
        return objects_summary(self.tables.objects, self.question.sampling)

    @cached_property
    def pointing_summary(self) -> pl.DataFrame | None:
        """Pointing game and distances; see `pointing_summary`."""
        if self.tables.pointing is None:
            return None
        return pointing_summary(self.tables.pointing, self.question.sampling)

    @cached_property
    def iou_summary(self) -> pl.DataFrame | None:
        """IoU by threshold; see `iou_summary`."""
        if self.tables.iou is None:
            return None
        return iou_summary(self.tables.iou, self.question.sampling)

    @cached_property
    def followed(self) -> list[NamedLeader]:
        """Which object is followed more than the others; see `followed_objects`."""
        return followed_objects(self.tables.objects, self.question.sampling)

    @cached_property
    def finder(self) -> NamedLeader | None:
        """The layer and head that find the objects of interest; see `leading_finder`."""
        if self.tables.iou is None:
            return None
        return leading_finder(self.tables.iou, self.settings.shown_threshold, self.question.sampling)

    def files(self) -> dict[str, pl.DataFrame | TableInParts]:
        """All tables by the names of their files."""
        tables: dict[str, pl.DataFrame | TableInParts | None] = {
            "objects": self.tables.objects,
            "object_times": self.tables.times,
            "objects_summary": self.summary,
            "pointing": self.tables.pointing,
            "pointing_summary": self.pointing_summary,
            "iou": self.tables.iou,
            "iou_summary": self.iou_summary,
            "object_steps": self.tables.steps,
            "iou_steps": self.tables.iou_steps,
        }
        return {name: table for name, table in tables.items() if table is not None}


def study_objects(
    stores: Sequence[Store],
    settings: AnalysisSettings,
    object_settings: ObjectSettings | None = None,
    keep_steps: bool = False,
    task: int | None = None,
    episode: int | None = None,
) -> ObjectStudy:
    """Measure the objects at the settings' site, or at the first one with cameras.

    `keep_steps` as in `object_tables`; `task` and `episode` name the example (default: the first episode).

    Raises:
        BadArgument: the site has no cameras, the stores hold no object coverage, or there is no such episode.
    """
    site = site_of_pictures(stores[0].attributes, settings.site)
    question = ask(stores, replace(settings, site=site))
    chosen = object_settings or ObjectSettings()
    example = find_episode(question.selected, task, episode)
    return ObjectStudy(question, chosen, example, object_tables(question, chosen, keep_steps))


def objects_summary(objects: TableInParts, sampling: Sampling) -> pl.DataFrame:
    """Means of every item over the episodes that have it, with intervals, of the layers' mean.

    From `object_tables`, `objects`. Classes in their order, then objects by enrichment; per camera, all cameras first.
    `enrichment_over_control` is mean enrichment / mean `control_enrichment` over the episodes with a control, and null
    where the control cannot tell (`control_overlap`, of masks with control masks, from `STILL_OVERLAP` on); its `_q` is
    the p-value of 1, adjusted for the number of classes or objects of the camera (Benjamini-Hochberg).
    """
    values = {"share": SHARE, "area_share": SHARE, "enrichment": POSITIVE}
    values |= {"control_enrichment": POSITIVE, "control_overlap": SHARE}
    quotients = {_OVER_CONTROL: ("enrichment", "control_balanced")}
    summary = _means(objects, _ITEM, values, sampling, quotients, {_OVER_CONTROL: 1.0})
    telling = pl.col("control_overlap") < STILL_OVERLAP
    bounded = [f"{_OVER_CONTROL}{end}" for end in ("", "_low", "_high", "_p")]
    summary = summary.with_columns(pl.when(telling).then(pl.col(name)).alias(name) for name in bounded)
    looks = summary.partition_by("camera", "kind", maintain_order=True)
    summary = pl.concat(
        part.with_columns(
            pl.Series(f"{_OVER_CONTROL}_q", adjusted_p_values(part[f"{_OVER_CONTROL}_p"].to_list()), dtype=pl.Float64)
        )
        for part in looks
    ).drop(f"{_OVER_CONTROL}_p")
    return _ordered(summary, "enrichment")


def pointing_summary(pointing: TableInParts, sampling: Sampling) -> pl.DataFrame:
    """Mean pointing game and distances of every item over the episodes in which it has a mask, with intervals.

    From `object_tables`, `pointing`; of "layers_avg" (means of the layers' values) or the only layer.
    """
    values = {"mask_patches": POSITIVE, "distance": POSITIVE, "distance_uniform": POSITIVE}
    values |= {"pointing": SHARE, "pointing_chance": SHARE}
    return _ordered(_means(pointing, _ITEM, values, sampling, where=pl.col("mask_replans") > 0), "pointing")


def iou_summary(iou: TableInParts, sampling: Sampling) -> pl.DataFrame:
    """Mean IoU of every item at every threshold, highest first, as in `pointing_summary`; from the table `iou`."""
    values = {"iou": SHARE, "iou_chance": SHARE}
    known = pl.col("iou").is_not_null()
    return _ordered(_means(iou, (*_ITEM, "threshold"), values, sampling, where=known), "iou")


def followed_objects(objects: TableInParts, sampling: Sampling) -> list[NamedLeader]:
    """The object that exceeds its control by the largest factor over layers, and the (object, layer, head) that does.

    From `object_tables`, `objects`, all cameras together. Each with how surely it exceeds all the others
    (`many_looks.leader`). Left out are the background, items that cover hardly anything, and those of which the control
    cannot tell.
    """
    overall = overall_layer(objects.parts[0])
    candidates = objects.select(
        [*EPISODE_ID, "layer", "head", "item", "enrichment", "control_balanced", "control_overlap"],
        pl.col("kind") == "object",
        pl.col("camera") == ALL_CAMERAS,
        pl.col("object_class") != CLASSES[3],
        pl.col("area_share") >= _LEAST_AREA,
        pl.col("control_enrichment").is_not_null(),
    )
    still = candidates.group_by("item").agg(pl.col("control_overlap").mean() >= STILL_OVERLAP)
    candidates = candidates.join(still.filter(~pl.col("control_overlap")).select("item"), on="item")
    found = []
    for which, item in ((pl.col("layer") == overall, ("item",)), (_is_single(overall), ("item", "layer", "head"))):
        means = (
            candidates.filter(which)
            .group_by(*EPISODE_ID, *item, maintain_order=True)
            .agg(pl.col("enrichment").mean(), pl.col("control_balanced").mean())
        )
        factors = (_linearised(of_item) for of_item in means.partition_by(item, maintain_order=True))
        leading = leader_of_table(factors, item, _OVER_CONTROL, sampling)
        found += [] if leading is None else [leading]
    return found


def _linearised(of_item: pl.DataFrame) -> pl.DataFrame:
    """With a column `enrichment_over_control` whose mean is the quotient of the means of one item."""
    tasks = of_item.select(task_number()).to_series().to_numpy()
    values = quotient_by_episode(of_item["enrichment"].to_numpy(), of_item["control_balanced"].to_numpy(), tasks)
    return of_item.with_columns(pl.Series(_OVER_CONTROL, values))


def leading_finder(iou: TableInParts, threshold: str, sampling: Sampling) -> NamedLeader | None:
    """The (camera, layer, head) whose maps have the highest IoU above chance with the objects of interest."""
    found = iou.select(
        [*EPISODE_ID, "camera", "layer", "head", "iou", "iou_chance"],
        pl.col("kind") == "class",
        pl.col("item") == CLASSES[0],
        pl.col("threshold") == threshold,
        pl.col("iou").is_not_null(),
        _is_single(overall_layer(iou.parts[0])),
    )
    above = found.with_columns((pl.col("iou") - pl.col("iou_chance")).alias("above"))
    return leader_of_table([above], ("camera", "layer", "head"), "above", sampling)


def _is_single(overall: str) -> pl.Expr:
    """Rows of single layers, without their mean."""
    return pl.col("layer").is_not_null() if overall != LAYERS_AVG else pl.col("layer") != LAYERS_AVG


def _means(
    table: TableInParts,
    item: Sequence[str],
    values: dict[str, tuple[float, float]],
    sampling: Sampling,
    quotients: dict[str, tuple[str, str]] | None = None,
    nulls: dict[str, float] | None = None,
    where: pl.Expr | None = None,
) -> pl.DataFrame:
    names = dict.fromkeys([*values, *(name for sides in (quotients or {}).values() for name in sides)])
    conditions = [pl.col("layer") == overall_layer(table.parts[0]), *([] if where is None else [where])]
    chosen = table.select([*EPISODE_ID, *item, *names], *conditions)
    episodes = chosen.group_by(*EPISODE_ID, *item, maintain_order=True).agg(pl.col(name).mean() for name in names)
    return means_with_intervals(episodes, item, values, sampling, quotients=quotients, nulls=nulls)


def _ordered(summary: pl.DataFrame, by: str) -> pl.DataFrame:
    """Cameras in their order; in each the classes in theirs, then objects by falling values of a column."""
    cameras = {name: i for i, name in enumerate(summary["camera"].unique(maintain_order=True))}
    ranks = {name: i for i, name in enumerate(CLASSES)}
    keyed = summary.with_columns(
        pl.col("camera").replace_strict(cameras, return_dtype=pl.Int64).alias("_camera"),
        pl.when(pl.col("kind") == "class")
        .then(pl.col("item").replace_strict(ranks, default=None, return_dtype=pl.Int64))
        .otherwise(len(ranks))
        .alias("_rank"),
    )
    ordered = keyed.sort(
        ["_camera", "_rank", by], descending=[False, False, True], nulls_last=True, maintain_order=True
    )
    return ordered.drop("_camera", "_rank")
