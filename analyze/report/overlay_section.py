"""Overlays of a few episodes with a slider over their replans; without the script, and on paper, a strip of them.

Each episode has the curve of its ratio, a small inline SVG.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.measures.patch_maps import seen_cameras
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.measures.selected import SelectedEpisode, positions_by_task
from vla_attention.analyze.overlay.colours import Scale, color_bar, scale_for
from vla_attention.analyze.overlay.overlay_data import (
    EpisodeOverlay,
    camera_names,
    chosen_replans,
    draw,
    episode_overlay,
    orientation_note,
)
from vla_attention.analyze.report.pictures import photograph, png_address
from vla_attention.analyze.report.report_settings import ReportSettings
from vla_attention.analyze.report.section_parts import Paragraph, Section
from vla_attention.analyze.show.numbers import format_number, format_percent, outcome_word
from vla_attention.analyze.show.patch_pictures import upright
from vla_attention.schemas.progress_bar import progress_bar

#: Marks of the axis that are nearer than this (in the units of the picture) would write over each other.
_LEAST_DISTANCE = 12


@dataclass(frozen=True)
class Point:
    """A replan in the picture, in tenths of a unit; `y` is None where the ratio is not finite or 0."""

    x: float
    y: float | None


@dataclass(frozen=True)
class Mark:
    """A value on the axis."""

    y: float
    text: str


@dataclass(frozen=True)
class RatioCurve:
    """The picture of one episode, in the units of its view box.

    Attributes:
        points: one per replan.
        lines: the points of each polyline, in SVG's notation; ratios that are not finite are gaps.
        marks: lowest and highest ratio on the axis; one when they would write over each other.
        uniform: the mean uniform ratio; None where it cannot be drawn.
        first_step, last_step: environment steps of the first and the last replan.
        description: the curve in words.
    """

    width: ClassVar[int] = 560
    height: ClassVar[int] = 130
    left: ClassVar[int] = 46
    right: ClassVar[int] = 550
    top: ClassVar[int] = 16
    bottom: ClassVar[int] = 106
    points: Sequence[Point]
    lines: Sequence[str]
    marks: Sequence[Mark]
    uniform: Mark | None
    first_step: int
    last_step: int
    description: str

    @property
    def uniform_text_y(self) -> float | None:
        """Height of the text of the uniform ratio: above its line, or below where there is no room."""
        if self.uniform is None:
            return None
        return round(self.uniform.y + (-4 if self.uniform.y > self.top + 14 else 13), 1)


def ratio_curve(
    ratio: NDArray[np.float64], uniform: NDArray[np.float64] | None, env_step: NDArray[np.int64]
) -> RatioCurve | None:
    """The curve of an episode's ratios, on a logarithmic axis; None when no ratio is finite and positive.

    Args:
        ratio: (replan,), not finite or 0 where there is nothing to draw.
        uniform: (replan,), ratios that uniform attention would give.
        env_step: (replan,), environment steps.
    """
    drawable = np.isfinite(ratio) & (ratio > 0)
    if not drawable.any():
        return None
    logs = np.log2(np.where(drawable, ratio, np.nan))
    known = uniform is not None and bool(np.isfinite(uniform).any() and (uniform > 0).all())
    low, high = _limits(logs, uniform)

    def height(value: float) -> float:
        share = (high - value) / (high - low)
        return round(RatioCurve.top + share * (RatioCurve.bottom - RatioCurve.top), 1)

    points = [
        Point(x, None if np.isnan(log) else height(log))
        for x, log in zip(_places(env_step), logs.tolist(), strict=True)
    ]
    least, most = float(ratio[drawable].min()), float(ratio[drawable].max())
    marks = sorted({Mark(height(np.log2(value)), format_number(value)) for value in (least, most)}, key=lambda m: m.y)
    if len(marks) == 2 and marks[1].y - marks[0].y < _LEAST_DISTANCE:
        marks = marks[:1]
    mean_uniform = float(np.nanmean(uniform)) if known and uniform is not None else None
    first, last = int(env_step[0]), int(env_step[-1])
    return RatioCurve(
        points=points,
        lines=_lines(points),
        marks=marks,
        uniform=None if mean_uniform is None else Mark(height(np.log2(mean_uniform)), format_number(mean_uniform)),
        first_step=first,
        last_step=last,
        description=f"Ratio from step {first} to {last}: lowest {format_number(least)}, highest {format_number(most)}",
    )


def _places(env_step: NDArray[np.int64]) -> list[float]:
    """The x of every replan; in the middle when there is one."""
    steps = env_step.astype(np.float64)
    length = steps[-1] - steps[0]
    if not length:
        return [RatioCurve.width / 2] * len(steps)
    places = RatioCurve.left + (steps - steps[0]) / length * (RatioCurve.right - RatioCurve.left)
    return [round(place, 1) for place in places.tolist()]


def _limits(logs: NDArray[np.float64], uniform: NDArray[np.float64] | None) -> tuple[float, float]:
    """Limits of the axis (base-2 logarithms), at least a factor of two apart; they include the uniform ratio."""
    known = [logs[np.isfinite(logs)]]
    if uniform is not None:
        with np.errstate(divide="ignore", invalid="ignore"):
            of_uniform = np.log2(uniform)
        known.append(of_uniform[np.isfinite(of_uniform)])
    every = np.concatenate(known)
    low, high = float(every.min()), float(every.max())
    room = max(0.08 * (high - low), 0.5 * (1.0 - (high - low)), 0.05)
    return low - room, high + room


def _lines(points: Sequence[Point]) -> list[str]:
    """Neighbouring points as polylines; a single point becomes a line of length 0, which round ends make a dot."""
    lines: list[list[str]] = [[]]
    for point in points:
        if point.y is None:
            lines.append([])
        else:
            lines[-1].append(f"{point.x},{point.y}")
    return [" ".join(line if len(line) > 1 else line * 2) for line in lines if line]


#: Pixels of the longer side of a camera picture in the page.
LARGEST_SIDE = 224


@dataclass(frozen=True)
class ScaleBar:
    """The colours' meaning: `address` of a bar of them from 0 to `high`, and where on it `uniform` attention is."""

    address: str
    high: str
    label: str
    uniform: str | None
    uniform_percent: str


