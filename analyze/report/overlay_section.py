"""Overlays of a few episodes with a slider over their replans. Without the script, and on paper, the slider is a strip."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import polars as pl

from vla_attention.analyze.measures.patch_maps import seen_cameras
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.measures.selected import SelectedEpisode
from vla_attention.analyze.overlay.colours import Scale, color_bar, scale_for
from vla_attention.analyze.overlay.overlay_data import (
    EpisodeOverlay,
    camera_names,
    chosen_replans,
    draw,
    episode_overlay,
    orientation_note,
)
from vla_attention.analyze.report.markup import paragraph, text
from vla_attention.analyze.report.pictures import photograph, png_uri
from vla_attention.analyze.report.sections import Section
from vla_attention.analyze.show.numbers import format_number
from vla_attention.analyze.show.patch_pictures import upright
from vla_attention.analyze.show.progress import progress_bar

#: Pixels of the longer side of a camera picture in the page.
LARGEST_SIDE = 224
_WIDTH, _HEIGHT, _LEFT, _TOP, _BOTTOM = 560.0, 130.0, 46.0, 16.0, 24.0


def choose_episodes(selected: Sequence[SelectedEpisode], count: int) -> list[SelectedEpisode]:
    """So many episodes, of tasks spread evenly over all tasks; solved and unsolved ones in turn, where a task has both."""
    by_task: dict[tuple[str, int], list[SelectedEpisode]] = {}
    for item in selected:
        by_task.setdefault((item.store.suite, item.episode.attributes.task_id), []).append(item)
    tasks = list(by_task.values())
    picked: list[SelectedEpisode] = []
    spread = np.linspace(0, len(tasks) - 1, min(count, len(tasks))).round()
    places = sorted({int(place) for place in spread})
    for turn, place in enumerate(places):
        wanted = turn % 2 == 0
        fitting = [item for item in tasks[place] if item.episode.attributes.success == wanted]
        picked.append((fitting or tasks[place])[0])
    # Fewer tasks than wanted episodes: further episodes of the same tasks, in turn.
    rest = [item for depth in range(max(map(len, tasks))) for group in tasks for item in group[depth : depth + 1]]
    for item in rest:
        if len(picked) >= count:
            break
        if all(item is not other for other in picked):
            picked.append(item)
    return picked


def overlay_section(question: Question, replans: pl.DataFrame, episodes: int, most_replans: int) -> Section | None:
    """The overlays, or None when the site has no cameras or no episode is wanted."""
    if not episodes or not seen_cameras(question.selected[0]):
        return None
    cameras = camera_names(question, None)
    chosen = choose_episodes(question.selected, episodes)
    overlays = []
    with progress_bar(len(chosen), "overlays") as advance:
        for item in chosen:
            overlays.append(episode_overlay(question, item, cameras, replans))
            advance(1)
    shown = [chosen_replans(overlay, None, most_replans) for overlay in overlays]
    values = [
        lift[list(which)].ravel()
        for overlay, which in zip(overlays, shown, strict=True)
        for lift in overlay.values("lift").values()
    ]
    scale = scale_for(np.concatenate(values), "lift", max(overlay.num_image_keys for overlay in overlays))
    notes = [note for note in dict.fromkeys(map(orientation_note, overlays)) if note]
    intro = (
        "Attention of the action queries on what the policy saw, mean over the layers, denoise steps and heads of "
        "this report, with one scale for all "
        "episodes here. The picture lies under the patches with a third of its colour."
    )
    parts = [f"<p>{text(intro)}</p>", *(f"<p>{text(note)}</p>" for note in notes), _scale(scale)]
    for number, (overlay, which) in enumerate(zip(overlays, shown, strict=True)):
        parts.append(_episode(number, overlay, which, scale))
    return Section("overlays", "Where it looks", "".join(parts))


def _scale(scale: Scale) -> str:
    mark = ""
    if scale.uniform is not None:
        place = f"left:{100 * scale.uniform / scale.high:.2f}%"
        mark = f'<span class="mark" style="{place}"><span>uniform: {scale.uniform:g}</span></span>'
    return (
        f'<div class="scale"><div class="bar"><img src="{png_uri(color_bar(scale, 256, 8))}" alt="Colours from none '
        f"at 0 over purple and orange to pale yellow "
        f'at {scale.high:g}">{mark}</div><div class="ends"><span>0</span><span>{scale.high:g} and '
        f"more</span></div>{text(scale.label)}</div>"
    )


def _episode(number: int, overlay: EpisodeOverlay, replans: Sequence[int], scale: Scale) -> str:
    attributes = overlay.item.episode.attributes
    outcome = "solved" if attributes.success else "not solved"
    name = f"{overlay.item.store.suite} task {attributes.task_id}, episode {attributes.episode_index}"
    heading = f"{name}, {outcome}: {attributes.instruction}"
    has_frames = any(overlay.has_frames(camera) for camera in overlay.maps)
    bare = '<label><input type="checkbox"> pictures alone</label>' if has_frames else ""
    some = ""
    if len(replans) < overlay.num_replans:
        some = paragraph(f"{len(replans)} of {overlay.num_replans} replans, from the first to the last.", "quiet")
    points = _points(overlay)
    figures = "".join(_replan(overlay, replan, scale, points[replan]) for replan in replans)
    return (
        f'<section class="episode" aria-labelledby="episode{number}"><h3 '
        f'id="episode{number}">{text(heading)}</h3>{_curve(overlay, points)}'
        f'<div class="player"><label for="slider{number}">replan</label><input type="range" id="slider{number}" '
        f'min="0" max="{len(replans) - 1}" value="0" '
        f'step="1"><output for="slider{number}"></output>{bare}</div>{some}<div class="strip">{figures}</div></section>'
    )


def _label(overlay: EpisodeOverlay, replan: int) -> str:
    label = f"replan {replan}, step {overlay.env_step[replan]}"
    return label if overlay.ratio is None else f"{label}, ratio {format_number(float(overlay.ratio[replan]))}"


def _replan(overlay: EpisodeOverlay, replan: int, scale: Scale, point: tuple[float, float | None]) -> str:
    values = overlay.values("lift")
    views = []
    for camera in overlay.maps:
        mass = overlay.maps[camera][replan].sum()
        share = 100 * mass / overlay.image_mass[replan] if overlay.image_mass[replan] else float("nan")
        lift = upright(values[camera][replan], overlay.views[camera])
        row, column = divmod(int(np.nan_to_num(lift).argmax()), lift.shape[1])
        place = _place(row, column, *lift.shape)
        peak = format_number(float(lift[row, column]))
        alternative = (
            f"{camera} at {_label(overlay, replan)}: {share:.0f} % of image attention; highest lift {peak}, {place}"
        )
        heat = photograph(draw(overlay, camera, replan, scale, values), LARGEST_SIDE)
        images = f'<img class="heat" src="{heat}" alt="{text(alternative)}">'
        if overlay.has_frames(camera):
            frame = upright(overlay.item.episode.read(f"frames/{camera}", replan), overlay.views[camera])
            bare = f"{camera} at {_label(overlay, replan)}, without attention"
            images += f'<img class="plain" src="{photograph(frame, LARGEST_SIDE)}" alt="{text(bare)}">'
        note = f"{camera}: {share:.0f} % of image attention, highest lift {peak}"
        views.append(f"<span>{images}<small>{text(note)}</small></span>")
    x, y = point
    return (
        f'<figure class="replan" data-label="{text(_label(overlay, replan))}" data-x="{x:.1f}" '
        f'data-y="{"" if y is None else f"{y:.1f}"}">'
        f'<div class="views">{"".join(views)}</div><figcaption>{text(_label(overlay, replan))}</figcaption></figure>'
    )


def _place(row: int, column: int, rows: int, columns: int) -> str:
    """Where a patch lies in a picture, in words."""
    vertical = ("at the top", "in the middle", "at the bottom")[min(2, 3 * row // rows)]
    horizontal = ("left", "centre", "right")[min(2, 3 * column // columns)]
    return f"{vertical} {horizontal}"


def _drawable(overlay: EpisodeOverlay) -> np.ndarray | None:
    """Base-2 logarithms of the ratios, NaN where they have none; None when nothing can be drawn."""
    if overlay.ratio is None:
        return None
    usable = np.isfinite(overlay.ratio) & (overlay.ratio > 0)
    if not usable.any():
        return None
    return np.log2(np.where(usable, overlay.ratio, np.nan))


def _limits(overlay: EpisodeOverlay, logs: np.ndarray) -> tuple[float, float]:
    """Limits of the curve's axis, at least a factor of two apart, with uniform attention inside."""
    known = [logs[np.isfinite(logs)]]
    if overlay.uniform_ratio is not None:
        with np.errstate(divide="ignore", invalid="ignore"):
            uniform = np.log2(overlay.uniform_ratio)
        known.append(uniform[np.isfinite(uniform)])
    every = np.concatenate(known)
    low, high = float(every.min()), float(every.max())
    room = max(0.08 * (high - low), 0.5 * (1.0 - (high - low)), 0.05)
    return low - room, high + room


