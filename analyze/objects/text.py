"""The objects as printed tables: shares, enrichment and control, then how well attention maps find the objects."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import polars as pl

from vla_attention.analyze.objects.control_masks import STILL_OVERLAP
from vla_attention.analyze.objects.object_settings import ObjectSettings
from vla_attention.analyze.objects.object_study import ObjectStudy
from vla_attention.analyze.objects.object_views import ALL_CAMERAS, item_name
from vla_attention.analyze.show.answer import Section
from vla_attention.analyze.show.findings import apart_note, few_families_note
from vla_attention.analyze.show.headings import interval_note
from vla_attention.analyze.show.numbers import format_number, plural, row_interval
from vla_attention.analyze.show.tables import (
    INTERVAL,
    Column,
    Table,
    count,
    episode_count,
    estimate,
    interval,
    number,
    percent,
    texts,
    words,
)
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


def objects_sections(study: ObjectStudy) -> list[Section]:
    """Shares and enrichment by camera; then, by camera, how well maps find the objects."""
    header, units = study.question.header("OBJECTS: which objects are looked at", study.layer), study.question.units
    sections = [Section([header]), Section([followed_sentence(study)])]
    for camera in study.summary["camera"].unique(maintain_order=True):
        part = _printed(study.summary.filter(camera=camera))
        if camera == ALL_CAMERAS:
            table = replace(share_table(study), rows=part.head(_MOST_ROWS).to_dicts())
            sections.append(Section([["all cameras"], table, _more(part)]))
        else:
            classes = part.filter(kind="class").to_dicts()
            sections.append(Section([[f"camera {camera}"], Table(_share_columns(study, shares=False), classes)]))
    few = few_families_note(study.summary.filter(camera=study.summary["camera"][0]), "item", units)
    note = f"{_SHARES_NOTE} {interval_note(DEFAULT_LEVEL, units.words)} {few}".rstrip()
    return [*sections, Section([note]), *(_finding(study) if study.settings.spatial else [])]


def share_table(study: ObjectStudy, caption: str = "") -> Table:
    """Shares and enrichment over all cameras, in a text and on the page."""
    return Table(_share_columns(study), over_all_cameras(study).to_dicts(), caption)


def over_all_cameras(study: ObjectStudy) -> pl.DataFrame:
    """The rows of the summary over all cameras; over the one, if there is one."""
    cameras = study.summary["camera"]
    return study.summary.filter(camera=ALL_CAMERAS if ALL_CAMERAS in cameras else cameras[0])


def _share_columns(study: ObjectStudy, shares: bool = True) -> list[Column]:
    over = "enrichment_over_control"
    return [
        texts("object", item_name, left=True),
        words(None, "item", "object"),
        words(None, "kind", "kind"),
        episode_count(study.question.num_tasks > 1),
        count(None, "num_episodes", "episodes"),
        *([number("share", "share")] if shares else []),
        percent(None, "share", "share"),
        interval("share", INTERVAL, None, times=100),
        number("area", "area_share"),
        percent(None, "area_share", "area"),
        *estimate("enrichment", "enrichment", "enrichment"),
        texts("over control", lambda row: "cannot tell" if _still(row) else format_number(row[over])),
        texts("interval", lambda row: "-" if _still(row) else row_interval(row, over)),
        texts("q", lambda row: "-" if _still(row) else format_number(row[f"{over}_q"])),
        number(None, over, "over control"),
        interval(over, INTERVAL, None),
        number(None, f"{over}_q", "q"),
    ]


def _still(row: dict[str, Any]) -> bool:
    """Whether the object hardly moves, so that the control cannot tell."""
    overlap = row["control_overlap"]
    return overlap is not None and overlap >= STILL_OVERLAP


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


def _finding(study: ObjectStudy) -> list[Section]:
    iou, pointing, shown = study.iou_summary, study.pointing_summary, study.settings.shown_threshold
    assert iou is not None
    assert pointing is not None
    sections = []
    for camera in iou["camera"].unique(maintain_order=True):
        part = _printed(iou.filter(camera=camera, threshold=shown))
        otsu = iou.filter(camera=camera, threshold="otsu").rows_by_key(["kind", "item"], named=True)
        pointed = pointing.filter(camera=camera).rows_by_key(["kind", "item"], named=True)
        rows = [
            row
            | pointed[row["kind"], row["item"]][0]
            | {"episodes": row["num_episodes"], "otsu": otsu[row["kind"], row["item"]][0]}
            for row in part.head(_MOST_ROWS).iter_rows(named=True)
        ]
        columns = [
            texts("object", item_name, left=True),
            count("n", "episodes"),
            number("patches", "mask_patches"),
            texts(f"IoU {shown}", _iou),
            interval("iou"),
            texts("IoU otsu", lambda row: _iou(row["otsu"])),
            texts("pointing", lambda row: f"{_short(row['pointing'])} ({_short(row['pointing_chance'])})"),
            texts("distance", lambda row: f"{_short(row['distance'])} ({_short(row['distance_uniform'])})"),
        ]
        above = f"Finding the objects, camera {camera} (in brackets: chance)"
        sections.append(Section([[above], Table(columns, rows), _more(part)]))
    return [*sections, Section([_finding_note(study.settings), _found(study)])]


def _iou(row: dict[str, Any]) -> str:
    return f"{format_number(row['iou'])} ({format_number(row['iou_chance'])})"


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


def _short(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def _place(row: dict[str, Any]) -> str:
    if "layer" not in row:
        return ""
    return f" in layer {row['layer']}" + (f" head {row['head']}" if row["head"] is not None else "")
