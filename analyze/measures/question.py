"""A question: stores, selected episodes and axes, a site and a grouping, all checked against what exists.

Every command and every method of the Python API begins with `ask`; the functions that measure take its `Question`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import polars as pl

from vla_attention.analyze.measures.question_settings import AnalysisSettings, union_of
from vla_attention.analyze.measures.selected import SelectedEpisode, load_tokens
from vla_attention.analyze.measures.task_families import sampling_of
from vla_attention.analyze.statistics.units import Sampling, Units
from vla_attention.analyze.stores.parallel import episode_reports
from vla_attention.analyze.stores.run_notes import RunNotes
from vla_attention.analyze.stores.selection import (
    Selection,
    check_combinable,
    choose_site,
    denoise_text,
    select,
    select_episodes,
)
from vla_attention.schemas.groupings.builtin_groupings import find_grouping
from vla_attention.schemas.groupings.grouping import Grouping, parse_group_argument, parse_ratio_argument, with_groups
from vla_attention.schemas.groupings.vocabulary import EpisodeTokens, Names, Vocabulary
from vla_attention.schemas.progress_bar import progress_bar
from vla_attention.schemas.stores.reader import Store, StoredEpisode
from vla_attention.schemas.stores.store_format import RootAttributes, StoreError

DEFAULT_GROUPING = "default"


@dataclass(frozen=True)
class Question:
    """Settings that were checked against stores.

    Attributes:
        stores: the stores, of one policy and one kind of recording.
        settings: what the user asked for.
        selection: positions along the stored axes.
        site: the softmax family whose rows are used.
        selected: the episodes, each with its store and its tokens.
        grouping: the groups of keys.
        vocabulary: the names that selectors may use over the episodes.
        sampling: what intervals over several tasks are about, and which tasks are related.
        skipped: a line for all that was left out: what the stores say of foreign and unlisted files among their
            episodes, and every episode that is damaged or empty (`skip_corrupt`).
        notes: further lines for every result, for instance which denoise steps it is of or which keys were taken out.
        told: what every answer says of runs that were changed or told something else (`RunNotes`).
    """

    stores: tuple[Store, ...]
    settings: AnalysisSettings
    selection: Selection
    site: str
    selected: tuple[SelectedEpisode, ...]
    grouping: Grouping
    vocabulary: Vocabulary
    sampling: Sampling
    skipped: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    told: tuple[str, ...] = ()

    @property
    def episodes(self) -> list[tuple[Store, StoredEpisode]]:
        """The episodes, each with its store."""
        return [(item.store, item.episode) for item in self.selected]

    @property
    def remarks(self) -> tuple[str, ...]:
        """The lines that every result with numbers has: what was left out, what was told, and the notes."""
        return (*self.skipped, *self.told, *self.notes)

    @property
    def tasks(self) -> pl.DataFrame:
        """The task of each episode: suite, task_id."""
        return pl.DataFrame([item.task for item in self.selected], schema=["suite", "task_id"], orient="row")

    @property
    def units(self) -> Units:
        """The units of intervals over all selected episodes."""
        return self.sampling.units(self.tasks).decided()

    @property
    def num_tasks(self) -> int:
        """Number of tasks of the selected episodes; equal numbers in different suites are different tasks."""
        return len({item.task for item in self.selected})

    @property
    def of_other_loop(self) -> bool:
        """Whether episodes are of a loop that is not ours: of their waiting steps and their end nothing is known."""
        return any(store.attributes.protocol.of_other_loop for store in self.stores)

    @property
    def untrained(self) -> bool:
        """Whether a store's policy has random weights."""
        return any(store.attributes.policy.untrained for store in self.stores)


#: Site and tasks -> the episodes with their tokens, their vocabulary, and the notes on their runs.
KnownEpisodes = dict[
    tuple[str, tuple[int | str, ...] | None], tuple[tuple[SelectedEpisode, ...], Vocabulary, tuple[str, ...]]
]


