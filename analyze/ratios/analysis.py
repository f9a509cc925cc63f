"""The analysis of `vla-attention ratios`: the tables of one question, the summary, and the files with both."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import polars as pl

from vla_attention.analyze.measures.aggregate import (
    episode_tables_of,
    overall_layer,
    overall_rows,
    replan_tables,
    task_tables,
)
from vla_attention.analyze.measures.contribution_ratios import contribution_rows
from vla_attention.analyze.measures.contributions import contribution_table
from vla_attention.analyze.measures.frames import (
    TableInParts,
    Tables,
    cells_in_parts,
    groups_in_parts,
    layer_name,
    named_parts,
    named_tables,
)
from vla_attention.analyze.measures.group_contributions import group_contribution_tables, have_ratio
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.measures.selected import resolve_all
from vla_attention.analyze.measures.sinks import SinkRule, search_sinks
from vla_attention.analyze.measures.sinks import without_sinks as question_without_sinks
from vla_attention.analyze.measures.steps import MeasuredEpisode, measure_episodes, step_tables
from vla_attention.analyze.published.results_writer import frame_proxy, write_results_of_suites
from vla_attention.analyze.ratios.answer import (
    HEADLINE_NAME,
    Headline,
    conclusion,
    headline_of,
    ratio_sentence,
    run_sentence,
)
from vla_attention.analyze.ratios.contribution_text import (
    contribution_sections,
    group_contribution_sections,
    same_sides,
)
from vla_attention.analyze.ratios.summary_text import AnalysedRun, ratio_definition, summary_sections
from vla_attention.analyze.show.answer import text_of
from vla_attention.analyze.show.numbers import solved_text
from vla_attention.analyze.show.output_files import write_parquet, write_text, writing
from vla_attention.analyze.show.plot_text import shortened
from vla_attention.analyze.stores.selection import Selection, denoise_text, heads_text
from vla_attention.schemas.errors import listing
from vla_attention.schemas.groupings.grouping import Grouping
from vla_attention.schemas.groupings.resolve import ResolvedGrouping
from vla_attention.schemas.stores.store_format import RootAttributes


@dataclass(frozen=True)
class Analysis:
    """The tables of one grouping over one selection of episodes, as pairs of cells and groups (`frames.Tables`).

    `step_tables` and the functions of `measures.aggregate` list their columns. Steps, contributions and the summary are
    computed when they are first asked for. `sinks` is the table of the keys that were left out (`measures.sinks`), None
    when none were looked for.
    """

    question: Question
    measured: Sequence[MeasuredEpisode]
    episodes: Tables
    tasks: Tables
    sinks: pl.DataFrame | None = None

    @property
    def grouping(self) -> Grouping:
        """The groups of keys and the ratio that the tables are about."""
        return self.question.grouping

    @cached_property
    def resolved(self) -> Sequence[ResolvedGrouping]:
        """The grouping on every episode."""
        return resolve_all(self.grouping, self.question.selected, self.question.vocabulary)

    @cached_property
    def replans(self) -> Tables:
        """See `measures.aggregate.replan_tables`."""
        return replan_tables(self.measured, self.grouping)

    @cached_property
    def overall(self) -> dict[str, Any]:
        """The cell of `tasks` over all tasks and layers (over the one layer, if one was selected)."""
        cells = overall_rows(self.tasks).cells
        return cells.row(by_predicate=pl.col("layer") == overall_layer(cells), named=True)

    @cached_property
    def overall_groups(self) -> dict[str, dict[str, Any]]:
        """The groups of the cell `overall`, by name."""
        return {
            group: row
            for (layer, group), row in overall_rows(self.tasks).by_group("layer").items()
            if layer == self.overall["layer"]
        }

    @property
    def denoise(self) -> str:
        """The denoise steps that the numbers are means over, in words."""
        policy = self.question.stores[0].attributes.policy
        return denoise_text(self.question.selection.denoise_steps, policy.num_denoise_steps)

    @property
    def present_groups(self) -> tuple[str, ...]:
        """The groups that have keys."""
        return overall_rows(self.tasks).groups_with_keys()

    @property
    def steps(self) -> Tables:
        """See `measures.steps.step_tables`."""
        return step_tables(self.measured, self.grouping)

    @cached_property
    def contributions(self) -> TableInParts | None:
        """See `measures.contributions.contribution_table`; None when they were not recorded."""
        return contribution_table(self.question.selected, self.question.selection, self.question.settings.layers)

    @cached_property
    def group_contributions(self) -> Tables | None:
        """See `measures.group_contributions.group_contribution_tables`; None also when every group cuts a segment."""
        return group_contribution_tables(self.question)

    @cached_property
    def contribution_rows(self) -> pl.DataFrame | None:
        """See `measures.contribution_ratios.contribution_rows`, of both sides; None when they were not recorded."""
        if self.contributions is None:
            return None
        return contribution_rows(self.contributions, "visual_norm", "linguistic_norm", self.question.sampling)

    @property
    def headline(self) -> Headline | None:
        """The ratio over all tasks and layers; None for a grouping without one.

        Where a site has one of the modalities only (Cosmos), it is that of the norms of contributions.
        """
        several = self.overall["num_tasks"] > 1
        about = self.question.units.words if several else "episodes like these of the one task"
        untrained, layers = self.question.untrained, layer_name(self.overall["layer"], "average over layers")
        if self.grouping.ratio is not None:
            what = " / ".join(shortened(side, 40) for side in ratio_definition(self.grouping).split(" / "))
            return headline_of(self.overall, what, f"{HEADLINE_NAME}, {layers}", about, untrained)
        if self.contribution_rows is None or not {"visual", "linguistic"} <= set(self.grouping.names):
            return None
        row, name = self.contribution_rows.row(-1, named=True), f"norms of contributions, {HEADLINE_NAME}, {layers}"
        return headline_of(row, "|visual| / |linguistic|", name, about, untrained)

    @property
    def answer(self) -> list[str]:
        """Three sentences: what was run, the ratio beside that of uniform attention, what may be concluded."""
        question, headline, row = self.question, self.headline, self.overall
        untrained = question.untrained
        policy = question.stores[0].attributes.policy
        said = untrained and "untrained" not in policy.name
        name = f"{policy.name}{', untrained' if said else ''} ({shortened(policy.checkpoint, 60)})"
        suites = sorted(self.episodes.cells["suite"].unique())
        layers, steps = len(set(question.selection.blocks)), question.selection.denoise_steps
        solved = solved_text(item.episode.attributes.success for item in question.selected)
        sentences = [run_sentence(name, row, solved, suites, layers, steps, question.site)]
        if headline is not None:
            sentences.append(ratio_sentence(headline))
        return [*sentences, conclusion(headline, untrained, row["num_tasks"], row["num_episodes"])]

    @property
    def notes(self) -> list[str]:
        """What to know beside the numbers: what was left out, which steps they are of, other sites."""
        question = self.question
        notes = [
            *question.remarks_on_intervals,
            *_notes(question.stores[0].attributes, question.selection, question.site),
        ]
        if self.grouping.ratio is not None and self.without_known_end:
            notes.append(
                f"No results file in the published format: it states outcome and number of steps of each episode, and "
                f"of {self.without_known_end} of {len(question.selected)} episodes these are not known."
            )
        return notes

    @property
    def without_known_end(self) -> int:
        """Number of episodes whose outcome or number of steps is not known."""
        ends = (item.episode.attributes for item in self.question.selected)
        return sum(end.success is None or not end.num_steps for end in ends)

    @cached_property
    def summary(self) -> str:
        """The whole text: `summary_text`, then the section on contributions where these were recorded."""
        question = self.question
        sections = summary_sections(_described(self), self.grouping, self.episodes, self.tasks)
        if all(store.attributes.recording.contributions for store in question.stores):
            tables, sampling = self.group_contributions, question.sampling
            both = self.contributions is not None and not same_sides(self.contributions, tables)
            if both:
                assert self.contribution_rows is not None
                sections += contribution_sections(self.contribution_rows)
            sections += group_contribution_sections(tables, self.grouping, question.site, sampling, not both)
        return f"{text_of(sections)}\n"


def analyse(question: Question, without_sinks: SinkRule | None = None) -> Analysis:
    """Compute the tables. A terminal shows the progress.

    Args:
        question: stores, selection and grouping.
        without_sinks: take the keys that are sinks by this rule out of every group and of the valid keys. Reads all
            selected rows.
    """
    sinks = None
    if without_sinks is not None:
        sinks = search_sinks(question, without_sinks).sinks
        question = question_without_sinks(question, sinks, without_sinks)
    grouping = question.grouping
    measured = measure_episodes(question)
    episodes = episode_tables_of(measured, grouping)
    tasks = task_tables(episodes, grouping, question.sampling)
    return Analysis(question, measured, episodes, tasks, sinks)


def _described(analysis: Analysis) -> AnalysedRun:
    """The lines of the summary's header that the tables do not hold."""
    question = analysis.question
    policy = question.stores[0].attributes.policy
    return AnalysedRun(
        stores=[str(store.path) for store in question.stores],
        policy=f"{policy.name} ({policy.checkpoint_format}: {policy.checkpoint})",
        untrained=policy.untrained,
        denoise_steps=question.selection.denoise_steps,
        heads=describe_heads(question.selection, question.stores[0].attributes.size_of(question.site)[1]),
        units=question.units,
        notes=analysis.notes,
        answer=analysis.answer,
    )


