"""`overlay_EPISODE`: attention on the pictures at some replans of an episode, a row per camera, with one scale."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from vla_attention.analyze.overlay.colours import Measure, Scale, color_bar, outline_color
from vla_attention.analyze.overlay.overlay_data import EpisodeOverlay, draw, orientation_note
from vla_attention.analyze.overlay.overlay_study import OverlayStudy
from vla_attention.analyze.show.numbers import format_number, outcome_word
from vla_attention.analyze.show.plot_axes import BASELINE_LABEL, hide_frame
from vla_attention.analyze.show.plot_colours import NOTE_COLOR
from vla_attention.analyze.show.plot_style import drawn_in_our_style, new_figure, save_figure
from vla_attention.analyze.show.plot_text import title, wrapped
from vla_attention.schemas.groupings.grouping import Grouping

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: More replans than this go into a further block of rows.
_COLUMNS = 8
_SIDE = 1.55


@drawn_in_our_style
def plot_overlay_strip(
    study: OverlayStudy, folder: Path, *, measure: Measure = "lift", smooth: bool = False
) -> list[Path]:
    """Draw the replans side by side and the cameras below each other; returns the paths of png, pdf and csv.

    All pictures share one scale (`colours.scale_for`). Above each replan stand its environment step and the grouping's
    ratio.
    """
    overlay, grouping, replans = study.overlay, study.question.grouping, study.replans
    attributes = overlay.item.episode.attributes
    values, scale = overlay.values(measure), overlay.scale(measure, replans)
    blocks = [replans[i : i + _COLUMNS] for i in range(0, len(replans), _COLUMNS)]
    columns, cameras = len(blocks[0]), list(overlay.maps)
    # Room for the title and the scale even beside a single picture.
    width = max(6.4, 0.35 + columns * _SIDE)
    side = _SIDE if columns > 3 else 2.1
    figure = new_figure(width, 1.55 + len(blocks) * (0.42 + len(cameras) * side))
    outcome = outcome_word(attributes.success)
    named = ", ".join(map(str, replans))
    if len(replans) > 12:
        named = f"{replans[0]} to {replans[-1]}, {len(replans)} of them,"
    shown = f"replan{'s' if len(replans) > 1 else ''} {named} of {overlay.num_replans}"
    note = f"{'; '.join(part for part in (outcome, shown, study.averaged_over) if part)}. {orientation_note(overlay)}"
    title(figure, episode_heading(overlay), note)
    bar_height = 0.24 / side
    grid = figure.add_gridspec(
        len(blocks) * len(cameras) + 1, columns, height_ratios=[*[1.0] * (len(blocks) * len(cameras)), bar_height]
    )
    for b, block in enumerate(blocks):
        for r, camera in enumerate(cameras):
            for c, replan in enumerate(block):
                axes = figure.add_subplot(grid[b * len(cameras) + r, c])
                axes.imshow(draw(overlay, camera, replan, scale, values, smooth), interpolation="nearest")
                axes.set_xticks([])
                axes.set_yticks([])
                hide_frame(axes)
                if c == 0:
                    axes.set_ylabel(wrapped(camera, 22, 2), size=8)
                if r == 0:
                    axes.set_title(_above(overlay, grouping, replan), size=8)
    _draw_bar(figure.add_subplot(grid[-1, :]), scale, list(overlay.outlines))
    return save_figure(figure, folder, study.stem, study.table)


def episode_heading(overlay: EpisodeOverlay) -> str:
    """Suite, task, episode and instruction, for a title."""
    suite, episode = overlay.item.store.suite, overlay.item.episode.attributes
    return f"{suite} task {episode.task_id}, episode {episode.episode_index}: {episode.instruction}"


def _above(overlay: EpisodeOverlay, grouping: Grouping, replan: int) -> str:
    """Title of a replan: its step, and its ratio."""
    step = f"step {overlay.env_step[replan]}"
    if overlay.ratio is None or grouping.ratio is None:
        return step
    return f"{step}\nratio {format_number(float(overlay.ratio[replan]))}"


def draw_scale(axes: Axes, scale: Scale) -> None:
    """A colour bar across the axes, with the value of uniform attention marked."""
    axes.imshow(color_bar(scale), extent=(0.0, scale.high, 0.0, 1.0), aspect="auto", interpolation="bilinear")
    axes.set_yticks([])
    axes.set_xlim(0, scale.high)
    axes.set_xlabel(f"{scale.label}; {scale.high:g} and more have the last colour", size=8)
    if scale.uniform is not None:
        axes.axvline(scale.uniform, color="white", linewidth=1.6)
        axes.axvline(scale.uniform, color="black", linewidth=0.9, linestyle="--")
        axes.annotate(
            BASELINE_LABEL,
            (scale.uniform, 1.0),
            xytext=(2, 2),
            textcoords="offset points",
            size=7,
            color=NOTE_COLOR,
        )
    hide_frame(axes)


def _draw_bar(axes: Axes, scale: Scale, groups: Sequence[str]) -> None:
    draw_scale(axes, scale)
    if groups:
        from matplotlib.patches import Rectangle

        handles = [
            Rectangle((0, 0), 1, 1, facecolor="#808080", edgecolor=rgb(outline_color(i)), linewidth=2)
            for i in range(len(groups))
        ]
        labels = [wrapped(f"outlined: {name}", 40, 1) for name in groups]
        axes.legend(handles, labels, loc="lower right", bbox_to_anchor=(1.0, 0.95), ncols=4, borderaxespad=0.1)


def rgb(color: tuple[int, int, int]) -> tuple[float, float, float]:
    """A colour of 0..255 in matplotlib's range, 0..1."""
    return (color[0] / 255, color[1] / 255, color[2] / 255)