@dataclass(frozen=True)
class CameraView:
    """One camera at one replan: the overlay and the picture alone (empty when it was not stored), as data addresses."""

    camera: str
    overlay: str
    alternative: str
    frame: str
    note: str


@dataclass(frozen=True)
class ShownReplan:
    """One position of the slider; `x` and `y` are its place on the ratio's curve, `y` empty where there is none."""

    label: str
    x: float | str
    y: float | str
    views: Sequence[CameraView]


@dataclass(frozen=True)
class ShownEpisode:
    """One slider with its curve, or why there is no curve; `left_out` says which replans are not shown."""

    heading: str
    curve: RatioCurve | None
    without_curve: str
    left_out: str
    has_frames: bool
    replans: Sequence[ShownReplan]


@dataclass(frozen=True)
class Overlays:
    """Episodes with one scale of colours."""

    template: ClassVar[str] = "overlays.html"
    scale: ScaleBar
    episodes: Sequence[ShownEpisode]


def overlay_section(question: Question, replans: pl.DataFrame, settings: ReportSettings) -> Section | None:
    """The overlays; None when the site has no cameras or no episode is wanted.

    Args:
        question: stores, selection, site and grouping.
        replans: a row per replan and layer of all selected episodes, with the ratio.
        settings: number of episodes, and of replans of each.
    """
    if not settings.episodes or not seen_cameras(question.selected[0]):
        return None
    cameras = camera_names(question, None)
    chosen = choose_episodes(question.selected, settings.episodes)
    overlays = []
    with progress_bar(len(chosen), "overlays") as advance:
        for item in chosen:
            overlays.append(episode_overlay(question, item, cameras, replans))
            advance(1)
    shown = [chosen_replans(overlay, None, settings.replans) for overlay in overlays]
    values = [
        lift[list(which)].ravel()
        for overlay, which in zip(overlays, shown, strict=True)
        for lift in overlay.values("lift").values()
    ]
    scale = scale_for(np.concatenate(values), "lift", max(overlay.num_image_keys for overlay in overlays))
    intro = (
        "Attention of the action queries on the pictures that the policy saw, mean over the layers, denoise steps and "
        "heads of this report. All episodes here have one scale. The picture below the patches keeps a third of its "
        "colour."
    )
    notes = [note for note in dict.fromkeys(map(orientation_note, overlays)) if note]
    part = Overlays(_scale_bar(scale), [_episode(*pair, scale) for pair in zip(overlays, shown, strict=True)])
    return Section("overlays", "Where it looks", [*map(Paragraph, [intro, *notes]), part])