def write_tables(analysis: Analysis, folder: Path) -> list[Path]:
    """Write the results JSON (when the grouping has a ratio), the tables and the summary; returns the paths.

    Each file appears whole or not at all.
    """
    written: list[Path] = []
    grouping = analysis.grouping
    # A table that is passed on alone says what its numbers are.
    about = {"grouping": grouping.name, "grouping_description": grouping.description, "mean_over": analysis.denoise}
    written += write_parquet(folder, about, **named_parts("steps", analysis.steps))
    for name in ("episodes", "tasks"):
        written += write_parquet(folder, about, **named_tables(name, getattr(analysis, name)))
    recorded: dict[str, TableInParts] = {}
    if analysis.contributions is not None:
        recorded["contributions"] = analysis.contributions
    if analysis.group_contributions is not None:
        recorded["group_contributions"] = groups_in_parts(analysis.group_contributions)
        if have_ratio(analysis.group_contributions):
            recorded["group_contribution_ratios"] = cells_in_parts(analysis.group_contributions)
    written += write_parquet(folder, about, **recorded)
    with writing("results", folder):
        if grouping.ratio is not None and not analysis.without_known_end:
            question = analysis.question
            proxy = frame_proxy(question.stores[0].attributes, question.selected[0].tokens.layout, grouping)
            steps = question.selection.denoise_steps
            num_keys = (one.num_keys for one in analysis.measured)
            written += write_results_of_suites(folder, analysis.replans, grouping, steps, proxy, num_keys)
        write_text(folder / "summary.txt", analysis.summary)
    written.append(folder / "summary.txt")
    if analysis.sinks is not None:
        written += write_parquet(folder, sinks=analysis.sinks)
    return written


