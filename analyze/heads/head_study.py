"""Everything about heads, layers and denoise steps of one question, and the tables alone for those who want one of them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import polars as pl
import polars.selectors as cs
from numpy.typing import NDArray

from vla_attention.analyze.heads.denoise import denoise_table
from vla_attention.analyze.heads.depth import contribution_norms, depth_table
from vla_attention.analyze.heads.head_measures import dispersion_table, head_frame, head_values, heads_table
from vla_attention.analyze.heads.row_metrics import RowOptions, groups_with_valid_keys, measure_all_rows, row_table
from vla_attention.analyze.measures.aggregate import add_layers_avg, episodes_table, per_replan, tasks_table
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.measures.selected import SelectedEpisode, resolve_all
from vla_attention.analyze.measures.sinks import key_shares_table, sinks_of
from vla_attention.analyze.measures.steps import episode_masses, episode_steps, row_sums, segment_weights, with_valid
from vla_attention.analyze.show.progress import progress_bar
from vla_attention.analyze.stores.parallel import map_episodes
from vla_attention.schemas.groupings.resolve import ResolvedGrouping

#: Columns of the steps table that follow from the masses: all that comes after begins with masses again.
_DERIVED = ("_fraction", "_density", "_lift", "log2_ratio")


@dataclass(frozen=True)
class HeadStudy:
    """What `study_heads` finds.

    Attributes:
        question: what was asked.
        options: how rows were measured; None when they were not read.
        replans: `aggregate.add_layers_avg`, mean over heads.
        tasks: `aggregate.tasks_table`, mean over heads.
        heads: `heads.heads_table`.
        dispersion: `heads.dispersion_table`.
        depth: `depth.depth_table`.
        denoise: `denoise.denoise_table`.
        rows: `row_metrics.row_frame` of all episodes, or None.
        key_shares: `sinks.key_shares_table`, or None.
        sinks: `sinks.sinks_of`, or None.
    """

    question: Question
    options: RowOptions | None
    replans: pl.DataFrame
    tasks: pl.DataFrame
    heads: pl.DataFrame
    dispersion: pl.DataFrame
    depth: pl.DataFrame
    denoise: pl.DataFrame
    rows: pl.DataFrame | None
    key_shares: pl.DataFrame | None
    sinks: pl.DataFrame | None


def study_heads(question: Question, options: RowOptions | None = None) -> HeadStudy:
    """Measure heads, layers, denoise steps and, with `options`, rows. Rows are read at most once.

    Without `options` they are only read when a group cuts through a stored segment (a word, an object).
    """
    grouping, seed, selection = question.grouping, question.settings.seed, question.selection
    resolved = resolve_all(grouping, question.selected, question.vocabulary)
    shown = groups_with_valid_keys(question.selected, resolved)
    measures = None
    if options is not None:
        # Stored segment masses are those of the rows as computed; rows are rounded. So the former, wherever they suffice.
        cut = [
            segment_weights(item, with_valid(groups.weights, item.valid), question.site) is None
            for item, groups in zip(question.selected, resolved, strict=True)
        ]
        measures = measure_all_rows(question, resolved, options, shown, with_masses=any(cut))

    def measure(i: int) -> tuple[pl.DataFrame, pl.DataFrame]:
        mass = measures[i].mass if measures is not None and cut[i] else None
        return _steps_and_heads(question, question.selected[i], resolved[i], mass)

    with progress_bar(len(resolved), "episodes") as advance:
        parts = map_episodes(measure, range(len(resolved)), advance)
    steps, episode_heads = (pl.concat([part[i] for part in parts]) for i in range(2))
    # The largest tables one after the other: this one before that of the rows is made.
    denoise = denoise_table(steps, grouping, seed)
    replans = add_layers_avg(per_replan(steps, grouping), grouping)
    del steps, parts
    episodes = episodes_table(replans, grouping)
    rows = key_shares = sinks = None
    if options is not None and measures is not None:
        rows = row_table(question.selected, measures, shown, selection, options)
        key_shares = key_shares_table(question, [measured.shares for measured in measures])
        sinks = sinks_of(key_shares, options.rule)
    return HeadStudy(
        question=question,
        options=options,
        replans=replans,
        tasks=tasks_table(episodes, grouping, seed=seed),
        heads=heads_table(episode_heads, grouping, seed),
        dispersion=dispersion_table(episode_heads, grouping, seed),
        depth=depth_table(episodes, grouping, contribution_norms(question, resolved), seed),
        denoise=denoise,
        rows=rows,
        key_shares=key_shares,
        sinks=sinks,
    )


def _steps_and_heads(
    question: Question, item: SelectedEpisode, resolved: ResolvedGrouping, measured: NDArray[np.float32] | None
) -> tuple[pl.DataFrame, pl.DataFrame]:
    """One episode's parts of the steps table (mean over heads) and of the table of heads, from masses that are there or are read."""
    apart, together = replace(question.selection, per_head=True), replace(question.selection, per_head=False)
    if measured is None:
        mass, row_sum = episode_masses(item, resolved, apart, question.site)
    else:
        mass, row_sum = measured.astype(np.float64), row_sums(item, apart, question.site)
    over_heads = mass.mean(axis=3, keepdims=True), row_sum.mean(axis=3, keepdims=True)
    steps = episode_steps(item, resolved, question.grouping, together, *over_heads)
    values = head_values(mass.mean(axis=2), resolved.num_keys, resolved.num_valid, question.grouping)
    return steps.drop(cs.ends_with(*_DERIVED)), head_frame(item, apart, values)
