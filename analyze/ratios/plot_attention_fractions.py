"""`attention_fractions`: mean fraction of every group, stacked, per layer and over all layers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl

from vla_attention.analyze.measures.aggregate import FRACTION_COLUMNS, layer_order, overall_layer, overall_rows
from vla_attention.analyze.measures.frames import LAYERS_AVG, Tables
from vla_attention.analyze.show.numbers import of_tasks
from vla_attention.analyze.show.plot_axes import legend_beside, share_ticks
from vla_attention.analyze.show.plot_colours import group_styles
from vla_attention.analyze.show.plot_style import drawn_in_our_style, new_figure, save_figure
from vla_attention.analyze.show.plot_text import named, title, wrapped
from vla_attention.schemas.groupings.grouping import Grouping

STEM = "attention_fractions"


@drawn_in_our_style
def plot_attention_fractions(
    tasks: Tables,
    grouping: Grouping,
    folder: Path,
    *,
    stem: str = STEM,
    about: str | None = None,
    note: str = "",
) -> list[Path]:
    """Draw the rows over all tasks; returns the paths of png, pdf and csv.

    Fractions are means over episodes; they sum to 1 also where groups overlap, because each is a share of the summed
    masses.

    Args:
        tasks: `aggregate.task_tables`.
        grouping: its groups and ratio.
        folder: where the files go.
        stem: name of the files, without ending.
        about: what the title names as the source; the grouping unless given.
        note: a sentence to add below the title.
    """
    level = overall_rows(tasks)
    rows, of_group, with_keys = level.cells, level.by_group("layer"), level.groups_with_keys()
    layers = layer_order(rows)
    if len(layers) == 2 and LAYERS_AVG in layers:
        layers.remove(LAYERS_AVG)
    by_layer = {row["layer"]: row for row in rows.iter_rows(named=True)}
    fractions = np.array([[of_group[layer, name]["fraction"] or 0.0 for name in grouping.names] for layer in layers])
    positions = np.arange(len(layers), dtype=float)
    if layers[-1] == LAYERS_AVG:
        positions[-1] += 0.6  # apart from the single layers
    figure = new_figure(max(6.2, 3.4 + 0.42 * len(layers)), 4.6)
    overall = by_layer[overall_layer(rows)]
    counts = f"n = {of_tasks(overall['num_episodes'], overall['num_tasks'])}, means over episodes."
    if grouping.overlap:
        counts += " Groups overlap: a fraction is the share in the sum of all groups' masses."
    title(figure, f"Attention fractions, {about or named(grouping)}", f"{counts} {note}")
    axes = figure.subplots()
    styles = group_styles(grouping.names)
    plain = {"edgecolor": "none", "pad": 1.0}  # below a number on a hatched bar
    bottom = np.zeros(len(layers))
    for i, name in enumerate(grouping.names):
        if name not in with_keys:
            continue  # no key at all, like state digits in a prompt without state
        style = styles[name]
        empty = not fractions[:, i].any()
        label = wrapped(name, 28, 1) + (" (0)" if empty else "")
        axes.bar(
            positions, fractions[:, i], 0.8, bottom, color=style["color"], hatch=style["hatch"], edgecolor="white",
            linewidth=0.4, label=label,
        )  # fmt: skip
        for position, start, share in zip(positions, bottom, fractions[:, i], strict=True):
            # A number only where its piece of the bar is high enough.
            if share >= 0.045:
                axes.text(
                    position, start + share / 2, f"{100 * share:.0f}", ha="center", va="center", size=7,
                    color=_ink(style["color"]), bbox={"facecolor": style["color"], **plain} if style["hatch"] else None,
                )  # fmt: skip
        bottom += fractions[:, i]
    if not fractions.any():
        axes.text(0.5, 0.5, "no group has any mass", transform=axes.transAxes, ha="center")
    axes.set_xticks(positions, layers)
    axes.set_xlim(positions[0] - (0.6 if len(layers) > 1 else 1.2), positions[-1] + (0.6 if len(layers) > 1 else 1.2))
    axes.set_ylim(0, 1)
    share_ticks(axes.yaxis, 6)
    axes.set_xlabel("layer")
    axes.set_ylabel("fraction of the groups' summed mass")
    handles, labels = axes.get_legend_handles_labels()
    # In the order of the stack, top to bottom.
    legend_beside(axes, handles=handles[::-1], labels=labels[::-1])
    drawn = rows.filter(pl.col("layer").is_in(layers)).select("layer", "block", "num_episodes")
    data = drawn.join(level.groups.select("layer", "group", *FRACTION_COLUMNS), on="layer", maintain_order="left_right")
    return save_figure(figure, folder, stem, data)


def _ink(color: str) -> str:
    """Black or white, whichever is easier to read on a colour (relative luminance)."""
    red, green, blue = (int(color[i : i + 2], 16) / 255 for i in (1, 3, 5))
    return "white" if 0.299 * red + 0.587 * green + 0.114 * blue < 0.55 else "black"