def _notes(root: RootAttributes, selection: Selection, site: str) -> list[str]:
    notes = [selection.note] if selection.note else []
    notes += [one_sided] if (one_sided := site_without_a_side(root, site)) else []
    others = [other.name for other in root.sites if other.name != site]
    if others:
        notes.append(
            f"Masses of the site '{site}' only; the other sites ({listing(others)}) are softmaxes of their own, and a "
            "mass of one must not be divided by a mass of another. Choose with --site."
        )
    return notes


def site_without_a_side(root: RootAttributes, site: str) -> str:
    """That a site of some of the blocks has no image keys or no text keys, as a sentence; empty where it has both."""
    kinds = {span.kind for span in root.site(site).spans}
    missing = [name for name, has in (("image", {"image", "latent"}), ("text", {"text"})) if not kinds & has]
    if not missing or not root.site(site).layers:
        return ""
    return (
        f"Site '{site}' has no {' and no '.join(missing)} keys: a ratio of visual to linguistic attention is not "
        "defined inside of it. Compare norms of contributions, which sites of different blocks share."
    )


def describe_heads(selection: Selection, num_heads: int) -> str:
    """How heads were averaged, as text."""
    return f"mean over {heads_text(selection, num_heads)}" + (
        " (kept apart in the steps table)" if selection.per_head else ""
    )
