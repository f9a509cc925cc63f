"""`object_iou`: how well attention finds every object: IoU with its mask and pointing game, beside what chance gives."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import polars as pl

from vla_attention.analyze.objects.objects_in_view import ObjectSettings
from vla_attention.analyze.objects.plot_object_shares import CLASS_COLORS
from vla_attention.analyze.show.plot_colours import DATA_COLOR, NOTE_COLOR
from vla_attention.analyze.show.plot_style import drawn_in_our_style, new_figure, save_figure
from vla_attention.analyze.show.plot_text import explain, shortened, title

if TYPE_CHECKING:
    from matplotlib.axes import Axes

STEM = "object_iou"
#: Objects with the highest IoU; the csv has all of them.
_MOST = 24


@drawn_in_our_style
def plot_object_iou(found: pl.DataFrame, settings: ObjectSettings, folder: Path, layer: str) -> list[Path]:
    """Draw from `object_summary.iou_summary`; returns the paths of png, pdf and csv.

    A row of panels per camera: IoU at the middle percentile, IoU at Otsu's threshold, pointing game. Points are means over episodes
    with 95 % bootstrap intervals, black ticks what chance gives.
    """
    cameras = found["camera"].unique(maintain_order=True).to_list()
    shown = settings.thresholds[min(1, len(settings.thresholds) - 1)]
    measures = list(dict.fromkeys([f"iou_{shown}", "iou_otsu", "pointing"]))
    parts = [_chosen(found.filter(pl.col("camera") == camera)) for camera in cameras]
    if not parts:
        figure = new_figure(8, 3)
        explain(figure.subplots(), "No object covers enough of any patch to have a mask; try a lower --mask-coverage.")
        return save_figure(figure, folder, STEM, found)
    cut = any(part.filter(pl.col("kind") == "object").height == _MOST for part in parts)
    heights = [0.9 + 0.22 * part.height for part in parts]
    figure = new_figure(9.5, 1.2 + sum(heights))
    what = "mean of all layers" if layer == "layers_avg" else f"layer {layer}"
    title(
        figure,
        f"How well attention finds the objects, {what}",
        f"Mask: patches covered by at least {100 * settings.mask_coverage:g} %. Points: mean over episodes with 95 % bootstrap "
        "interval; n counts episodes in which the object has a mask. Black: chance (a random region of the same size; the mask's "
        f"share of the picture). Pointing game: within {settings.tolerance:g} patch of the mask. Lines at the right edge go on."
        + (f" At most {_MOST} objects a camera, those with the highest IoU." if cut else ""),
    )
    panels = figure.subplots(len(parts), len(measures), squeeze=False, gridspec_kw={"height_ratios": heights})
    for row, (camera, part) in enumerate(zip(cameras, parts, strict=True)):
        for column, name in enumerate(measures):
            _draw(panels[row, column], part, name, last=column == len(measures) - 1)
            panels[row, column].set_title(_title_of(name), size=8)
        panels[row, 0].set_yticks(range(part.height), [_name(entry) for entry in part.iter_rows(named=True)])
        panels[row, 0].set_ylabel(shortened(camera, 30))
    return save_figure(figure, folder, STEM, found)


def _chosen(part: pl.DataFrame) -> pl.DataFrame:
    classes = part.filter(pl.col("kind") == "class")
    # Robot and background are objects and classes at once; once is enough here.
    objects = part.filter((pl.col("kind") == "object") & ~pl.col("item").is_in(["robot", "background"]))
    return pl.concat([classes, objects.head(_MOST)])


def _draw(axes: Axes, part: pl.DataFrame, name: str, last: bool) -> None:
    for position, row in enumerate(part.iter_rows(named=True)):
        color = CLASS_COLORS[row["item"]] if row["kind"] == "class" else DATA_COLOR
        if row[f"{name}_low"] is not None:
            axes.plot([row[f"{name}_low"], row[f"{name}_high"]], [position, position], color=color, linewidth=1.8)
        if row[name] is not None:
            marker = "D" if row["kind"] == "class" else "o"
            axes.plot(row[name], position, marker, color=color, markersize=5, markeredgecolor="white", zorder=3)
        if row[f"{name}_chance"] is not None:
            axes.plot(row[f"{name}_chance"], position, "|", color="black", markersize=10, markeredgewidth=1.3, zorder=2)
        if last:
            axes.text(
                1.02, position, f"n = {row['num_episodes']}", transform=axes.get_yaxis_transform(), va="center", size=7,
                color=NOTE_COLOR,
            )  # fmt: skip
    num_classes = part.filter(pl.col("kind") == "class").height
    if 0 < num_classes < part.height:
        axes.axhline(num_classes - 0.5, color="#BBBBBB", linewidth=0.7)
    # Two or three episodes give intervals that would squeeze everything else into a corner; they run out of the picture instead.
    values: Any = part.select(name, f"{name}_chance").to_numpy().astype(float)
    top = float(np.nanmax(values)) if np.isfinite(values).any() else 0.0
    axes.set_xlim(0, min(1.0, max(1.8 * top, 0.05)) if name != "pointing" else 1.03)
    axes.set_ylim(part.height - 0.4, -0.6)
    axes.set_yticks([])
    axes.tick_params(axis="y", length=0)
    axes.grid(axis="x")


def _title_of(name: str) -> str:
    if name == "pointing":
        return "pointing game (hit rate)"
    threshold = name.removeprefix("iou_")
    return "IoU, Otsu's threshold" if threshold == "otsu" else f"IoU, percentile {threshold.removeprefix('p')}"


def _name(row: dict) -> str:
    return shortened(f"[{row['item']}]" if row["kind"] == "class" else row["item"], 26)
