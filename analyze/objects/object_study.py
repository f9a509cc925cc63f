"""Objects over episodes: means with intervals, and the layers and heads that attend to an object or find it best."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import polars as pl

from vla_attention.analyze.measures.aggregate import overall_layer
from vla_attention.analyze.measures.frames import EPISODE_ID, LAYERS_AVG
from vla_attention.analyze.measures.question import Question, ask
from vla_attention.analyze.measures.question_settings import AnalysisSettings
from vla_attention.analyze.measures.selected import SelectedEpisode, find_episode
from vla_attention.analyze.objects.control_masks import STILL_OVERLAP
from vla_attention.analyze.objects.object_attention import ObjectTables, object_tables
from vla_attention.analyze.objects.object_settings import ObjectSettings
from vla_attention.analyze.objects.object_views import ALL_CAMERAS, CLASSES, site_of_pictures
from vla_attention.analyze.statistics.bootstrap import DEFAULT_SEED, POSITIVE, SHARE
from vla_attention.analyze.statistics.episode_intervals import means_with_intervals
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
        return overall_layer(self.tables.objects)

    @cached_property
    def summary(self) -> pl.DataFrame:
        """Shares, enrichment and control; see `objects_summary`."""
        return objects_summary(self.tables.objects, self.question.settings.seed)

    @cached_property
    def pointing_summary(self) -> pl.DataFrame | None:
        """Pointing game and distances; see `pointing_summary`."""
        if self.tables.pointing is None:
            return None
        return pointing_summary(self.tables.pointing, self.question.settings.seed)

    @cached_property
    def iou_summary(self) -> pl.DataFrame | None:
        """IoU by threshold; see `iou_summary`."""
        return None if self.tables.iou is None else iou_summary(self.tables.iou, self.question.settings.seed)

    @property
    def followers(self) -> pl.DataFrame:
        """The layers and heads that follow objects; see `strongest_followers`."""
        return strongest_followers(self.tables.objects)

    @property
    def finders(self) -> pl.DataFrame | None:
        """The layers and heads that find the objects of interest; see `best_finders`."""
        if self.tables.iou is None or self.tables.pointing is None:
            return None
        return best_finders(self.tables.iou, self.tables.pointing, self.settings.shown_threshold)

    def files(self) -> dict[str, pl.DataFrame]:
        """All tables by the names of their files."""
        tables = {
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


def objects_summary(objects: pl.DataFrame, seed: int = DEFAULT_SEED) -> pl.DataFrame:
    """Means of every item over the episodes that have it, with intervals, of the layers' mean.

    From `object_tables`, `objects`. Classes in their order, then objects by enrichment; per camera, all cameras first.
    `enrichment_over_control` is mean enrichment / mean `control_enrichment` over the episodes with a control, and null
    where the control cannot tell (`control_overlap`, of masks with control masks, from `STILL_OVERLAP` on).
    """
    values = {"share": SHARE, "area_share": SHARE, "enrichment": POSITIVE}
    values |= {"control_enrichment": POSITIVE, "control_overlap": SHARE}
    summary = _means(objects, _ITEM, values, seed, {_OVER_CONTROL: ("enrichment", "control_balanced")})
    telling = pl.col("control_overlap") < STILL_OVERLAP
    bounded = [_OVER_CONTROL, f"{_OVER_CONTROL}_low", f"{_OVER_CONTROL}_high"]
    summary = summary.with_columns(pl.when(telling).then(pl.col(name)).alias(name) for name in bounded)
    return _ordered(summary, "enrichment")


def pointing_summary(pointing: pl.DataFrame, seed: int = DEFAULT_SEED) -> pl.DataFrame:
    """Mean pointing game and distances of every item over the episodes in which it has a mask, with intervals.

    From `object_tables`, `pointing`; of "layers_avg" (means of the layers' values) or the only layer.
    """
    values = {"mask_patches": POSITIVE, "distance": POSITIVE, "distance_uniform": POSITIVE}
    values |= {"pointing": SHARE, "pointing_chance": SHARE}
    return _ordered(_means(pointing.filter(pl.col("mask_replans") > 0), _ITEM, values, seed), "pointing")


def iou_summary(iou: pl.DataFrame, seed: int = DEFAULT_SEED) -> pl.DataFrame:
    """Mean IoU of every item at every threshold, highest first, as in `pointing_summary`; from the table `iou`."""
    values = {"iou": SHARE, "iou_chance": SHARE}
    return _ordered(_means(iou.drop_nulls("iou"), (*_ITEM, "threshold"), values, seed), "iou")


def strongest_followers(objects: pl.DataFrame, most: int = 5) -> pl.DataFrame:
    """The layers (and heads, where they were kept apart) in which an object's enrichment exceeds its control the most.

    One row per object: `item`, `object_class`, `layer`, `head`, `enrichment` and `control_enrichment` (means over
    episodes), `enrichment_over_control`, `num_episodes`. Left out are the background, items that cover hardly anything,
    and those of which the control cannot tell.
    """
    single = _single_layers(objects).filter(
        (pl.col("kind") == "object")
        & (pl.col("camera") == ALL_CAMERAS)
        & (pl.col("object_class") != CLASSES[3])
        & (pl.col("area_share") >= _LEAST_AREA)
    )
    controlled = pl.col("control_enrichment").is_not_null()
    means = single.group_by("item", "layer", "head").agg(
        pl.col("object_class").mode().sort().first(),
        pl.col("enrichment").filter(controlled).mean(),
        pl.col("control_enrichment").mean(),
        pl.col("control_overlap").mean(),
        controlled.sum().cast(pl.Int64).alias("num_episodes"),
    )
    over = (pl.col("enrichment") / pl.col("control_enrichment")).alias(_OVER_CONTROL)
    telling = means.with_columns(over).filter(pl.col("control_overlap") < STILL_OVERLAP).drop("control_overlap")
    ranked = telling.drop_nulls(_OVER_CONTROL).sort([_OVER_CONTROL, "item", "layer"], descending=[True, False, False])
    return ranked.unique("item", keep="first", maintain_order=True).head(most)


def best_finders(iou: pl.DataFrame, pointing: pl.DataFrame, threshold: str, most: int = 3) -> pl.DataFrame:
    """The layers (and heads) whose maps have the highest IoU above chance with the objects of interest, by camera."""
    of_interest = (pl.col("kind") == "class") & (pl.col("item") == CLASSES[0])
    where = ["camera", "layer", "head"]
    overlap = _single_layers(iou).filter(of_interest, pl.col("threshold") == threshold).group_by(where)
    hits = _single_layers(pointing).filter(of_interest).group_by(where)
    means = overlap.agg(pl.col("iou").mean(), pl.col("iou_chance").mean().alias("chance")).join(
        hits.agg(pl.col("pointing").mean(), pl.col("pointing_chance").mean()), on=where, nulls_equal=True
    )
    above = means.drop_nulls("iou").with_columns((pl.col("iou") - pl.col("chance")).alias("above"))
    return above.sort(["above", "camera", "layer"], descending=[True, False, False]).head(most)


def _single_layers(table: pl.DataFrame) -> pl.DataFrame:
    """The rows of single layers, without their mean."""
    return table.filter((pl.col("layer") != LAYERS_AVG) | (overall_layer(table) != LAYERS_AVG))


def _means(
    table: pl.DataFrame,
    item: Sequence[str],
    values: dict[str, tuple[float, float]],
    seed: int,
    quotients: dict[str, tuple[str, str]] | None = None,
) -> pl.DataFrame:
    chosen = table.filter(pl.col("layer") == overall_layer(table))
    names = {*values, *(name for sides in (quotients or {}).values() for name in sides)}
    episodes = chosen.group_by(*EPISODE_ID, *item, maintain_order=True).agg(
        *(pl.col(name).mean() for name in table.columns if name in names)
    )
    return means_with_intervals(episodes, item, values, seed, quotients=quotients)


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
