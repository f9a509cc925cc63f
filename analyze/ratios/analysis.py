"""The whole default analysis: stores in, tables, results files, summary and pictures out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import polars as pl

from vla_attention.analyze.measures.aggregate import add_layers_avg, episodes_table, per_replan, tasks_table
from vla_attention.analyze.measures.contributions import contribution_table, summarise_contributions
from vla_attention.analyze.measures.group_contributions import group_contribution_table, summarise_group_contributions
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.measures.selected import resolve_all
from vla_attention.analyze.measures.steps import steps_table
from vla_attention.analyze.published.frame_proxy import frame_proxy
from vla_attention.analyze.published.results_file import write_results_of_suites
from vla_attention.analyze.ratios.summary import AnalysedRun, summary_text, write_summary
from vla_attention.analyze.show.output_files import write_parquet
from vla_attention.analyze.show.progress import progress_bar
from vla_attention.analyze.stores.selection import Selection, heads_text
from vla_attention.schemas.errors import BadArgument, listing
from vla_attention.schemas.groupings.grouping import Grouping
from vla_attention.schemas.groupings.resolve import ResolvedGrouping
from vla_attention.schemas.stores.store_format import RootAttributes


@dataclass(frozen=True)
class Analysis:
    """The tables of one grouping over one selection of episodes.

    In `vla_attention.analyze.measures` it is described what they hold: `steps` in `tables`; `replans`, `episodes` and `tasks` in `aggregate`.
    Contributions and the summary are computed when they are first asked for: who wants ratios need not wait for them.
    """

    question: Question
    resolved: Sequence[ResolvedGrouping]
    steps: pl.DataFrame
    replans: pl.DataFrame
    episodes: pl.DataFrame
    tasks: pl.DataFrame

    @property
    def grouping(self) -> Grouping:
        """The groups of keys that everything is about."""
        return self.question.grouping

    @cached_property
    def contributions(self) -> pl.DataFrame | None:
        """See `measures.contributions.contribution_table`; None when they were not recorded."""
        return contribution_table(self.question.episodes, self.question.selection)

    @cached_property
    def group_contributions(self) -> pl.DataFrame | None:
        """See `measures.group_contributions.group_contribution_table`; None also when every group cuts a segment."""
        return group_contribution_table(self.question, self.resolved)

    @cached_property
    def summary(self) -> str:
        """Everything as text."""
        question, grouping, seed = self.question, self.grouping, self.question.settings.seed
        parts = [summary_text(_described(question), grouping, self.episodes, self.tasks)]
        if self.contributions is not None:
            parts.append(summarise_contributions(self.contributions, seed))
        if all(store.attributes.recording.contributions for store in question.stores):
            parts.append(summarise_group_contributions(self.group_contributions, grouping, question.site, seed))
        return "\n".join(parts)


@dataclass
class WrittenFiles:
    """Where results went."""

    folder: Path
    files: list[Path] = field(default_factory=list)


def analyse(question: Question) -> Analysis:
    """Compute the tables. Shows progress at a terminal when it takes longer than a moment."""
    grouping = question.grouping
    resolved = resolve_all(grouping, question.selected, question.vocabulary)
    with progress_bar(len(question.selected), "episodes") as advance:
        steps = steps_table(question.selected, grouping, question.selection, question.site, advance, resolved)
    replans = add_layers_avg(per_replan(steps, grouping), grouping)
    episodes = episodes_table(replans, grouping)
    tasks = tasks_table(episodes, grouping, seed=question.settings.seed)
    return Analysis(question, resolved, steps, replans, episodes, tasks)


def _described(question: Question) -> AnalysedRun:
    """What the summary says about where the numbers come from."""
    root = question.stores[0].attributes
    policy = root.policy
    return AnalysedRun(
        stores=[str(store.path) for store in question.stores],
        policy=f"{policy.name} ({policy.checkpoint_format}: {policy.checkpoint})",
        untrained=policy.untrained,
        denoise_steps=question.selection.denoise_steps,
        heads=describe_heads(question.selection, policy.num_heads),
        notes=[*_notes(root, question.selection, question.site), *question.skipped, *question.notes],
    )


def write_tables(analysis: Analysis, folder: Path) -> WrittenFiles:
    """Write the results JSON (when the grouping has a ratio), the tables and the summary; each file appears whole."""
    names = ("steps", "episodes", "tasks", "contributions", "group_contributions")
    tables = {name: table for name in names if (table := getattr(analysis, name)) is not None}
    written = WrittenFiles(folder, write_parquet(folder, **tables))
    try:
        if analysis.grouping.ratio is not None:
            question = analysis.question
            proxy = frame_proxy(question.stores[0].attributes, question.selected[0].tokens.layout, analysis.grouping)
            written.files += write_results_of_suites(folder, analysis.replans, analysis.grouping, proxy)
        write_summary(folder / "summary.txt", analysis.summary)
    except OSError as error:
        raise BadArgument(
            f"Cannot write results to {folder}: {error.strerror or error}; give another --output."
        ) from None
    written.files.append(folder / "summary.txt")
    return written


def _notes(root: RootAttributes, selection: Selection, site: str) -> list[str]:
    notes = [selection.note] if selection.note else []
    others = [other.name for other in root.sites if other.name != site]
    if others:
        notes.append(
            f"Masses of the site '{site}' only; the other sites ({listing(others)}) are softmaxes of their own, and a mass of one "
            "must not be divided by a mass of another. Choose with --site."
        )
    return notes


def describe_heads(selection: Selection, num_heads: int) -> str:
    """What was done about heads, in words."""
    return f"mean over {heads_text(selection, num_heads)}" + (
        " (kept apart in the steps table)" if selection.per_head else ""
    )
