"""All tables on heads, layers, depth, denoise steps and rows of one question."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.heads.depth import contribution_norms, depth_table
from vla_attention.analyze.heads.head_measures import dispersion_table, episode_heads, heads_tables
from vla_attention.analyze.heads.row_metrics import (
    RowMeasures,
    RowOptions,
    groups_with_valid_keys,
    measure_all_rows,
    row_tables,
)
from vla_attention.analyze.measures.aggregate import (
    episode_tables_of,
    overall_layer,
    overall_rows,
    replan_tables,
    task_tables,
)
from vla_attention.analyze.measures.frames import (
    TableInParts,
    Tables,
    concat_tables,
    episode_id,
    named_parts,
    named_tables,
    tables_of_each,
)
from vla_attention.analyze.measures.not_in_memory import MadeWhenAsked, OnDisk
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.measures.selected import SelectedEpisode, resolve_each
from vla_attention.analyze.measures.sinks import KeyShares, SinkSearch, search_of
from vla_attention.analyze.measures.steps import (
    MeasuredEpisode,
    measure_episode,
    measured_from,
    measured_on_disk,
    row_sums,
    segment_weights,
    with_valid,
)
from vla_attention.analyze.statistics.episode_intervals import Sampling
from vla_attention.analyze.stores.parallel import each_episode
from vla_attention.analyze.stores.selection import Selection
from vla_attention.schemas.groupings.grouping import Grouping
from vla_attention.schemas.groupings.resolve import ResolvedGrouping
from vla_attention.schemas.progress_bar import progress_bar


@dataclass(frozen=True)
class HeadStudy:
    """The result of `study_heads`.

    Attributes:
        question: the question.
        options: how rows were measured; None when they were not read.
        replans: `aggregate.replan_tables`, mean over heads.
        tasks: `aggregate.task_tables`, mean over heads.
        heads: `head_measures.heads_tables`.
        dispersion: `head_measures.dispersion_table`.
        depth: `depth.depth_table`.
        denoise: `denoise.denoise_tables`.
        rows: `row_metrics.row_tables`, or None.
        search: the sinks, or None.
    """

    question: Question
    options: RowOptions | None
    replans: Tables
    tasks: Tables
    heads: Tables
    dispersion: pl.DataFrame
    depth: pl.DataFrame
    denoise: Tables
    rows: Tables | None
    search: SinkSearch | None

    def tables(self) -> dict[str, pl.DataFrame]:
        """The tables of heads, layers and denoise steps by the names of their files."""
        tables = named_tables("heads", self.heads) | {"dispersion": self.dispersion, "depth": self.depth}
        return tables | named_tables("denoise", self.denoise)

    def files(self) -> dict[str, pl.DataFrame | TableInParts]:
        """All tables by the names of their files."""
        files: dict[str, pl.DataFrame | TableInParts] = {**self.tables()}
        if self.rows is not None and self.search is not None:
            files |= named_parts("row_metrics", self.rows)
            files |= {"sinks": self.search.sinks, "sink_heads": self.search.heads}
        return files


def _measure(
    given: tuple[SelectedEpisode, ResolvedGrouping, NDArray[np.float32] | None], apart: Selection, site: str
) -> MeasuredEpisode:
    """Masses of one episode; where they were measured with its rows, those."""
    item, groups, mass = given
    if mass is None:
        return measure_episode(item, groups, apart, site)
    return measured_from(item, groups, apart, mass.astype(np.float64), row_sums(item, apart, site))


def _shares(measures: Sequence[RowMeasures], episode: int) -> KeyShares:
    return measures[episode].shares


def study_heads(question: Question, options: RowOptions | None = None) -> HeadStudy:
    """Measure heads, layers, denoise steps and, with `options`, rows. Rows are read at most once.

    Without `options` rows are only read when a group cuts a stored segment (a word, an object).
    """
    grouping, sampling, selection = question.grouping, question.sampling, question.selection
    resolved = resolve_each(grouping, question.selected, question.vocabulary)
    shown = groups_with_valid_keys(question.selected, resolved)
    measures = None
    if options is not None:
        # Segment masses were stored exactly, rows were rounded: masses of segments are used where they suffice.
        cut = [
            segment_weights(item, with_valid(groups.weights, item.valid), question.site) is None
            for item, groups in zip(question.selected, resolved, strict=True)
        ]
        measures = measure_all_rows(question, resolved, options, shown, with_masses=any(cut))

    known = (
        itertools.repeat(None, len(resolved))
        if measures is None
        else (of_episode.mass if is_cut else None for of_episode, is_cut in zip(measures, cut, strict=True))
    )
    measure = partial(_measure, apart=replace(selection, per_head=True), site=question.site)
    of_heads: OnDisk[Tables] = OnDisk()

    def arrays_over_heads() -> Iterator[dict[str, NDArray[Any]]]:
        given = zip(question.selected, resolved, known, strict=True)
        with progress_bar(len(resolved), "episodes") as advance:
            for measured in each_episode(measure, given, advance):
                of_heads.append(episode_heads(measured, grouping))
                yield measured.over_heads().arrays()

    over_heads = measured_on_disk(question.selected, replace(selection, per_head=False), arrays_over_heads())
    in_order = sorted(range(len(of_heads)), key=lambda i: episode_id(question.selected[i]))
    heads = tables_of_each(in_order, of_heads.__getitem__)
    replans = replan_tables(over_heads, grouping)
    episodes = episode_tables_of(over_heads, grouping)
    tasks = task_tables(episodes, grouping, sampling)
    depth = depth_table(episodes, contribution_norms(question, resolved), sampling)
    del episodes  # what follows makes such tables again
    rows = search = None
    if options is not None and measures is not None:
        rows = row_tables(question.selected, measures, shown, selection, options)
        shares = MadeWhenAsked(partial(_shares, measures), range(len(measures)))
        search = search_of(question, shares, options.rule)
    return HeadStudy(
        question=question,
        options=options,
        replans=replans,
        tasks=tasks,
        heads=heads_tables(heads, grouping, sampling),
        dispersion=dispersion_table(heads, grouping, sampling),
        depth=depth,
        denoise=denoise_tables(over_heads, grouping, sampling),
        rows=rows,
        search=search,
    )


def denoise_tables(measured: Sequence[MeasuredEpisode], grouping: Grouping, sampling: Sampling) -> Tables:
    """Every denoise step: the numbers over all tasks and layers of an analysis in which only this step is selected.

    Returns:
        `denoise_step`, `denoise_time` (mean over episodes) and the columns of `aggregate.task_tables`, in the order of
        the steps.
    """
    selection = measured[0].selection
    parts = []
    for position in np.argsort(selection.denoise_steps, kind="stable").tolist():
        of_step = MadeWhenAsked(partial(_at_denoise, measured, position), range(len(measured)))
        episodes = episode_tables_of(of_step, grouping)
        layer = overall_layer(episodes.cells)
        whole = overall_rows(task_tables(episodes.filter(pl.col("layer") == layer), grouping, sampling))
        times = [one.item.episode.read("denoise_time")[selection.denoise[position]] for one in measured]
        time = pl.lit(float(np.mean(times)), dtype=pl.Float64).alias("denoise_time")
        number = pl.lit(selection.denoise_steps[position], dtype=pl.Int64).alias("denoise_step")
        cells, groups = (table.select(number, time, pl.all()) for table in (whole.cells, whole.groups))
        parts.append(Tables(cells, groups))
    return concat_tables(parts)


def _at_denoise(measured: Sequence[MeasuredEpisode], position: int, episode: int) -> MeasuredEpisode:
    return measured[episode].at_denoise(position)
