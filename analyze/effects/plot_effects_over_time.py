"""`effects_over_time`: how much the action changes without pictures, text and the items that matter most, over time."""

from __future__ import annotations

from pathlib import Path

from vla_attention.analyze.effects.over_time import NOISE, EffectsOverTime
from vla_attention.analyze.measures.frames import float_values
from vla_attention.analyze.show.numbers import interval_name, of_tasks
from vla_attention.analyze.show.plot_axes import legend_beside
from vla_attention.analyze.show.plot_colours import LINE_OF_HATCH, NOTE_COLOR, group_styles
from vla_attention.analyze.show.plot_style import drawn_in_our_style, new_figure, save_figure
from vla_attention.analyze.show.plot_text import shortened, title
from vla_attention.analyze.statistics.intervals import DEFAULT_LEVEL

STEM = "effects_over_time"
#: Bands are cut at so many times the largest mean.
_MOST_REACH = 1.5


@drawn_in_our_style
def plot_effects_over_time(effects: EffectsOverTime, folder: Path) -> list[Path]:
    """Draw every item and the noise; returns the paths of png, pdf and csv."""
    figure, course = new_figure(8.5, 4.6), effects.course
    few = " No band where there can be none (one episode, no spread)." if course["effect_low"].null_count() else ""
    note = f"{of_tasks(*effects.study.measured)}. Bands: pointwise {interval_name(DEFAULT_LEVEL)}s.{few}"
    title(figure, "What the action depends on, over the course of an episode", note)
    axes = figure.subplots()
    names = course["item"].unique(maintain_order=True).to_list()
    styles = group_styles([name for name in names if name != NOISE])
    for name in names:
        part = course.filter(item=name).sort("position")
        color, dash = NOTE_COLOR, ":"
        if name != NOISE:
            color, dash = styles[name]["color"], LINE_OF_HATCH[styles[name]["hatch"]]
        episodes = int(part["num_episodes"].max() or 0)  # type: ignore[arg-type]
        label = name if name == NOISE else f"without {shortened(name, 20)}"
        where = part["position"].to_numpy()
        axes.fill_between(
            where, float_values(part["effect_low"]), float_values(part["effect_high"]), color=color, alpha=0.15, lw=0
        )
        axes.plot(where, float_values(part["effect"]), dash, color=color, label=f"{label} (n = {episodes})")
    axes.set_xlim(0, 1)
    # A band over few tasks may be as long as it likes; the table has its ends.
    axes.set_ylim(0, _MOST_REACH * max(float(float_values(course["effect"]).max()), 0.01))
    axes.set_xlabel("episode time (0 = first replan, 1 = end)")
    axes.set_ylabel("change of the action, in its spread")
    axes.grid(axis="y")
    legend_beside(axes)
    return save_figure(figure, folder, STEM, course)
