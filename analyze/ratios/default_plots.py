"""The pictures that `vla-analyze ratios` draws by default, and those of single episodes (`--save-viz`)."""

from __future__ import annotations

from pathlib import Path

from vla_attention.analyze.ratios.analysis import Analysis
from vla_attention.analyze.ratios.plot_attention_fractions import plot_attention_fractions
from vla_attention.analyze.ratios.plot_layer_profile import plot_layer_profile
from vla_attention.analyze.ratios.plot_ratio_distribution import plot_ratio_distribution
from vla_attention.analyze.ratios.plot_ratio_evolution import plot_all_evolutions
from vla_attention.analyze.ratios.plot_ratio_per_task import plot_ratio_per_task
from vla_attention.analyze.show.progress import progress_bar

#: Folder for the pictures of single episodes: there can be hundreds.
EPISODES_FOLDER = "episodes"


def write_plots(analysis: Analysis, folder: Path, every_episode: bool) -> list[Path]:
    """Draw all pictures of an analysis into `folder`, each with its data as CSV; returns the paths.

    Pictures of ratios are drawn when the grouping has one; `every_episode` adds one per episode and layer.
    """
    grouping, note = analysis.grouping, f"Mean over {analysis.denoise}."
    if analysis.question.untrained:
        note += " UNTRAINED weights."
    about = f"{note} Intervals over tasks: about {analysis.question.settings.intervals.words}."
    written = plot_attention_fractions(analysis.tasks, grouping, folder, note=note)
    if grouping.ratio is not None:
        written += plot_ratio_distribution(analysis.replans.cells, grouping, folder, note=note)
        written += plot_ratio_per_task(analysis.episodes.cells, analysis.tasks.cells, grouping, folder, note=about)
    written += plot_layer_profile(analysis.tasks, grouping, folder, note=about)
    if every_episode:
        pictures = analysis.episodes.cells.height
        with progress_bar(pictures, "pictures") as advance:
            written += plot_all_evolutions(analysis.replans, grouping, folder / EPISODES_FOLDER, progress=advance)
    return written
