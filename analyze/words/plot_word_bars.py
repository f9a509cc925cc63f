"""`word_bars`: how much every word of the instructions is read, as lift over uniform attention, with intervals."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import polars as pl

from vla_attention.analyze.measures.frames import layer_name
from vla_attention.analyze.show.numbers import interval_name, plural
from vla_attention.analyze.show.plot_axes import BASELINE_LABEL, legend_above, note_at_row, ratio_axis, uniform_line
from vla_attention.analyze.show.plot_colours import BASELINE_COLOR
from vla_attention.analyze.show.plot_style import drawn_in_our_style, new_figure, save_figure
from vla_attention.analyze.show.plot_text import explain, shortened, title
from vla_attention.analyze.statistics.intervals import DEFAULT_LEVEL

if TYPE_CHECKING:
    from matplotlib.axes import Axes

STEM = "word_bars"
#: Content words, stop words, and what stands beside them for scale.
COLORS = {"content": "#0072B2", "stop": "#E69F00", None: "#9A9A9A"}
_LABELS = {"content": "content word", "stop": "stop word", None: "for scale"}
#: Words in the picture; the csv has all.
_MOST = 60


@drawn_in_our_style
def plot_word_bars(
    summary: pl.DataFrame, folder: Path, layer: str, instruction: str | None = None, stem: str = STEM
) -> list[Path]:
    """Draw from `word_study.words_summary`; returns the paths of png, pdf and csv.

    Words are in the summary's order (sorted by lift; with `instruction`, of one task, in reading order). A bar starts
    at 1, the value of uniform attention, on a logarithmic axis: bars of twice and of half as much are equally long.
    """
    words = summary.filter((pl.col("kind") == "word") & pl.col("lift").is_not_null())
    shown = pl.concat([words.head(_MOST), summary.filter((pl.col("kind") == "scale") & pl.col("lift").is_not_null())])
    dense = shown.height > 30
    figure = new_figure(8.4, 1.7 + (0.19 if dense else 0.27) * shown.height)
    heading = f"Words of '{instruction}' in reading order" if instruction else "Words of the instructions, by lift"
    whiskers = interval_name(DEFAULT_LEVEL)
    note = f"Bars: mean over episodes; whiskers: {whiskers}; n counts episodes."
    if words.height > _MOST:
        note += f" The {_MOST} words with the highest lift of {words.height}."
    title(figure, f"{heading}; {layer_name(layer)}", note)
    axes = figure.subplots()
    lifts = shown["lift"].to_numpy() if shown.height else np.zeros(0)
    if not (lifts > 0).any():
        explain(axes, "No word has any mass.")
        return save_figure(figure, folder, stem, summary)
    bounds = shown.select("lift", "lift_low", "lift_high").to_numpy().astype(float).ravel()
    ratio_axis(axes.xaxis, np.append(bounds[bounds > 0], 1.0))
    _draw_bars(axes, shown, words.head(_MOST).height, dense)
    axes.set_xlabel("lift: mass / what uniform attention gives (logarithmic)")
    _legend(axes, shown)
    return save_figure(figure, folder, stem, summary)


def _draw_bars(axes: Axes, shown: pl.DataFrame, num_words: int, dense: bool) -> None:
    left, right = axes.get_xlim()
    positions, labels = [], []
    for i, row in enumerate(shown.iter_rows(named=True)):
        position = i + (0.6 if i >= num_words else 0.0)  # what is for scale stands apart
        positions.append(position)
        pieces = row["pieces"]
        count = f" ({pieces:.0f} pieces)" if row["kind"] == "word" and pieces > 1 and pieces == round(pieces) else ""
        labels.append(shortened(row["item"], 28) + count)
        lift = max(row["lift"], left)
        axes.barh(
            position, lift - 1.0, 0.74, 1.0, color=COLORS[row["word_class"] if row["kind"] == "word" else None],
            edgecolor="none",
        )  # fmt: skip
        if row["lift_low"] is not None and row["lift_high"] is not None:
            low, high = max(row["lift_low"], left), min(row["lift_high"], right)
            axes.plot([low, high], [position, position], color="black", linewidth=0.9, solid_capstyle="butt")
        text = f"n = {row['num_episodes']}" + (
            f" of {plural(row['num_tasks'], 'task')}" if row["num_tasks"] > 1 else ""
        )
        note_at_row(axes, position, text, size=6.5 if dense else 7)
    axes.set_yticks(positions, labels)
    axes.tick_params(axis="y", length=0, labelsize=7 if dense else 8)
    axes.set_ylim(positions[-1] + 0.7, -0.7)
    uniform_line(axes, along="x")
    axes.grid(axis="x")


def _legend(axes: Axes, shown: pl.DataFrame) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    words = shown.filter(pl.col("kind") == "word")["word_class"].unique()
    handles: list[Any] = [
        Patch(color=COLORS[kind], label=_LABELS[kind]) for kind in ("content", "stop") if kind in words
    ]
    if (shown["kind"] == "scale").any():
        handles.append(Patch(color=COLORS[None], label=_LABELS[None]))
    handles.append(Line2D([], [], color=BASELINE_COLOR, linestyle="--", linewidth=1.0, label=BASELINE_LABEL))
    legend_above(axes, 4, handles)
