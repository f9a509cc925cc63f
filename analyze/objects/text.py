"""The objects as printed tables: shares, enrichment and control, then how well attention maps find the objects."""

from __future__ import annotations

from typing import Any

import polars as pl

from vla_attention.analyze.objects.control_masks import STILL_OVERLAP
from vla_attention.analyze.objects.object_settings import ObjectSettings
from vla_attention.analyze.objects.object_study import ObjectStudy
from vla_attention.analyze.objects.object_views import ALL_CAMERAS, item_name
from vla_attention.analyze.show.headings import interval_note, wrap
from vla_attention.analyze.show.numbers import format_interval, format_number, plural
from vla_attention.analyze.show.text_table import episode_counts, text_table
from vla_attention.analyze.statistics.bootstrap import DEFAULT_LEVEL

#: Rows of a printed table; the written ones have all.
_MOST_ROWS = 28
_SHARES_NOTE = (
    "share: of the attention on all cameras' patches. area: covered part of the picture. enrichment: mean share of the "
    "picture's attention / mean area (1: attention that is uniform over the picture). over control: mean enrichment / "
    "mean enrichment of the same maps on the object's masks of other episodes of the task (1: attention that does not "
    f"depend on where the object is). cannot tell: these masks overlap with the object's by {STILL_OVERLAP:.0%} or "
    f"more, because it hardly moves; -: there are no other masks. {interval_note(DEFAULT_LEVEL)}"
)


def objects_text(study: ObjectStudy) -> str:
    """Shares and enrichment by camera; then, by camera, how well maps find the objects."""
    lines = [*study.question.header("OBJECTS: which objects are looked at", study.layer), *_shares(study)]
    if study.settings.spatial:
        lines += _finding(study)
    return "\n".join(lines)


def _shares(study: ObjectStudy) -> list[str]:
    several = study.question.num_tasks > 1
    lines: list[str] = []
    for camera in study.summary["camera"].unique(maintain_order=True):
        part = _printed(study.summary.filter(pl.col("camera") == camera))
        if camera == ALL_CAMERAS:
            lines += ["", "all cameras", _shares_table(part.head(_MOST_ROWS), several), *_more(part)]
        else:
            classes = part.filter(pl.col("kind") == "class")
            lines += ["", f"camera {camera}", _shares_table(classes, several)]
    lines += ["", *wrap(_SHARES_NOTE)]
    followers = [
        f"'{row['item']}' ({row['object_class']}) in layer {row['layer']}{_head(row)} "
        f"({format_number(row['enrichment_over_control'])} x the control)"
        for row in study.followers.iter_rows(named=True)
    ]
    return [*lines, "", *wrap(f"Followed most, by layer: {'; '.join(followers)}.")] if followers else lines


def _finding(study: ObjectStudy) -> list[str]:
    iou, pointing, finders = study.iou_summary, study.pointing_summary, study.finders
    assert iou is not None
    assert pointing is not None
    assert finders is not None
    shown = study.settings.shown_threshold
    lines: list[str] = []
    for camera in iou["camera"].unique(maintain_order=True):
        of_camera = pl.col("camera") == camera
        part = _printed(iou.filter(of_camera, pl.col("threshold") == shown))
        lines += ["", f"Finding the objects, camera {camera} (in brackets: chance)"]
        otsu = iou.filter(of_camera, pl.col("threshold") == "otsu")
        lines += [_finding_table(part.head(_MOST_ROWS), otsu, pointing.filter(of_camera), shown), *_more(part)]
    lines += ["", *wrap(_finding_note(study.settings))]
    best = [
        f"layer {row['layer']}{_head(row)} on {row['camera']} (IoU {format_number(row['iou'])}, chance "
        f"{format_number(row['chance'])}; pointing {format_number(row['pointing'])}, chance "
        f"{format_number(row['pointing_chance'])})"
        for row in finders.iter_rows(named=True)
    ]
    return [*lines, *wrap(f"Objects of interest are found best by {'; '.join(best)}.")] if best else lines


def _finding_note(settings: ObjectSettings) -> str:
    return (
        f"An object's mask is the patches of which it covers at least {100 * settings.mask_coverage:g}%; replans "
        f"without any are left out; n counts episodes. IoU {settings.shown_threshold}: of the mask with the attended "
        "region, the patches at or above that percentile of their map; otsu: above Otsu's threshold; chance: mean over "
        "shifts of the map about the picture. "
        f"pointing: the highest patch is at most {settings.tolerance:g} patch from the mask. "
        "distance: from the centre of attention to the object's, in picture sides; in brackets: from the middle of the "
        "picture."
    )


def _printed(part: pl.DataFrame) -> pl.DataFrame:
    """Without the objects that are a whole class of the same name."""
    classes = part.filter(pl.col("kind") == "class")["item"]
    return part.filter((pl.col("kind") == "class") | ~pl.col("item").is_in(classes.implode()))


def _more(part: pl.DataFrame) -> list[str]:
    left = part.height - _MOST_ROWS
    return [f"and {plural(left, 'object')} more, in the tables"] if left > 0 else []


def _shares_table(part: pl.DataFrame, several_tasks: bool) -> str:
    rows = part.to_dicts()
    heading, counts = episode_counts(rows, several_tasks)
    body = [
        [
            item_name(row),
            count,
            format_number(row["share"]),
            format_interval(row["share_low"], row["share_high"]),
            format_number(row["area_share"]),
            format_number(row["enrichment"]),
            format_interval(row["enrichment_low"], row["enrichment_high"]),
            *_over_control(row),
        ]
        for row, count in zip(rows, counts, strict=True)
    ]
    header = ["object", heading, "share", "interval", "area", "enrichment", "interval", "over control", "interval"]
    return text_table(header, body, left=(0,))


def _over_control(row: dict[str, Any]) -> tuple[str, str]:
    overlap = row["control_overlap"]
    if overlap is not None and overlap >= STILL_OVERLAP:
        return "cannot tell", "-"
    name = "enrichment_over_control"
    return format_number(row[name]), format_interval(row[f"{name}_low"], row[f"{name}_high"])


def _finding_table(part: pl.DataFrame, otsu: pl.DataFrame, pointing: pl.DataFrame, shown: str) -> str:
    by_otsu, by_item = (
        otsu.rows_by_key(["kind", "item"], named=True),
        pointing.rows_by_key(["kind", "item"], named=True),
    )
    body = []
    for row in part.iter_rows(named=True):
        found, region = by_item[row["kind"], row["item"]][0], by_otsu[row["kind"], row["item"]][0]
        body.append(
            [
                item_name(row),
                str(row["num_episodes"]),
                format_number(found["mask_patches"]),
                f"{format_number(row['iou'])} ({format_number(row['iou_chance'])})",
                format_interval(row["iou_low"], row["iou_high"]),
                f"{format_number(region['iou'])} ({format_number(region['iou_chance'])})",
                f"{_short(found['pointing'])} ({_short(found['pointing_chance'])})",
                f"{_short(found['distance'])} ({_short(found['distance_uniform'])})",
            ]
        )
    header = ["object", "n", "patches", f"IoU {shown}", "interval", "IoU otsu", "pointing", "distance"]
    return text_table(header, body, left=(0,))


def _short(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def _head(row: dict[str, Any]) -> str:
    return f" head {row['head']}" if row["head"] is not None else ""
