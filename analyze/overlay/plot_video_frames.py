"""Frames of an episode's video: the cameras with attention on them, and the ratio's curve running beside them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from vla_attention.analyze.overlay.colours import Measure
from vla_attention.analyze.overlay.overlay_data import EpisodeOverlay, draw, orientation_note
from vla_attention.analyze.overlay.overlay_study import OverlayStudy
from vla_attention.analyze.overlay.plot_strip import draw_scale, shown_ratio
from vla_attention.analyze.overlay.video import VideoFormat, write_video
from vla_attention.analyze.show.numbers import format_number
from vla_attention.analyze.show.plot_axes import BASELINE_LABEL, legend_above, ratio_axis, whole_numbers
from vla_attention.analyze.show.plot_colours import BASELINE_COLOR, DATA_COLOR
from vla_attention.analyze.show.plot_style import drawn_in_our_style, new_figure
from vla_attention.analyze.show.plot_text import explain, title, wrapped
from vla_attention.analyze.show.progress import progress_bar
from vla_attention.schemas.groupings.grouping import Grouping

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_DPI = 100
_SIDE, _CURVE = 2.7, 3.9


def write_overlay_video(
    study: OverlayStudy,
    path: Path,
    fps: float,
    *,
    measure: Measure = "lift",
    smooth: bool = False,
) -> Path:
    """Write the whole episode as GIF or MP4, by the ending of `path`, `fps` replans a second; shows progress at a terminal."""
    kind: VideoFormat = "mp4" if path.suffix == ".mp4" else "gif"
    overlay, grouping = study.overlay, study.question.grouping
    with progress_bar(overlay.num_replans, "pictures") as advance:

        def counted() -> Iterator[NDArray[np.uint8]]:
            for frame in video_frames(overlay, grouping, measure=measure, smooth=smooth):
                advance(1)
                yield frame

        return write_video(path, counted(), fps, kind)


def video_frames(
    overlay: EpisodeOverlay, grouping: Grouping, *, measure: Measure = "lift", smooth: bool = False
) -> Iterator[NDArray[np.uint8]]:
    """A picture (row, column, 3) uint8 for every replan. One scale and one curve for all of them."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    cameras = list(overlay.maps)
    width = max(7.0, len(cameras) * _SIDE + _CURVE)
    values, scale = overlay.values(measure), overlay.scale(measure, range(overlay.num_replans))
    first = [draw(overlay, camera, 0, scale, values, smooth) for camera in cameras]

    @drawn_in_our_style
    def set_up() -> tuple[FigureCanvasAgg, list, list, object]:
        figure = new_figure(width, _SIDE + 1.6)
        attributes = overlay.item.episode.attributes
        outcome = "success" if attributes.success else "failure"
        heading = f"{overlay.item.store.suite} task {attributes.task_id}, episode {attributes.episode_index}: {attributes.instruction}"
        title(figure, heading, f"{outcome}; a picture per replan. {orientation_note(overlay)}")
        ratios = [*[1.0] * len(cameras), _CURVE / _SIDE]
        grid = figure.add_gridspec(2, len(cameras) + 1, width_ratios=ratios, height_ratios=[1.0, 0.06])
        images = []
        for i, camera in enumerate(cameras):
            axes = figure.add_subplot(grid[0, i])
            images.append(axes.imshow(first[i], interpolation="nearest"))
            axes.set_axis_off()
            axes.set_title(wrapped(camera, 34, 1), size=8)
        draw_scale(figure.add_subplot(grid[1, : len(cameras)]), scale)
        curve = figure.add_subplot(grid[:, -1])
        moving = _draw_curve(curve, overlay, grouping)
        canvas = figure.canvas
        assert isinstance(canvas, FigureCanvasAgg)
        return canvas, images, moving, curve

    canvas, images, moving, curve = set_up()

    @drawn_in_our_style
    def show(replan: int) -> NDArray[np.uint8]:
        for camera, image in zip(cameras, images, strict=True):
            image.set_data(draw(overlay, camera, replan, scale, values, smooth))
        _move(curve, moving, overlay, grouping, replan)
        canvas.draw()
        return np.asarray(canvas.buffer_rgba())[..., :3].copy()

    canvas.figure.set_dpi(_DPI)
    for replan in range(overlay.num_replans):
        yield show(replan)


def _draw_curve(axes: Axes, overlay: EpisodeOverlay, grouping: Grouping) -> list:
    values, uniform, name = shown_ratio(overlay, grouping)
    is_ratio = overlay.ratio is not None
    drawable = np.isfinite(values) & (values > 0)
    if not drawable.any():
        explain(
            axes,
            f"No finite ratio: {int(np.isinf(values).sum())} of {len(values)} are infinite, the others undefined or 0.",
        )
        return []
    if is_ratio:
        ratio_axis(axes.yaxis, values if uniform is None else np.concatenate([values, uniform]))
    else:
        axes.set_ylim(0, 1.1 * float(values[drawable].max()))
    shown = np.where(drawable, values, np.nan)
    axes.plot(overlay.env_step, shown, color="#C8C8C8", linewidth=1.2)
    if uniform is not None and np.isfinite(uniform).any():
        axes.plot(overlay.env_step, uniform, "--", color=BASELINE_COLOR, linewidth=1.0, label=BASELINE_LABEL)
        legend_above(axes)
    (past,) = axes.plot([], [], "-", color=DATA_COLOR)
    (now,) = axes.plot([], [], "o", color=DATA_COLOR, markersize=6, markeredgecolor="white")
    line = axes.axvline(overlay.env_step[0], color="#888888", linewidth=0.8)
    room = 0.03 * float(overlay.env_step[-1] - overlay.env_step[0]) or 2.5
    axes.set_xlim(overlay.env_step[0] - room, overlay.env_step[-1] + room)
    axes.grid(axis="y")
    axes.set_xlabel("environment step")
    axes.set_ylabel(name)
    whole_numbers(axes.xaxis)
    return [past, now, line]


def _move(curve: object, moving: list, overlay: EpisodeOverlay, grouping: Grouping, replan: int) -> None:
    from matplotlib.axes import Axes

    assert isinstance(curve, Axes)
    values, _, _ = shown_ratio(overlay, grouping)
    what = "ratio" if overlay.ratio is not None else "mass"
    step = overlay.env_step[replan]
    curve.set_title(f"step {step}: {what} {format_number(float(values[replan]))}", loc="left")
    if moving:
        past, now, line = moving
        drawable = np.where(np.isfinite(values) & (values > 0), values, np.nan)
        past.set_data(overlay.env_step[: replan + 1], drawable[: replan + 1])
        now.set_data([step], [drawable[replan]])
        line.set_xdata([step, step])