def choose_episodes(selected: Sequence[SelectedEpisode], count: int) -> list[SelectedEpisode]:
    """`count` episodes of tasks spread evenly over all tasks; solved and failed ones in turn, where a task has both."""
    tasks = [[selected[i] for i in positions] for positions in positions_by_task(selected).values()]
    picked: list[SelectedEpisode] = []
    spread = np.linspace(0, len(tasks) - 1, min(count, len(tasks))).round()
    for turn, place in enumerate(sorted({int(place) for place in spread})):
        fitting = [item for item in tasks[place] if item.episode.attributes.success is (turn % 2 == 0)]
        picked.append((fitting or tasks[place])[0])
    # With fewer tasks than wanted episodes: further episodes of the same tasks, in turn.
    rest = [item for depth in range(max(map(len, tasks))) for group in tasks for item in group[depth : depth + 1]]
    for item in rest:
        if len(picked) >= count:
            break
        if all(item is not other for other in picked):
            picked.append(item)
    return picked


def _scale_bar(scale: Scale) -> ScaleBar:
    return ScaleBar(
        address=png_address(color_bar(scale, 256, 8)),
        high=f"{scale.high:g}",
        label=scale.label,
        uniform=None if scale.uniform is None else f"{scale.uniform:g}",
        uniform_percent="" if scale.uniform is None else f"{100 * scale.uniform / scale.high:.2f}",
    )


def _episode(overlay: EpisodeOverlay, replans: Sequence[int], scale: Scale) -> ShownEpisode:
    attributes = overlay.item.episode.attributes
    outcome = outcome_word(attributes.success, "solved", "not solved")
    name = f"{overlay.item.store.suite} task {attributes.task_id}, episode {attributes.episode_index}"
    curve = None if overlay.ratio is None else ratio_curve(overlay.ratio, overlay.uniform_ratio, overlay.env_step)
    missing = overlay.ratio is not None and curve is None
    some = f"{len(replans)} of {overlay.num_replans} replans, from the first to the last."
    lifts = overlay.values("lift")
    return ShownEpisode(
        heading=f"{name}, {outcome}: {attributes.instruction}",
        curve=curve,
        without_curve="No replan of this episode has a finite ratio." if missing else "",
        left_out=some if len(replans) < overlay.num_replans else "",
        has_frames=any(map(overlay.has_frames, overlay.maps)),
        replans=[_replan(overlay, replan, scale, lifts, curve) for replan in replans],
    )


def _replan(
    overlay: EpisodeOverlay,
    replan: int,
    scale: Scale,
    lifts: Mapping[str, NDArray[np.float64]],
    curve: RatioCurve | None,
) -> ShownReplan:
    label = f"replan {replan}, step {overlay.env_step[replan]}"
    if overlay.ratio is not None:
        label += f", ratio {format_number(float(overlay.ratio[replan]))}"
    views = [_view(overlay, camera, replan, label, scale, lifts) for camera in overlay.maps]
    if curve is None:
        return ShownReplan(label, "", "", views)
    point = curve.points[replan]
    return ShownReplan(label, point.x, "" if point.y is None else point.y, views)


def _view(
    overlay: EpisodeOverlay,
    camera: str,
    replan: int,
    label: str,
    scale: Scale,
    lifts: Mapping[str, NDArray[np.float64]],
) -> CameraView:
    share = f"{format_percent(overlay.share(camera, replan), 0)} of image attention"
    lift = upright(lifts[camera][replan], overlay.views[camera])
    row, column = divmod(int(np.nan_to_num(lift).argmax()), lift.shape[1])
    peak = format_number(float(lift[row, column]))
    frame = ""
    if overlay.has_frames(camera):
        picture = upright(overlay.item.episode.read(f"frames/{camera}", replan), overlay.views[camera])
        frame = photograph(picture, LARGEST_SIDE)
    place = _place_in_words(row, column, *lift.shape)
    return CameraView(
        camera=camera,
        overlay=photograph(draw(overlay, camera, replan, scale, lifts), LARGEST_SIDE),
        alternative=f"{camera} at {label}: {share}; highest lift {peak}, {place}",
        frame=frame,
        note=f"{camera}: {share}, highest lift {peak}",
    )


def _place_in_words(row: int, column: int, rows: int, columns: int) -> str:
    vertical = ("at the top", "in the middle", "at the bottom")[min(2, 3 * row // rows)]
    horizontal = ("left", "centre", "right")[min(2, 3 * column // columns)]
    return f"{vertical} {horizontal}"
