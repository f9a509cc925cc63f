"""The pictures of `docs/validation.md`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator
from matplotlib.transforms import Bbox

from benchmarks.validation.known import NUMBERS
from benchmarks.validation.mixing import CUTS, GROUPS
from benchmarks.validation.policies import TITLES
from benchmarks.validation.prediction import ATTENTION, FAMILIES
from vla_attention.analyze.render.style import Style, ratio_axis

STYLE = Style()
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#999999")
#: The panels of the first picture.
SHOWN = {
    "ratio_lift": "lift of the ratio",
    "contribution_lift": "lift of the ratio\nof contributions",
    "instruction_lift": "lift of the\ninstruction",
    "colour_lift": "lift of the\ncolour's word",
    "wrist_lift": "lift of the\nwrist camera",
    "without_instruction": "effect without\nthe instruction",
    "without_instruction_all": "... for all queries",
    "prompt_other_colour": "effect of\nanother colour",
    "without_wrist": "effect without\nthe wrist camera",
    "wrist_blank": "effect of a blank\nwrist camera",
}


@STYLE.settings()
def draw_known(results: Mapping[str, Any], path: Path) -> None:
    """Numbers of the policies whose dependence is known, one point per training with its interval over tasks."""
    controls = [name for name in TITLES if any(policy["control"] == name for policy in results["policies"])]
    figure = Figure(figsize=(10.0, 4.8), layout="constrained")
    axes = figure.subplots(2, (len(SHOWN) + 1) // 2)
    for axis, name in zip(axes.flat, SHOWN, strict=False):
        for place, control in enumerate(controls):
            rows = [row for row in results["known"] if row["control"] == control and row["number"] == name]
            for i, row in enumerate(sorted(rows, key=lambda row: row["seed"])):
                x = place + 0.16 * (i - (len(rows) - 1) / 2)
                colour = COLOURS[list(TITLES).index(control)]
                if row["low"] is not None:
                    axis.plot([x, x], [row["low"], row["high"]], color=colour, linewidth=1.2)
                axis.plot([x], [row["value"]], "o", color=colour, markersize=4)
        number = NUMBERS[name]
        if number.scale == "log":
            drawn = [row for row in results["known"] if row["number"] == name]
            ratio_axis(axis.yaxis, [1.0, *(row[end] for row in drawn for end in ("low", "value", "high") if row[end])])
            axis.axhline(1.0, color="#999999", linewidth=0.7)
        else:
            axis.set_ylim(bottom=0)
        axis.set_title(SHOWN[name], fontsize=8)
        axis.set_xticks(range(len(controls)), [TITLES[name] for name in controls], fontsize=6, rotation=60)
        axis.set_xlim(-0.6, len(controls) - 0.4)
    figure.suptitle(_sample(results).replace("\n", " "), fontsize=8, x=0.01, ha="left")
    figure.savefig(path, dpi=STYLE.dpi)


@STYLE.settings()
def draw_prediction(results: Mapping[str, Any], path: Path) -> None:
    """Rank correlations with intervals, and mass against effect for the action queries and for all queries."""
    figure = Figure(figsize=(10.5, 4.2), layout="constrained")
    forest, direct, everywhere = figure.subplots(1, 3, width_ratios=[1.2, 1, 1])
    families = [name for name in FAMILIES if any(row["family"] == name for row in results["prediction"])]
    for j, measure in enumerate(ATTENTION):
        drawn = False
        for i, family in enumerate(families):
            row = next((r for r in results["prediction"] if (r["family"], r["measure"]) == (family, measure)), None)
            if row is None:
                continue
            y = i + 0.16 * (j - 1.5)
            label = measure if not drawn else None
            drawn = True
            if row["low"] is not None:
                forest.plot([row["low"], row["high"]], [y, y], color=COLOURS[j], linewidth=1.2)
            forest.plot([row["value"]], [y], "o", color=COLOURS[j], markersize=4, label=label)
    forest.axvline(0.0, color="#999999", linewidth=0.7)
    forest.set_yticks(range(len(families)), families)
    forest.invert_yaxis()
    forest.set_xlim(-0.5, 1)
    forest.set_xlabel("rank correlation with the effect of knocking it out")
    figure.legend(*forest.get_legend_handles_labels(), loc="outside upper left", ncols=len(ATTENTION), fontsize=7)
    for axis, column, title in (
        (direct, "effect", "groups, knocked out for\nthe action queries"),
        (everywhere, "everywhere", "the same for all queries"),
    ):
        items = [item for item in results["items"] if item["family"] == "groups" and item["mass"] and item[column]]
        masses, effects = [item["mass"] for item in items], [item[column] for item in items]
        axis.plot(masses, effects, "o", color=COLOURS[0], markersize=4)
        ratio_axis(axis.xaxis, masses)
        axis.xaxis.set_major_locator(LogLocator(subs=(1.0,)))
        ratio_axis(axis.yaxis, [item[name] for item in items for name in ("effect", "everywhere") if item[name]])
        axis.set_xlabel("mass")
        axis.set_ylabel("effect")
        axis.set_title(title)
        axis.set_xlim(0.4 * min(masses), 4 * max(masses))  # room for names
    figure.draw_without_rendering()
    for axis, column in ((direct, "effect"), (everywhere, "everywhere")):
        found = [item for item in results["items"] if item["family"] == "groups" and item["mass"] and item[column]]
        _name_points(axis, [(item["item"], item["mass"], item[column]) for item in found])
    forest.set_title(_sample(results))
    figure.savefig(path, dpi=STYLE.dpi)


def _sample(results: Mapping[str, Any]) -> str:
    """What the points of a picture are means of."""
    settings = results["settings"]
    tasks = results["policies"][0]["episodes"] // settings["episodes"]
    each = "one episode" if settings["episodes"] == 1 else f"{settings['episodes']} episodes"
    return f"n = {tasks} tasks, {each} each;\nbars: 95% intervals over tasks"


def _name_points(axes: Axes, points: Sequence[tuple[str, float, float]]) -> None:
    """Write each name beside its point, where it covers no other name if there is such a place."""
    taken: list[Bbox] = []
    for name, x, y in sorted(points, key=lambda point: -point[2]):
        tried = []
        for right, up in ((3, 1), (-3, 1), (3, -6), (-3, -6), (3, 6), (-3, 6), (3, -11), (-3, -11)):
            text = axes.annotate(
                name,
                (x, y),
                fontsize=6,
                xytext=(right, up),
                textcoords="offset points",
                ha="left" if right > 0 else "right",
            )
            box = text.get_window_extent()
            covered = sum(box.overlaps(other) for other in taken)
            tried.append((covered, len(tried), text, box))
        best = min(tried, key=lambda one: one[:2])
        for one in tried:
            if one is not best:
                one[2].remove()
        taken.append(best[3])


@STYLE.settings()
def draw_mixing(results: Mapping[str, Any], path: Path) -> None:
    """Effects of knocking out words and pictures under each cut of the prefix."""
    of = {(row["cut"], row["group"]): row for row in results["mixing"]}
    figure = Figure(figsize=(8.0, 3.2), layout="constrained")
    axis = figure.subplots()
    for j, (cut, what) in enumerate(CUTS.items()):
        for i, group in enumerate(GROUPS):
            row = of.get((cut, group))
            if row is None:
                continue
            x = i + 0.2 * (j - 1.5)
            axis.bar([x], [row["value"]], 0.18, color=COLOURS[j], label=what if i == 0 else None)
            if row["low"] is not None:
                axis.plot([x, x], [row["low"], row["high"]], color="black", linewidth=0.8)
    axis.set_xticks(np.arange(len(GROUPS)), [f"without {what}" for what in GROUPS.values()], fontsize=7)
    axis.set_ylabel("effect on the action")
    axis.set_title(_sample(results).replace("\n", " "), fontsize=8, loc="left")
    axis.legend(fontsize=7)
    figure.savefig(path, dpi=STYLE.dpi)


def draw(results: Mapping[str, Any], folder: Path) -> list[Path]:
    """Draw every picture that the results have numbers for; returns the files."""
    folder.mkdir(parents=True, exist_ok=True)
    made = []
    for name, key, function in (
        ("validation_known.png", "known", draw_known),
        ("validation_prediction.png", "prediction", draw_prediction),
        ("validation_mixing.png", "mixing", draw_mixing),
    ):
        if results.get(key):
            function(results, folder / name)
            made.append(folder / name)
    return made