def ask(stores: Sequence[Store], settings: AnalysisSettings, known: KnownEpisodes | None = None) -> Question:
    """Check the settings against what the stores hold. Reads the episodes' attributes and roles, no rows.

    Args:
        stores: of one policy and one kind of recording.
        settings: what is asked.
        known: what earlier questions about the same stores have read; what this one reads is added.

    Raises:
        UserError: a subclass that says what does not fit; see `vla_attention.analyze.stores.selection` and
            `vla_attention.schemas.groupings.resolve`.
    """
    check_combinable(stores)
    root = stores[0].attributes
    site = choose_site(root, settings.site)
    selection = select(root, settings.layers, settings.denoise, settings.heads, settings.per_head, site)
    skipped = [note for store in stores for note in store.notes]
    if known is not None and not settings.skip_corrupt and (site, settings.tasks) in known:
        selected, vocabulary, told = known[site, settings.tasks]
    else:
        chosen = [(store, episode) for store in stores for episode in select_episodes(store, settings.tasks)]
        if settings.skip_corrupt:
            chosen, faulty = without_faulty(chosen)
            skipped += faulty
        names, notes_of_runs = Names(root.site(site)), RunNotes()

        def look(store: Store, episode: StoredEpisode, tokens: EpisodeTokens) -> None:
            names.add(tokens)
            notes_of_runs.add(store, episode.attributes)

        selected = tuple(load_tokens(chosen, site, look))
        vocabulary, told = names.vocabulary(), notes_of_runs.lines
        if known is not None and not settings.skip_corrupt:
            known[site, settings.tasks] = selected, vocabulary, told
    grouping = choose_grouping(settings, vocabulary)
    sampling, notes = sampling_of(settings.intervals, selected), _denoise_notes(root, selection, grouping)
    return Question(
        tuple(stores), settings, selection, site, selected, grouping, vocabulary, sampling, tuple(skipped), notes, told
    )


def select_again(question: Question, site: str) -> Selection:
    """The question's selection at another site, whose layers and heads may be others.

    Raises:
        BadArgument: the site lacks layers or heads that the user chose.
    """
    settings = question.settings
    root = question.stores[0].attributes
    return select(root, settings.layers, settings.denoise, settings.heads, question.selection.per_head, site)


def choose_grouping(settings: AnalysisSettings, vocabulary: Vocabulary) -> Grouping:
    """The grouping that the settings name, with command-line groups added and the ratio replaced if asked."""
    ratio = None if settings.ratio is None else parse_ratio_argument(settings.ratio)
    own = [parse_group_argument(text) for text in settings.groups]
    if settings.grouping is None and own and ratio is not None:
        # A ratio may name groups of the default grouping beside one's own; these alone are taken from it.
        default = find_grouping(DEFAULT_GROUPING, vocabulary).groups
        wanted = dict.fromkeys((*ratio.numerator, *ratio.denominator))
        known = {name for name, _ in own}
        own += [(name, union_of(default[name])) for name in wanted if name in default and name not in known]
    base = None
    if settings.grouping is not None or not settings.groups:
        base = find_grouping(settings.grouping or DEFAULT_GROUPING, vocabulary)
    grouping = with_groups(base, own) if own else base
    assert grouping is not None
    return grouping if ratio is None else replace(grouping, ratio=ratio)


def _denoise_notes(root: RootAttributes, selection: Selection, grouping: Grouping) -> tuple[str, ...]:
    """Of which denoise steps the numbers are, where these are a choice or differ from the published ones."""
    steps, num_steps = selection.denoise_steps, root.policy.num_denoise_steps
    these = denoise_text(steps, num_steps)
    # Layers that are numbered as recorded calls are those of the first denoise step in the published scripts.
    calls = any(label >= root.policy.num_layers for label in selection.layer_labels)
    named = grouping.published_denoise or ("first" if calls else None)
    if named is not None:
        published = 0 if named == "first" else num_steps - 1
        if steps == (published,):
            return (f"These numbers are of {these} alone, as those of the published scripts.",)
        return (
            f"These numbers are means over {these}; those of the published scripts are of denoise step {published} "
            f"alone: compare with --denoise {named}.",
        )
    chosen = len(steps) < len(root.recording.denoise_steps)
    return (f"These numbers are of {these} only, as --denoise asks.",) if chosen else ()


def without_faulty(
    chosen: Sequence[tuple[Store, StoredEpisode]],
) -> tuple[list[tuple[Store, StoredEpisode]], list[str]]:
    """The episodes that are undamaged and hold a replan, and a line on each of the others. Reads everything once."""
    kept, skipped = [], []
    with progress_bar(len(chosen), "episodes checked") as advance:
        for (store, episode), report in zip(chosen, episode_reports(chosen, "values", advance), strict=True):
            if report.faults:
                skipped.append(f"{episode.name} of {store.path} is left out: {report.faults[0].problem.rstrip('.')}")
            elif episode.attributes.num_replans == 0:
                skipped.append(f"{episode.name} of {store.path} is left out: it holds no replan")
            else:
                kept.append((store, episode))
    if not kept:
        raise StoreError(
            f"None of the {len(chosen)} selected episodes can be used; the first: {skipped[0]}. Capture them again."
        )
    return kept, skipped
