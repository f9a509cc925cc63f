"""Frames of an episode's video: the cameras with attention on them, and the ratio's curve running beside them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from vla_attention.analyze.overlay.colours import Measure, Scale
from vla_attention.analyze.overlay.overlay_data import EpisodeOverlay, draw, orientation_note
from vla_attention.analyze.overlay.overlay_study import OverlayStudy
from vla_attention.analyze.overlay.plot_strip import draw_scale, episode_heading
from vla_attention.analyze.overlay.video import VideoFormat, write_video
from vla_attention.analyze.show.numbers import format_number, outcome_word
from vla_attention.analyze.show.plot_axes import BASELINE_LABEL, legend_above, ratio_axis, whole_numbers
from vla_attention.analyze.show.plot_colours import BASELINE_COLOR, DATA_COLOR
from vla_attention.analyze.show.plot_style import drawn_in_our_style, new_figure
from vla_attention.analyze.show.plot_text import explain, ratio_name, title, wrapped
from vla_attention.schemas.groupings.grouping import Grouping
from vla_attention.schemas.progress_bar import progress_bar

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.image import AxesImage
    from matplotlib.lines import Line2D

_DPI = 100
#: The whole curve behind the part that the video has reached, and the line at the present step.
_FUTURE_COLOR, _NOW_COLOR = "#C8C8C8", "#888888"
_SIDE, _CURVE = 2.7, 3.9


def write_overlay_video(
    study: OverlayStudy,
    path: Path,
    fps: float,
    *,
    measure: Measure = "lift",
    smooth: bool = False,
) -> Path:
    """Write the whole episode as GIF or MP4 (by the ending of `path`), `fps` replans a second; shows progress."""
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
    values, scale = overlay.values(measure), overlay.scale(measure, range(overlay.num_replans))

    def pictures(replan: int) -> list[NDArray[np.uint8]]:
        return [draw(overlay, camera, replan, scale, values, smooth) for camera in overlay.maps]

    stage = _set_up(overlay, grouping, scale, pictures(0))
    stage.canvas.figure.set_dpi(_DPI)
    for replan in range(overlay.num_replans):
        yield _frame(stage, overlay, replan, pictures(replan))


@dataclass(frozen=True)
class _Curve:
    """The curve beside the pictures: `values` (replan,), and the parts that move; None where there is no curve."""

    axes: Axes
    values: NDArray[np.float64]
    moving: tuple[Line2D, Line2D, Line2D] | None


@dataclass(frozen=True)
class _Stage:
    """The figure of which every frame is a state."""

    canvas: FigureCanvasAgg
    images: Sequence[AxesImage]
    curve: _Curve


@drawn_in_our_style
def _set_up(overlay: EpisodeOverlay, grouping: Grouping, scale: Scale, pictures: Sequence[NDArray[np.uint8]]) -> _Stage:
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    cameras, attributes = list(overlay.maps), overlay.item.episode.attributes
    figure = new_figure(max(7.0, len(cameras) * _SIDE + _CURVE), _SIDE + 1.6)
    outcome = outcome_word(attributes.success)
    title(figure, episode_heading(overlay), f"{outcome}; a picture per replan. {orientation_note(overlay)}")
    ratios = [*[1.0] * len(cameras), _CURVE / _SIDE]
    grid = figure.add_gridspec(2, len(cameras) + 1, width_ratios=ratios, height_ratios=[1.0, 0.06])
    images = []
    for i, (camera, picture) in enumerate(zip(cameras, pictures, strict=True)):
        axes = figure.add_subplot(grid[0, i])
        images.append(axes.imshow(picture, interpolation="nearest"))
        axes.set_axis_off()
        axes.set_title(wrapped(camera, 34, 1), size=8)
    draw_scale(figure.add_subplot(grid[1, : len(cameras)]), scale)
    curve = _draw_curve(figure.add_subplot(grid[:, -1]), overlay, grouping)
    canvas = figure.canvas
    assert isinstance(canvas, FigureCanvasAgg)
    return _Stage(canvas, images, curve)


@drawn_in_our_style
def _frame(
    stage: _Stage, overlay: EpisodeOverlay, replan: int, pictures: Sequence[NDArray[np.uint8]]
) -> NDArray[np.uint8]:
    for image, picture in zip(stage.images, pictures, strict=True):
        image.set_data(picture)
    _move(stage.curve, overlay, replan)
    stage.canvas.draw()  # type: ignore[no-untyped-call]
    return np.asarray(stage.canvas.buffer_rgba())[..., :3].copy()  # type: ignore[no-untyped-call]


def _draw_curve(axes: Axes, overlay: EpisodeOverlay, grouping: Grouping) -> _Curve:
    values, uniform, name = _shown_ratio(overlay, grouping)
    drawable = np.isfinite(values) & (values > 0)
    if not drawable.any():
        explain(
            axes,
            f"No finite ratio: {int(np.isinf(values).sum())} of {len(values)} are infinite, the others undefined or 0.",
        )
        return _Curve(axes, values, None)
    if overlay.ratio is not None:
        ratio_axis(axes.yaxis, values if uniform is None else np.concatenate([values, uniform]))
    else:
        axes.set_ylim(0, 1.1 * float(values[drawable].max()))
    steps = overlay.env_step
    axes.plot(steps, np.where(drawable, values, np.nan), color=_FUTURE_COLOR, linewidth=1.2)
    if uniform is not None and np.isfinite(uniform).any():
        axes.plot(steps, uniform, "--", color=BASELINE_COLOR, linewidth=1.0, label=BASELINE_LABEL)
        legend_above(axes)
    (past,) = axes.plot([], [], "-", color=DATA_COLOR)
    (now,) = axes.plot([], [], "o", color=DATA_COLOR, markersize=6, markeredgecolor="white")
    line = axes.axvline(steps[0], color=_NOW_COLOR, linewidth=0.8)
    room = 0.03 * float(steps[-1] - steps[0]) or 2.5
    axes.set_xlim(steps[0] - room, steps[-1] + room)
    axes.grid(axis="y")
    axes.set_xlabel("environment step")
    axes.set_ylabel(name)
    whole_numbers(axes.xaxis)
    return _Curve(axes, values, (past, now, line))


def _move(curve: _Curve, overlay: EpisodeOverlay, replan: int) -> None:
    what = "ratio" if overlay.ratio is not None else "mass"
    step, value = overlay.env_step[replan], float(curve.values[replan])
    curve.axes.set_title(f"step {step}: {what} {format_number(value)}", loc="left")
    if curve.moving is not None:
        past, now, line = curve.moving
        drawable = np.where(np.isfinite(curve.values) & (curve.values > 0), curve.values, np.nan)
        past.set_data(overlay.env_step[: replan + 1], drawable[: replan + 1])
        now.set_data([step], [drawable[replan]])
        line.set_xdata([step, step])


def _shown_ratio(
    overlay: EpisodeOverlay, grouping: Grouping
) -> tuple[NDArray[np.float64], NDArray[np.float64] | None, str]:
    """Values of the curve, uniform baseline and name: of the ratio, or without one of the mass of all image keys."""
    if overlay.ratio is None or grouping.ratio is None:
        return overlay.image_mass, None, "mass of all image keys"
    return overlay.ratio, overlay.uniform_ratio, f"{ratio_name(grouping.ratio)} (log axis)"
