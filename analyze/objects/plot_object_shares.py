"""`object_shares`: shares of the image attention over time, by object in one episode and by class over all."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.measures.frames import EPISODE_ID, rows_of_episode
from vla_attention.analyze.objects.object_study import ObjectStudy
from vla_attention.analyze.objects.object_views import ALL_CAMERAS, CLASSES
from vla_attention.analyze.show.numbers import interval_name, of_tasks
from vla_attention.analyze.show.plot_axes import legend_below, ratio_axis, uniform_line, whole_numbers
from vla_attention.analyze.show.plot_colours import FIXED_COLORS, FURTHER_COLORS
from vla_attention.analyze.show.plot_style import drawn_in_our_style, new_figure, save_figure
from vla_attention.analyze.show.plot_text import shortened, title
from vla_attention.analyze.statistics.episode_intervals import Sampling
from vla_attention.analyze.statistics.intervals import (
    DEFAULT_LEVEL,
    POSITIVE,
    SHARE,
    EpisodeStatistic,
    estimates,
    mean_over_episodes,
)
from vla_attention.analyze.statistics.units import Units
from vla_attention.schemas.safe_text import visible

if TYPE_CHECKING:
    from matplotlib.axes import Axes

STEM = "object_shares"
#: Objects of interest, other objects, robot, background.
CLASS_COLORS = dict(zip(CLASSES, ("#D55E00", "#0072B2", "#009E73", "#9A9A9A"), strict=True))
_PHASES = np.linspace(0.0, 1.0, 21)
#: Objects beside robot and background that have a colour of their own; the others are shown together.
_MOST = 9
_OTHERS = "other objects"
_COLUMNS = ("share", "area_share", "even_share")


@drawn_in_our_style
def plot_object_shares(study: ObjectStudy, folder: Path) -> list[Path]:
    """Draw the study's `times` and controls, all cameras together; returns the paths of png, pdf and csv.

    Left: shares of the example episode's image attention, stacked by object. Middle: mean over episodes by class, over
    the episode's time from 0 to 1 (replans interpolated linearly), with pointwise intervals; dashed: covered area, what
    uniform attention gives. Right: enrichment at each time, share / what attention gives that is uniform over each
    camera's picture, mean over episodes; dotted: the control, the enrichment of the same maps on masks of other
    episodes, where it can tell.
    """
    example = study.example
    together = pl.col("camera") == ALL_CAMERAS
    whole = study.tables.times.filter(together, pl.col("kind") == "class")
    attributes = example.episode.attributes
    own = rows_of_episode(study.tables.times, example).filter(together)
    figure = new_figure(14.5, 4.7)
    num_episodes = whole.select(EPISODE_ID).unique().height
    num_tasks = whole.select(EPISODE_ID[:2]).unique().height
    title(
        figure,
        "Share of the image attention by object, all cameras, mean over layers and heads",
        f"Left: {example.episode.name}, '{visible(attributes.instruction)}'. Middle and right: mean over "
        f"{of_tasks(num_episodes, num_tasks)} with {interval_name(DEFAULT_LEVEL)} at each time; "
        "dashed: what uniform attention gives (in the middle: the covered area). Dotted: the control, the same maps on "
        "the objects' masks of other episodes.",
    )
    left, middle, right = figure.subplots(1, 3)
    shown = _draw_example(left, own)
    classes = _draw_classes(middle, right, whole, _controls(study.summary), study.question.sampling)
    return save_figure(figure, folder, STEM, pl.concat([shown, classes], how="diagonal"))


def _draw_example(axes: Axes, own: pl.DataFrame) -> pl.DataFrame:
    objects = own.filter(pl.col("kind") == "object")
    ranked = (
        objects.group_by("item", "object_class")
        .agg(pl.col("share").mean())
        .sort(["share", "item"], descending=[True, False])
    )
    plain = [row["item"] for row in ranked.iter_rows(named=True) if row["object_class"] in CLASSES[:2]]
    kept = plain[:_MOST]
    named = objects.with_columns(
        pl.when(pl.col("object_class").is_in(CLASSES[2:]) | pl.col("item").is_in(kept))
        .then(pl.col("item"))
        .otherwise(pl.lit(_OTHERS))
        .alias("shown")
    )
    series = named.group_by("shown", "object_class", "env_step").agg(pl.col("share").sum(), pl.col("area_share").sum())
    kinds = {row["item"]: row["object_class"] for row in ranked.iter_rows(named=True)}
    # From below: objects of interest, other objects, robot, background.
    order = sorted(kept, key=lambda name: CLASSES.index(kinds[name]))
    order += [_OTHERS] if len(plain) > _MOST else []
    order += [name for kind in CLASSES[2:] for name, of in kinds.items() if of == kind]
    steps = np.unique(own["env_step"].to_numpy())
    bottom = np.zeros(len(steps))
    further = iter(FURTHER_COLORS)
    for name in order:
        part = series.filter(pl.col("shown") == name).group_by("env_step").agg(pl.col("share").sum()).sort("env_step")
        share = np.nan_to_num(100 * part["share"].to_numpy().astype(float))
        kind = kinds.get(name, CLASSES[1])
        color = (
            CLASS_COLORS[kind] if kind in CLASSES[2:] else FIXED_COLORS["other"] if name == _OTHERS else next(further)
        )
        label = shortened(name, 26) + (" (of interest)" if kind == CLASSES[0] else "")
        if len(steps) > 1:
            axes.fill_between(steps, bottom, bottom + share, color=color, linewidth=0, label=label)
        else:
            axes.bar(steps, share, 2.0, bottom, color=color, label=label)
        bottom += share
    axes.set_xlabel("environment step")
    axes.set_ylabel("share of image attention (%)")
    axes.set_ylim(0, max(float(bottom.max()), 1.0))
    whole_numbers(axes.xaxis)
    if len(steps) > 1:
        axes.set_xlim(steps[0], steps[-1])
    legend_below(axes, 3, from_top=True)
    return series.select(
        pl.lit("example").alias("panel"),
        pl.col("shown").alias("name"),
        pl.col("env_step").cast(pl.Float64).alias("time"),
        "share",
        "area_share",
    ).sort("name", "time")


def _controls(summary: pl.DataFrame) -> dict[str, float]:
    """By class, all cameras together: its control, where that can tell."""
    telling = summary.filter(camera=ALL_CAMERAS, kind="class").drop_nulls("enrichment_over_control")
    return dict(telling.select("item", "control_enrichment").iter_rows())


def _draw_classes(
    axes: Axes, enrichment_axes: Axes, whole: pl.DataFrame, controls: Mapping[str, float], sampling: Sampling
) -> pl.DataFrame:
    parts: list[pl.DataFrame] = []
    for name in CLASSES:
        part = whole.filter((pl.col("kind") == "class") & (pl.col("item") == name))
        if part.is_empty():
            continue
        (share, area, even), episodes = _by_phase(part)
        units = sampling.units(episodes).decided()
        shares = _with_intervals([mean_over_episodes(column, SHARE) for column in share.T], units)
        with np.errstate(divide="ignore", invalid="ignore"):  # where the object is out of view
            of_episodes = [mean_over_episodes(column, POSITIVE) for column in (share / even).T]
        enrichments = _with_intervals(of_episodes, units)
        covered, color = area.mean(axis=0), CLASS_COLORS[name]
        label = name if len(share) == whole.select(EPISODE_ID).unique().height else f"{name} (n = {len(share)})"
        axes.plot(_PHASES, 100 * covered, color=color, linestyle="--", linewidth=1.0)
        for target, factor, (value, low, high) in ((axes, 100, shares), (enrichment_axes, 1, enrichments)):
            target.plot(_PHASES, factor * value, color=color, label=label)
            target.fill_between(_PHASES, factor * low, factor * high, color=color, alpha=0.2, linewidth=0)
        drawn: dict[str, NDArray[np.float64]] = {"time": _PHASES, "area_share": covered}
        drawn |= dict(zip(("share", "share_low", "share_high"), shares, strict=True))
        drawn |= dict(zip(("enrichment", "enrichment_low", "enrichment_high"), enrichments, strict=True))
        control = controls.get(name)
        if control is not None:
            enrichment_axes.axhline(control, color=color, linestyle=":", linewidth=1.2)
        parts.append(
            pl.DataFrame(drawn).select(
                pl.lit("mean").alias("panel"),
                pl.lit(name).alias("name"),
                "time",
                "area_share",
                pl.lit(len(share), dtype=pl.Int64).alias("num_episodes"),
                pl.lit(control, dtype=pl.Float64).alias("control_enrichment"),
                pl.exclude("time", "area_share"),
            )
        )
    data = pl.concat(parts).with_columns(pl.col(pl.Float64).fill_nan(None))
    top = 100 * max(data.select(pl.max_horizontal("share", "share_high", "area_share").max()).item() or 0.0, 0.01)
    axes.set_ylim(0, 1.05 * top)
    axes.set_ylabel("share of image attention (%)")
    uniform_line(enrichment_axes)
    drawn_values = data.select("enrichment", "enrichment_low", "enrichment_high", "control_enrichment")
    ratio_axis(enrichment_axes.yaxis, np.append(drawn_values.to_numpy().astype(float), 1.0))
    enrichment_axes.set_ylabel("enrichment (share / uniform over each picture, logarithmic)")
    for target in (axes, enrichment_axes):
        target.set_xlabel("time in the episode (0: first replan, 1: last)")
        target.set_xlim(0, 1)
        target.grid(axis="y")
        legend_below(target, 2)
    return data


def _with_intervals(
    statistics: list[EpisodeStatistic], units: Units
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Value, low and high of each statistic; NaN where there is none."""
    found = estimates(statistics, units)
    values = [np.nan if one.value is None else one.value for one in found]
    intervals = [one.interval() for one in found]
    low = [interval.low if interval else np.nan for interval in intervals]
    high = [interval.high if interval else np.nan for interval in intervals]
    return np.array(values), np.array(low), np.array(high)


def _by_phase(part: pl.DataFrame) -> tuple[NDArray[np.float64], pl.DataFrame]:
    """Shares (column, episode, phase), see `_COLUMNS`, interpolated over each episode's replans, and the episodes."""
    found = []
    episodes = part.select(EPISODE_ID).unique(maintain_order=True)
    for _, episode in part.group_by(EPISODE_ID, maintain_order=True):
        ordered = episode.sort("replan")
        last = ordered.height - 1
        phase = ordered["replan"].to_numpy() / last if last else np.zeros(1)
        columns = [ordered[name].cast(pl.Float64).to_numpy() for name in _COLUMNS]
        found.append([np.interp(_PHASES, phase, column) for column in columns])
    return np.array(found).swapaxes(0, 1), episodes
