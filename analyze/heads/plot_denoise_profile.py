"""`denoise_profile`: ratio and fractions at every recorded denoise step, with intervals and the uniform baseline."""

from __future__ import annotations

from pathlib import Path

import polars as pl

from vla_attention.analyze.measures.aggregate import FRACTION_COLUMNS
from vla_attention.analyze.measures.frames import Tables
from vla_attention.analyze.ratios.plot_profile_panels import draw_profile, shown_groups
from vla_attention.analyze.show.numbers import of_tasks
from vla_attention.analyze.show.plot_style import drawn_in_our_style, new_figure, save_figure
from vla_attention.analyze.show.plot_text import named, title
from vla_attention.analyze.statistics.intervals import DEFAULT_LEVEL
from vla_attention.schemas.groupings.grouping import Grouping

STEM = "denoise_profile"


@drawn_in_our_style
def plot_denoise_profile(denoise: Tables, grouping: Grouping, folder: Path) -> list[Path]:
    """Draw from `denoise.denoise_tables`; returns the paths of png, pdf and csv."""
    table = denoise.cells
    figure = new_figure(max(6.6, 3.6 + 0.45 * table.height), 3.2 if grouping.ratio is None else 5.1)
    note = f"Means over {of_tasks(table['num_episodes'][0], table['num_tasks'][0])} and over all layers."
    if table.height == 1:
        note += " One denoise step was recorded or selected: there is no course to see."
    if grouping.ratio is not None and table["nonfinite_layers"].sum():
        note += f" {table['nonfinite_layers'].sum()} ratios of single layers are not finite and in no mean."
    title(figure, f"Denoise steps, {named(grouping)}", note)
    labels = [f"{step}\n({time:.3g})" for step, time in table.select("denoise_step", "denoise_time").iter_rows()]
    draw_profile(
        figure, denoise, grouping, labels, "denoise step (in brackets its time, which ends at 0)", DEFAULT_LEVEL
    )
    columns = ["denoise_step", "denoise_time", "num_episodes", "num_replans"]
    if grouping.ratio is not None:
        columns += ["geometric_mean", "geometric_mean_low", "geometric_mean_high", "uniform_ratio", "num_nonfinite"]
    groups = denoise.groups.filter(pl.col("group").is_in(shown_groups(denoise, grouping)))
    data = {"": table.select(columns), "_groups": groups.select("denoise_step", "group", *FRACTION_COLUMNS)}
    return save_figure(figure, folder, STEM, data)
