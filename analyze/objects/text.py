"""The objects as printed tables: shares, enrichment and control, then how well attention maps find the objects."""

from __future__ import annotations

from typing import Any

import polars as pl

from vla_attention.analyze.objects.control_masks import STILL_OVERLAP
from vla_attention.analyze.objects.object_settings import ObjectSettings
from vla_attention.analyze.objects.object_study import ObjectStudy
from vla_attention.analyze.objects.object_views import ALL_CAMERAS, item_name
from vla_attention.analyze.show.findings import apart_note, few_families_note
from vla_attention.analyze.show.headings import interval_note, wrap
from vla_attention.analyze.show.numbers import format_interval, format_number, plural, row_interval
from vla_attention.analyze.show.text_table import episode_counts, text_table
from vla_attention.analyze.statistics.intervals import DEFAULT_LEVEL
from vla_attention.analyze.statistics.many_looks import NAMED_AT

#: Rows of a printed table; the written ones have all.
_MOST_ROWS = 28
#: Names that the text could print: an object, a layer of an object, a layer that finds them.
_NAMES = 3
_SHARES_NOTE = (
    "share: of the attention on all cameras' patches. area: covered part of the picture. enrichment: share of the "
    "picture's attention / area, quotients of an episode's means, mean over episodes (1: attention that is uniform "
    "over each picture; all cameras: the mean of theirs, by attention times area). over control: mean enrichment / "
    "mean enrichment of the same maps on the object's masks of other episodes of the task (1: attention that does not "
    "depend on where the object is). cannot tell: these masks "
    f"overlap with the object's by {STILL_OVERLAP:.0%} or more, because it hardly moves; -: there are no other masks. "
    "q: p of 1 over control, adjusted for the number of classes or objects (Benjamini-Hochberg)."
)


def objects_text(study: ObjectStudy) -> str:
    """Shares and enrichment by camera; then, by camera, how well maps find the objects."""
    lines = [*study.question.header("OBJECTS: which objects are looked at", study.layer), *_shares(study)]
    if study.settings.spatial:
        lines += _finding(study)
    return "\n".join(lines)


def _shares(study: ObjectStudy) -> list[str]:
    several = study.question.num_tasks > 1
    lines = ["", *wrap(followed_sentence(study))]
    for camera in study.summary["camera"].unique(maintain_order=True):
        part = _printed(study.summary.filter(pl.col("camera") == camera))
        if camera == ALL_CAMERAS:
            lines += ["", "all cameras", _shares_table(part.head(_MOST_ROWS), several), *_more(part)]
        else:
            classes = part.filter(pl.col("kind") == "class")
            lines += ["", f"camera {camera}", _shares_table(classes, several, shares=False)]
    units = study.question.units
    few = few_families_note(study.summary.filter(pl.col("camera") == study.summary["camera"][0]), "item", units)
    return [*lines, "", *wrap(f"{_SHARES_NOTE} {interval_note(DEFAULT_LEVEL, units.words)} {few}".rstrip())]


def followed_sentence(study: ObjectStudy) -> str:
    """Which object, and which layer of an object, surely exceeds its control more than all the others do."""
    leaders = study.followed
    about = (leaders[0].units if leaders else study.question.units).words
    named = [leading for leading in leaders if leading.found.is_named(_NAMES)]
    said = [
        f"'{one.name['item']}'{_place(one.name)} exceeds its control by a larger factor "
        f"({format_number(one.found.value)}) than each of the other {one.found.num_items - 1} "
        f"{'pairs of object and layer' if 'layer' in one.name else 'objects'}"
        for one in named
    ]
    if said:
        apart = apart_note(named, "item")
        return f"{'; '.join(said)} (each difference tested at {NAMED_AT:g} / {_NAMES}, about {about}). {apart}".rstrip()
    if not leaders:
        return "There are no two objects whose control can tell."
    return f"No object, and no layer of an object, is shown to be followed more than all the others (about {about})."


def _finding(study: ObjectStudy) -> list[str]:
    iou, pointing = study.iou_summary, study.pointing_summary
    assert iou is not None
    assert pointing is not None
    shown = study.settings.shown_threshold
    lines: list[str] = []
    for camera in iou["camera"].unique(maintain_order=True):
        of_camera = pl.col("camera") == camera
        part = _printed(iou.filter(of_camera, pl.col("threshold") == shown))
        lines += ["", f"Finding the objects, camera {camera} (in brackets: chance)"]
        otsu = iou.filter(of_camera, pl.col("threshold") == "otsu")
        lines += [_finding_table(part.head(_MOST_ROWS), otsu, pointing.filter(of_camera), shown), *_more(part)]
    lines += ["", *wrap(_finding_note(study.settings))]
    return [*lines, *wrap(_found(study))]


def _found(study: ObjectStudy) -> str:
    """Which layer surely finds the objects of interest better than all the others."""
    if study.finder is None:
        return "There are no two layers that could find the objects of interest."
    row, found = study.finder.name, study.finder.found
    if not found.is_named(_NAMES):
        return f"None of {found.num_items} layers surely finds the objects of interest better than all the others."
    return (
        f"Objects of interest: the IoU{_place(row)} on {row['camera']} is further above chance (by "
        f"{format_number(found.value)}) than each of the other {found.num_items - 1} (each difference tested at "
        f"{NAMED_AT:g} / {_NAMES}, about {study.finder.units.words})."
    )


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


def _shares_table(part: pl.DataFrame, several_tasks: bool, shares: bool = True) -> str:
    rows = part.to_dicts()
    heading, counts = episode_counts(rows, several_tasks)
    body = [
        [
            item_name(row),
            count,
            *([format_number(row["share"])] if shares else []),
            format_number(row["area_share"]),
            format_number(row["enrichment"]),
            format_interval(row["enrichment_low"], row["enrichment_high"]),
            *_over_control(row),
        ]
        for row, count in zip(rows, counts, strict=True)
    ]
    header = ["object", heading, *(["share"] if shares else []), "area", "enrichment", "interval"]
    header += ["over control", "interval", "q"]
    return text_table(header, body, left=(0,))


def _over_control(row: dict[str, Any]) -> tuple[str, str, str]:
    overlap = row["control_overlap"]
    if overlap is not None and overlap >= STILL_OVERLAP:
        return "cannot tell", "-", "-"
    name = "enrichment_over_control"
    return format_number(row[name]), row_interval(row, name), format_number(row[f"{name}_q"])


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


def _place(row: dict[str, Any]) -> str:
    if "layer" not in row:
        return ""
    return f" in layer {row['layer']}" + (f" head {row['head']}" if row["head"] is not None else "")
