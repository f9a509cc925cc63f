"""`time_course` and `time_course_gripper`: ratio and fractions over an episode, and around the first gripper closing.

Left: the ratio (or the first group's fraction), one line for success and one for failure where both occur. Right: every
group's fraction over all episodes. Bands are pointwise intervals; the strips below count the episodes of each point.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import polars as pl

from vla_attention.analyze.measures.frames import float_values, layer_name
from vla_attention.analyze.show.numbers import interval_name, of_tasks, plural
from vla_attention.analyze.show.plot_axes import BASELINE_LABEL, legend_above, ratio_axis, whole_numbers
from vla_attention.analyze.show.plot_colours import BASELINE_COLOR, DATA_COLOR, LINE_OF_HATCH, NOTE_COLOR, group_styles
from vla_attention.analyze.show.plot_style import drawn_in_our_style, new_figure, save_figure
from vla_attention.analyze.show.plot_text import explain, named, ratio_name, shortened, title
from vla_attention.analyze.statistics.intervals import DEFAULT_LEVEL
from vla_attention.analyze.time.time_courses import (
    ALL,
    EPISODE_TIME,
    FAILURE,
    GRIPPER_CLOSING,
    RATIO,
    SUCCESS,
    TimeCourses,
)
from vla_attention.schemas.groupings.grouping import Grouping

if TYPE_CHECKING:
    from matplotlib.axes import Axes

STEMS = {EPISODE_TIME: "time_course", GRIPPER_CLOSING: "time_course_gripper"}
_OUTCOME_STYLES = {
    ALL: (DATA_COLOR, "-", "all episodes"),
    SUCCESS: ("#009E73", "-", "success"),
    FAILURE: ("#D55E00", "--", "failure"),
}
_X_LABELS = {
    EPISODE_TIME: "episode time (0 = first replan, 1 = end)",
    GRIPPER_CLOSING: "replans from the first gripper closing",
}
_HEADINGS = {EPISODE_TIME: "Over the course of an episode", GRIPPER_CLOSING: "Around the first gripper closing"}


def plot_time_courses(
    courses: TimeCourses, grouping: Grouping, folder: Path, level: float = DEFAULT_LEVEL
) -> list[Path]:
    """Draw one picture per alignment that the stores allow; returns the paths of png, pdf and csv."""
    paths = []
    for alignment, stem in STEMS.items():
        if alignment == EPISODE_TIME or courses.closing.height:
            paths += plot_time_course(courses, grouping, alignment, folder, stem, level)
    return paths


@drawn_in_our_style
def plot_time_course(
    courses: TimeCourses, grouping: Grouping, alignment: str, folder: Path, stem: str, level: float = DEFAULT_LEVEL
) -> list[Path]:
    """Draw one alignment of `time_courses.time_courses`."""
    data = courses.course.filter(pl.col("alignment") == alignment)
    figure = new_figure(11, 5.2)
    layer = layer_name(courses.layer, "mean over layers")
    title(figure, f"{_HEADINGS[alignment]}: {named(grouping)}, {layer}", _note(courses, alignment, level))
    if data.is_empty():
        explain(figure.subplots(), f"The gripper never closes in any of the {courses.closing.height} episodes.")
        return save_figure(figure, folder, stem, data)
    axes = figure.subplots(2, 2, sharex=True, height_ratios=[5, 1])
    apart = data["outcome"].n_unique() > 1
    outcomes = [SUCCESS, FAILURE] if apart else [ALL]
    left = data.filter(pl.col("outcome").is_in(outcomes), pl.col("quantity") == courses.quantities[0])
    _contrast_panel(axes[0, 0], left, outcomes, grouping, courses.quantities[0])
    right = data.filter(pl.col("outcome") == ALL, pl.col("quantity") != RATIO)
    _fraction_panel(axes[0, 1], right, grouping, level)
    _counts_strip(axes[1, 0], left, outcomes)
    _counts_strip(axes[1, 1], right.filter(pl.col("quantity") == right["quantity"][0]), [ALL])
    for panel in axes.ravel():
        if alignment == GRIPPER_CLOSING and panel.spines["left"].get_visible():  # not where an explanation stands
            panel.axvline(0, color=NOTE_COLOR, linewidth=0.8, linestyle=":")
        else:
            panel.set_xlim(0, 1)
    for panel in axes[1]:
        panel.set_xlabel(_X_LABELS[alignment])
    if alignment == GRIPPER_CLOSING:
        whole_numbers(axes[1, 0].xaxis)
    return save_figure(figure, folder, stem, data)


def _contrast_panel(axes: Axes, data: pl.DataFrame, outcomes: list[str], grouping: Grouping, quantity: str) -> None:
    values = np.concatenate([data[name].drop_nulls().to_numpy() for name in ("value", "low", "high", "uniform")])
    if quantity == RATIO:
        if not np.isfinite(data["value"].drop_nulls().to_numpy()).any():
            explain(axes, "No replan has a finite ratio.")
            return
        axes.set_title("ratio", loc="left")
        ratio_axis(axes.yaxis, values[np.isfinite(values)])
        assert grouping.ratio is not None
        axes.set_ylabel(f"{ratio_name(grouping.ratio)} (geometric mean, log axis)")
    else:
        axes.set_title(f"fraction of '{quantity}'", loc="left")
        axes.set_ylabel("fraction of the groups' summed mass")
    for outcome in outcomes:
        color, dash, label = _OUTCOME_STYLES[outcome]
        part = data.filter(pl.col("outcome") == outcome).sort("position")
        _line_with_band(axes, part, color, dash, label, alpha=0.18)
    if quantity == RATIO and data["uniform"].is_not_null().any():
        part = data.filter(pl.col("outcome") == outcomes[0]).sort("position")
        axes.plot(
            part["position"].to_numpy(),
            float_values(part["uniform"]),
            "--",
            color=BASELINE_COLOR,
            linewidth=1.2,
            label=BASELINE_LABEL,
        )
    axes.grid(axis="y")
    legend_above(axes, 3)


def _fraction_panel(axes: Axes, data: pl.DataFrame, grouping: Grouping, level: float) -> None:
    axes.set_title("fractions, all episodes", loc="left")
    styles = group_styles(grouping.names)
    for name in data["quantity"].unique(maintain_order=True):
        part = data.filter(pl.col("quantity") == name).sort("position")
        # A group without mass would be a line on the axis, and its name would crowd the legend.
        if not (part["value"].fill_null(0) > 0).any():
            continue
        style = styles[name]
        label = shortened(name, 24)
        _line_with_band(axes, part, style["color"], LINE_OF_HATCH[style["hatch"]], label, alpha=0.22)
    axes.set_ylim(0, None)
    axes.set_ylabel("fraction of the groups' summed mass")
    axes.grid(axis="y")
    count = len(axes.get_legend_handles_labels()[0])
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), ncols=1 if count <= 16 else 2, borderaxespad=0.4)


def _line_with_band(axes: Axes, part: pl.DataFrame, color: str, dash: str, label: str, alpha: float) -> None:
    where = part["position"].to_numpy()
    low, high = float_values(part["low"]), float_values(part["high"])
    axes.fill_between(where, low, high, color=color, alpha=alpha, linewidth=0)
    values, counts = float_values(part["value"]), part["num_episodes"].to_numpy()
    axes.plot(where, values, dash, color=color, label=label)
    # Where fewer episodes take part, a step can come from which ones they are, without a change in any of them.
    whole = counts == counts.max(initial=0)
    axes.plot(where[whole], values[whole], "o", color=color, markersize=3.4)
    axes.plot(
        where[~whole], values[~whole], "o", color=color, markersize=3.4, markerfacecolor="white", markeredgewidth=0.8
    )


def _counts_strip(axes: Axes, data: pl.DataFrame, outcomes: list[str]) -> None:
    most = 1
    for outcome in outcomes:
        part = data.filter(pl.col("outcome") == outcome).sort("position")
        color, dash, _ = _OUTCOME_STYLES[outcome]
        counts = part["num_episodes"].to_numpy()
        most = max(most, int(counts.max(initial=0)))
        axes.step(part["position"].to_numpy(), counts, dash, where="mid", color=color, linewidth=1.2)
    axes.set_ylim(0, most * 1.15)
    axes.set_yticks([0, most])
    axes.set_ylabel("episodes", fontsize=8)


def _note(courses: TimeCourses, alignment: str, level: float) -> str:
    episodes = courses.autocorrelation.height
    tasks = courses.autocorrelation.select("suite", "task_id").n_unique()
    text = f"{of_tasks(episodes, tasks)}. "
    text += f"Bands: pointwise {interval_name(level)}s."
    drawn = courses.course.filter(pl.col("alignment") == alignment)
    if unknown := courses.unknown_outcomes if (drawn["outcome"] == SUCCESS).any() else 0:
        text += f" {plural(unknown, 'episode')} without a known outcome {'is' if unknown == 1 else 'are'} in neither."
    if alignment == GRIPPER_CLOSING:
        closers = courses.closing["closing_replan"].is_not_null().sum()
        others = "; the others are not shown" if closers < courses.closing.height else ""
        text += f" The gripper closes in {closers} of {courses.closing.height} episodes{others}."
        text += " Hollow points: not every episode has that replan, and a step there may be one between episodes."
    if courses.num_nonfinite:
        text += f" {courses.num_nonfinite} replans have no finite ratio and are not in its course."
    if courses.course.filter(pl.col("alignment") == alignment)["low"].null_count():
        text += " No band where there can be none (one episode, no spread)."
    return text
