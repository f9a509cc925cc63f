"""The pictures that `vla-attention ratios` draws by default, and those of single episodes (`--save-viz`)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import polars as pl

from vla_attention.analyze.measures.frames import Tables
from vla_attention.analyze.ratios.plot_attention_fractions import plot_attention_fractions
from vla_attention.analyze.ratios.plot_layer_profile import plot_layer_profile
from vla_attention.analyze.ratios.plot_ratio_distribution import COLUMNS, plot_ratio_distribution
from vla_attention.analyze.ratios.plot_ratio_evolution import plot_all_evolutions
from vla_attention.analyze.ratios.plot_ratio_per_task import plot_ratio_per_task
from vla_attention.analyze.show.picture_formats import picture_formats, pictures_saved_as
from vla_attention.schemas.groupings.grouping import Grouping
from vla_attention.schemas.progress_bar import progress_bar

if TYPE_CHECKING:
    from vla_attention.analyze.ratios.analysis import Analysis

#: Folder for the pictures of single episodes: there can be hundreds.
EPISODES_FOLDER = "episodes"


@dataclass(frozen=True)
class PlottedTables:
    """What the pictures by default show; another process can be given it.

    Attributes:
        grouping: the groups, and the ratio.
        replans: ratios of the replans (the cells of `aggregate.replan_tables`); None for a grouping without a ratio.
        episodes: the cells of `aggregate.episode_tables`.
        tasks: `aggregate.task_tables`.
        note: a sentence about all numbers.
        about: the note, and what the intervals over tasks are about.
        formats: see `picture_formats`.
    """

    grouping: Grouping
    replans: pl.DataFrame | None
    episodes: pl.DataFrame
    tasks: Tables
    note: str
    about: str
    formats: Sequence[str]

    @classmethod
    def of(cls, analysis: Analysis) -> PlottedTables:
        """The tables of an analysis."""
        note = f"Mean over {analysis.denoise}."
        if analysis.question.untrained:
            note += " UNTRAINED weights."
        replans = None
        if analysis.grouping.ratio is not None:
            replans = pl.concat([part.cells.select(COLUMNS) for part in analysis.replans.parts])
        return cls(
            grouping=analysis.grouping,
            replans=replans,
            episodes=analysis.episodes.cells,
            tasks=analysis.tasks.kept(),
            note=note,
            about=f"{note} Intervals over tasks: about {analysis.question.units.words}.",
            formats=picture_formats(),
        )


def write_plots(tables: PlottedTables, folder: Path) -> list[Path]:
    """Draw the pictures of an analysis into `folder`, each with its data as CSV; returns the paths.

    Pictures of ratios are drawn when the grouping has one.
    """
    grouping, note, about = tables.grouping, tables.note, tables.about
    with pictures_saved_as(tables.formats):
        written = plot_attention_fractions(tables.tasks, grouping, folder, note=note)
        if tables.replans is not None:
            written += plot_ratio_distribution(tables.replans, grouping, folder, note=note)
            written += plot_ratio_per_task(tables.episodes, tables.tasks.cells, grouping, folder, note=about)
        return written + plot_layer_profile(tables.tasks, grouping, folder, note=about)


def write_plots_of_episodes(analysis: Analysis, folder: Path) -> list[Path]:
    """Draw a picture per episode and layer."""
    with progress_bar(analysis.episodes.cells.height, "pictures") as advance:
        return plot_all_evolutions(analysis.replans, analysis.grouping, folder / EPISODES_FOLDER, progress=advance)