def _points(overlay: EpisodeOverlay) -> list[tuple[float, float | None]]:
    """Where each replan stands in the curve's picture."""
    steps = overlay.env_step.astype(float)
    length = steps[-1] - steps[0]
    x = _LEFT + (steps - steps[0]) / length * (_WIDTH - _LEFT - 10) if length else np.full(len(steps), _WIDTH / 2)
    logs = _drawable(overlay)
    if logs is None:
        return [(float(place), None) for place in x]
    low, high = _limits(overlay, logs)
    y = _TOP + (high - logs) / (high - low) * (_HEIGHT - _TOP - _BOTTOM)
    return [(float(a), None if np.isnan(b) else float(b)) for a, b in zip(x, y, strict=True)]


def _curve(overlay: EpisodeOverlay, points: Sequence[tuple[float, float | None]]) -> str:
    """The ratio over the whole episode as a small inline SVG; infinite ratios are gaps."""
    logs = _drawable(overlay)
    if logs is None or overlay.ratio is None:
        return "" if overlay.ratio is None else '<p class="quiet">No replan of this episode has a finite ratio.</p>'
    low, high = _limits(overlay, logs)

    def height(value: float) -> float:
        return _TOP + (high - value) / (high - low) * (_HEIGHT - _TOP - _BOTTOM)

    runs: list[list[str]] = [[]]
    for x, y in points:
        if y is None:
            runs.append([])
        else:
            runs[-1].append(f"{x:.1f},{y:.1f}")
    lines = "".join(
        f'<polyline points="{" ".join(run if len(run) > 1 else run * 2)}" stroke-linecap="round"></polyline>'
        for run in runs
        if run
    )
    finite = overlay.ratio[np.isfinite(logs)]
    ticks = {float(finite.min()), float(finite.max())}
    uniform = ""
    if (
        overlay.uniform_ratio is not None
        and np.isfinite(overlay.uniform_ratio).any()
        and (overlay.uniform_ratio > 0).all()
    ):
        value = float(np.nanmean(overlay.uniform_ratio))
        y = height(float(np.log2(value)))
        above = y > _TOP + 14
        uniform = (
            f'<line class="uniform" x1="{_LEFT:g}" x2="{_WIDTH - 10:g}" y1="{y:.1f}" y2="{y:.1f}"></line>'
            f'<text x="{_WIDTH - 10:g}" y="{y - 4 if above else y + 13:.1f}" text-anchor="end">uniform attention: '
            f"{format_number(value)}</text>"
        )
    marks = sorted((height(float(np.log2(tick))), tick) for tick in ticks)
    if len(marks) == 2 and marks[1][0] - marks[0][0] < 12:
        marks = marks[:1]
    labels = "".join(
        f'<text x="{_LEFT - 6:g}" y="{y + 4:.1f}" text-anchor="end">{format_number(tick)}</text>' for y, tick in marks
    )
    bottom = _HEIGHT - _BOTTOM
    first, last = overlay.env_step[0], overlay.env_step[-1]
    lowest, highest = format_number(float(finite.min())), format_number(float(finite.max()))
    description = f"Ratio from step {first} to {last}: lowest {lowest}, highest {highest}"
    return (
        f'<svg class="curve" viewBox="0 0 {_WIDTH:g} {_HEIGHT:g}" role="img" aria-label="{text(description)}">'
        f'<line class="axis" x1="{_LEFT:g}" x2="{_WIDTH - 10:g}" y1="{bottom:g}" y2="{bottom:g}"></line>{uniform}'
        f'<line class="now" x1="{_LEFT:g}" x2="{_LEFT:g}" y1="{_TOP:g}" y2="{bottom:g}"></line>{lines}<circle r="5" '
        f'cx="{points[0][0]:.1f}" '
        f'cy="{points[0][1] if points[0][1] is not None else -99:.1f}"></circle>{labels}<text x="{_LEFT:g}" '
        f'y="{_HEIGHT - 7:g}">step {first}</text>'
        f'<text x="{_WIDTH - 10:g}" y="{_HEIGHT - 7:g}" text-anchor="end">step {last}</text><text x="{_LEFT:g}" '
        f'y="11">ratio (log axis)</text></svg>'
    )
