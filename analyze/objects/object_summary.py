"""Objects over episodes: means with intervals, who follows which object, and all of it as text."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence

import polars as pl

from vla_attention.analyze.measures.aggregate import LAYERS_AVG, overall_layer
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.objects.objects_in_view import ALL_CAMERAS, CLASSES, ObjectSettings
from vla_attention.analyze.show.headings import WIDTH
from vla_attention.analyze.show.numbers import format_interval, format_number, plural
from vla_attention.analyze.show.text_table import text_table
from vla_attention.analyze.statistics.bootstrap import DEFAULT_SEED, POSITIVE, SHARE
from vla_attention.analyze.statistics.episode_intervals import means_with_intervals

#: A lift over less area than this part of the pictures (one patch of 512) is about a sliver, and is not ranked.
_LEAST_AREA = 0.002
#: Rows of a printed table; the written ones have all.
_MOST_ROWS = 28
_EPISODE = ("suite", "task_id", "episode_index")
_ITEM = ("camera", "kind", "item")


def objects_summary(objects: pl.DataFrame, seed: int = DEFAULT_SEED) -> pl.DataFrame:
    """Mean share, area and lift of every item over the episodes that have it, with intervals, of the layers' mean.

    From `object_attention.object_tables`, `objects`. Classes in their order, then objects by lift; per camera, all cameras first.
    """
    values = {"share": SHARE, "area_share": SHARE, "lift": POSITIVE}
    return _ordered(_means(objects, values, seed), "lift")


def iou_summary(iou: pl.DataFrame, settings: ObjectSettings, seed: int = DEFAULT_SEED) -> pl.DataFrame:
    """Mean pointing game, IoU and distance of every item over the episodes in which it has a mask, with intervals.

    From `object_attention.object_tables`, `iou`; of "layers_avg" (means of the layers' values) or the only layer.
    """
    values = {"mask_patches": POSITIVE, "distance": POSITIVE, "distance_uniform": POSITIVE}
    values |= {"pointing": SHARE, "pointing_chance": SHARE}
    for name in settings.thresholds:
        values |= {f"iou_{name}": SHARE, f"iou_{name}_chance": SHARE}
    return _ordered(_means(iou.filter(pl.col("mask_replans") > 0), values, seed), f"iou_{settings.thresholds[0]}")


def strongest_followers(objects: pl.DataFrame, most: int = 5) -> pl.DataFrame:
    """The layers (and heads, where they were kept apart) in which an object has its highest lift, mean over episodes.

    One row per object: `item`, `object_class`, `layer`, `head`, `lift`, `num_episodes`; the background and what covers hardly
    anything are left out.
    """
    single = objects.filter(
        (pl.col("kind") == "object")
        & (pl.col("camera") == ALL_CAMERAS)
        & ((pl.col("layer") != LAYERS_AVG) | (overall_layer(objects) != LAYERS_AVG))
        & (pl.col("object_class") != CLASSES[3])
        & (pl.col("area_share") >= _LEAST_AREA)
    )
    means = single.group_by("item", "layer", "head").agg(
        pl.col("object_class").mode().sort().first(),
        pl.col("lift").mean(),
        pl.len().cast(pl.Int64).alias("num_episodes"),
    )
    ranked = means.drop_nulls("lift").sort(["lift", "item", "layer"], descending=[True, False, False])
    return ranked.unique("item", keep="first", maintain_order=True).head(most)


def best_finders(iou: pl.DataFrame, threshold: str, most: int = 3) -> pl.DataFrame:
    """The layers (and heads) whose maps overlap most with the objects of interest, by camera: IoU above chance, mean over episodes."""
    single = iou.filter(
        (pl.col("kind") == "class")
        & (pl.col("item") == CLASSES[0])
        & ((pl.col("layer") != LAYERS_AVG) | (overall_layer(iou) != LAYERS_AVG))
    )
    means = single.group_by("camera", "layer", "head").agg(
        pl.col(f"iou_{threshold}").mean().alias("iou"),
        pl.col(f"iou_{threshold}_chance").mean().alias("chance"),
        pl.col("pointing").mean(),
        pl.col("pointing_chance").mean(),
    )
    above = means.drop_nulls("iou").with_columns((pl.col("iou") - pl.col("chance")).alias("above"))
    return above.sort(["above", "camera", "layer"], descending=[True, False, False]).head(most)


def objects_text(
    question: Question,
    summary: pl.DataFrame,
    followers: pl.DataFrame,
    found: pl.DataFrame | None,
    finders: pl.DataFrame | None,
    layer: str,
    settings: ObjectSettings,
) -> str:
    """The summaries as text: shares and lifts, then how well maps find the objects, by camera."""
    tasks = {(item.store.suite, item.episode.attributes.task_id) for item in question.selected}
    lines = question.header("OBJECTS: which objects are looked at", layer)
    for camera in summary["camera"].unique(maintain_order=True):
        part = _printed(summary.filter(pl.col("camera") == camera))
        if camera == ALL_CAMERAS:
            lines += ["", "all cameras", _shares_table(part.head(_MOST_ROWS), len(tasks) > 1), *_more(part)]
        else:
            classes = part.filter(pl.col("kind") == "class")
            lines += ["", f"camera {camera}", _shares_table(classes, len(tasks) > 1)]
    lines += ["", *textwrap.wrap(_SHARES_NOTE, WIDTH)]
    if followers.height:
        text = "; ".join(
            f"'{row['item']}' ({row['object_class']}) in layer {row['layer']}{_head(row)} (lift {format_number(row['lift'])})"
            for row in followers.iter_rows(named=True)
        )
        lines += ["", *textwrap.wrap(f"Followed most, by layer: {text}.", WIDTH)]
    if found is not None:
        shown = settings.thresholds[min(1, len(settings.thresholds) - 1)]
        for camera in found["camera"].unique(maintain_order=True):
            part = _printed(_ordered(found.filter(pl.col("camera") == camera), f"iou_{shown}"))
            lines += ["", f"Finding the objects, camera {camera} (in brackets: chance)"]
            lines += [_found_table(part.head(_MOST_ROWS), shown), *_more(part)]
        lines += ["", *textwrap.wrap(_found_note(settings, shown), WIDTH)]
        if finders is not None and finders.height:
            text = "; ".join(
                f"layer {row['layer']}{_head(row)} on {row['camera']} (IoU {format_number(row['iou'])}, chance "
                f"{format_number(row['chance'])}; pointing {format_number(row['pointing'])}, chance "
                f"{format_number(row['pointing_chance'])})"
                for row in finders.iter_rows(named=True)
            )
            lines += textwrap.wrap(f"Objects of interest are found best by {text}.", WIDTH)
    return "\n".join(lines)


_SHARES_NOTE = (
    "share: of the attention on all cameras' patches. area: covered part of the picture. lift: share of the picture's attention over "
    "area (1: uniform attention). Intervals: 95 %, two-level bootstrap over tasks and episodes; - where fewer than two episodes."
)


def _found_note(settings: ObjectSettings, shown: str) -> str:
    least = f"{100 * settings.mask_coverage:g} %"
    return (
        f"An object's mask is the patches of which it covers at least {least}; replans without any are left out; n counts "
        f"episodes. IoU {shown}: of the mask with the attended region, the patches at or above that percentile of their map; "
        "otsu: above Otsu's threshold; chance: a random region of the same size. pointing: the highest patch is at most "
        f"{settings.tolerance:g} patch from the mask. distance: from the centre of attention to the object's, in picture sides; "
        "in brackets: from the middle of the picture."
    )


def _means(table: pl.DataFrame, values: dict[str, tuple[float, float]], seed: int) -> pl.DataFrame:
    chosen = table.filter(pl.col("layer") == overall_layer(table))
    by_head = chosen.group_by(*_EPISODE, *_ITEM, maintain_order=True).agg(*(pl.col(name).mean() for name in values))
    return means_with_intervals(by_head, _ITEM, values, seed)


def _ordered(summary: pl.DataFrame, by: str) -> pl.DataFrame:
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


def _printed(part: pl.DataFrame) -> pl.DataFrame:
    """Without the objects that are a whole class of the same name."""
    classes = part.filter(pl.col("kind") == "class")["item"]
    return part.filter((pl.col("kind") == "class") | ~pl.col("item").is_in(classes.implode()))


def _more(part: pl.DataFrame) -> list[str]:
    left = part.height - _MOST_ROWS
    return [f"and {plural(left, 'object')} more, in the tables"] if left > 0 else []


def _shares_table(part: pl.DataFrame, several_tasks: bool) -> str:
    count = "episodes (tasks)" if several_tasks else "episodes"
    names = ["object", count, "share", "interval", "area", "lift", "interval"]
    rows = [
        [
            _name(row),
            f"{row['num_episodes']} ({row['num_tasks']})" if several_tasks else str(row["num_episodes"]),
            format_number(row["share"]),
            format_interval(row["share_low"], row["share_high"]),
            format_number(row["area_share"]),
            format_number(row["lift"]),
            format_interval(row["lift_low"], row["lift_high"]),
        ]
        for row in part.iter_rows(named=True)
    ]
    return text_table(names, rows, left=(0,))


def _found_table(part: pl.DataFrame, shown: str) -> str:
    names = ["object", "n", "patches", f"IoU {shown}", "interval", "IoU otsu", "pointing", "distance"]
    rows: list[Sequence[str]] = []
    for row in part.iter_rows(named=True):
        iou = f"iou_{shown}"
        rows.append(
            [
                _name(row),
                str(row["num_episodes"]),
                format_number(row["mask_patches"]),
                f"{format_number(row[iou])} ({format_number(row[f'{iou}_chance'])})",
                format_interval(row[f"{iou}_low"], row[f"{iou}_high"]),
                f"{format_number(row['iou_otsu'])} ({format_number(row['iou_otsu_chance'])})",
                f"{_short(row['pointing'])} ({_short(row['pointing_chance'])})",
                f"{_short(row['distance'])} ({_short(row['distance_uniform'])})",
            ]
        )
    return text_table(names, rows, left=(0,))


def _short(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def _name(row: dict) -> str:
    """Classes in brackets, so that the object `robot` and the class of that name stay apart."""
    return f"[{row['item']}]" if row["kind"] == "class" else row["item"]


def _head(row: dict) -> str:
    return f" head {row['head']}" if row["head"] is not None else ""
