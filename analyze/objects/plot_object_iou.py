"""`object_iou`: how well attention finds every object: IoU with its mask and pointing game, beside chance."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import polars as pl

from vla_attention.analyze.measures.frames import layer_name
from vla_attention.analyze.objects.object_settings import ObjectSettings
from vla_attention.analyze.objects.object_study import ObjectStudy
from vla_attention.analyze.objects.object_views import item_name
from vla_attention.analyze.objects.plot_object_shares import CLASS_COLORS
from vla_attention.analyze.show.numbers import interval_name
from vla_attention.analyze.show.plot_axes import note_at_row
from vla_attention.analyze.show.plot_colours import DATA_COLOR, GUIDE_COLOR
from vla_attention.analyze.show.plot_style import drawn_in_our_style, new_figure, save_figure
from vla_attention.analyze.show.plot_text import explain, shortened, title
from vla_attention.analyze.statistics.intervals import DEFAULT_LEVEL

if TYPE_CHECKING:
    from matplotlib.axes import Axes

STEM = "object_iou"
#: Objects with the highest IoU; the csv has all of them.
_MOST = 24
_POINTING = "pointing"


@drawn_in_our_style
def plot_object_iou(study: ObjectStudy, folder: Path) -> list[Path]:
    """Draw the study's `iou_summary` and `pointing_summary`; returns the paths of png, pdf and csv.

    A row of panels per camera: IoU at the shown percentile, IoU at Otsu's threshold, pointing game. Points are means
    over episodes with intervals, black ticks are chance.
    """
    data, settings = _data(study), study.settings
    panels = list(dict.fromkeys([settings.shown_threshold, "otsu", _POINTING]))
    ranked = data.filter(pl.col("panel") == settings.thresholds[0])
    cameras = ranked["camera"].unique(maintain_order=True).to_list()
    items = [_chosen(ranked.filter(pl.col("camera") == camera)) for camera in cameras]
    if not items:
        figure = new_figure(8, 3)
        explain(figure.subplots(), "No object covers enough of any patch to have a mask; try a lower --mask-coverage.")
        return save_figure(figure, folder, STEM, data)
    cut = any(part.filter(pl.col("kind") == "object").height == _MOST for part in items)
    heights = [0.9 + 0.22 * part.height for part in items]
    figure = new_figure(9.5, 1.2 + sum(heights))
    title(figure, f"How well attention finds the objects, {layer_name(study.layer)}", _note(settings, cut))
    axes = figure.subplots(len(items), len(panels), squeeze=False, gridspec_kw={"height_ratios": heights})
    for row, (camera, part) in enumerate(zip(cameras, items, strict=True)):
        of_camera = data.filter(pl.col("camera") == camera)
        for column, panel in enumerate(panels):
            values = part.select("kind", "item").join(
                of_camera.filter(pl.col("panel") == panel), on=["kind", "item"], how="left", maintain_order="left"
            )
            _draw(axes[row, column], values, panel, last=column == len(panels) - 1)
            axes[row, column].set_title(_title_of(panel), size=8)
        names = [shortened(item_name(entry), 26) for entry in part.iter_rows(named=True)]
        axes[row, 0].set_yticks(range(part.height), names)
        axes[row, 0].set_ylabel(shortened(camera, 30))
    return save_figure(figure, folder, STEM, data)


def _data(study: ObjectStudy) -> pl.DataFrame:
    """One row per (camera, item, panel): value, interval and chance. `panel` is a threshold or "pointing"."""
    iou, pointing = study.iou_summary, study.pointing_summary
    assert iou is not None
    assert pointing is not None
    where = ["camera", "kind", "item"]
    columns = ["value", "low", "high", "chance", "num_episodes", "num_tasks"]
    parts = [
        table.with_columns(
            panel.alias("panel"),
            pl.col(name).alias("value"),
            pl.col(f"{name}_low").alias("low"),
            pl.col(f"{name}_high").alias("high"),
            pl.col(f"{name}_chance").alias("chance"),
        ).select(*where, "panel", *columns)
        for name, table, panel in (("iou", iou, pl.col("threshold")), (_POINTING, pointing, pl.lit(_POINTING)))
    ]
    return pl.concat(parts)


def _note(settings: ObjectSettings, cut: bool) -> str:
    note = (
        f"Mask: patches covered by at least {100 * settings.mask_coverage:g}%. Points: mean over episodes with "
        f"{interval_name(DEFAULT_LEVEL)}; n counts episodes in which the object has a mask. Black: chance "
        "(mean over shifts of the map about the picture). Pointing game: within "
        f"{settings.tolerance:g} patch of the mask. Lines at the right edge go on."
    )
    return note + (f" At most {_MOST} objects a camera, those with the highest IoU." if cut else "")


def _chosen(part: pl.DataFrame) -> pl.DataFrame:
    classes = part.filter(pl.col("kind") == "class")
    # Robot and background are objects and classes at once; once is enough here.
    objects = part.filter((pl.col("kind") == "object") & ~pl.col("item").is_in(["robot", "background"]))
    return pl.concat([classes, objects.head(_MOST)])


def _draw(axes: Axes, part: pl.DataFrame, panel: str, last: bool) -> None:
    for position, row in enumerate(part.iter_rows(named=True)):
        color = CLASS_COLORS[row["item"]] if row["kind"] == "class" else DATA_COLOR
        if row["low"] is not None:
            axes.plot([row["low"], row["high"]], [position, position], color=color, linewidth=1.8)
        if row["value"] is not None:
            marker = "D" if row["kind"] == "class" else "o"
            axes.plot(row["value"], position, marker, color=color, markersize=5, markeredgecolor="white", zorder=3)
        if row["chance"] is not None:
            axes.plot(row["chance"], position, "|", color="black", markersize=10, markeredgewidth=1.3, zorder=2)
        if last:
            note_at_row(axes, position, f"n = {row['num_episodes']}", x=1.02)
    num_classes = part.filter(pl.col("kind") == "class").height
    if 0 < num_classes < part.height:
        axes.axhline(num_classes - 0.5, color=GUIDE_COLOR, linewidth=0.7)
    # Two or three episodes have wide intervals, which would squeeze everything else into a corner; they run out of the
    # picture.
    values = part.select("value", "chance").to_numpy().astype(float)
    top = float(np.nanmax(values)) if np.isfinite(values).any() else 0.0
    axes.set_xlim(0, min(1.0, max(1.8 * top, 0.05)) if panel != _POINTING else 1.03)
    axes.set_ylim(part.height - 0.4, -0.6)
    axes.set_yticks([])
    axes.tick_params(axis="y", length=0)
    axes.grid(axis="x")


def _title_of(panel: str) -> str:
    if panel == _POINTING:
        return "pointing game (hit rate)"
    return "IoU, Otsu's threshold" if panel == "otsu" else f"IoU, percentile {panel.removeprefix('p')}"
