"""Which words are read, over episodes: means with intervals, and which word leads."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import polars as pl

from vla_attention.analyze.measures.aggregate import overall_layer
from vla_attention.analyze.measures.frames import EPISODE_ID, LAYERS_AVG
from vla_attention.analyze.measures.question import Question, ask
from vla_attention.analyze.measures.question_settings import AnalysisSettings
from vla_attention.analyze.statistics.episode_intervals import Sampling, means_with_intervals
from vla_attention.analyze.statistics.intervals import POSITIVE, SHARE
from vla_attention.analyze.statistics.many_looks import NamedLeader, adjusted_p_values, leader_of_table
from vla_attention.analyze.stores.selection import site_that
from vla_attention.analyze.words.word_reading import words_table
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.groupings.vocabulary import NO_WORDS
from vla_attention.schemas.safe_text import visible
from vla_attention.schemas.stores.reader import Store
from vla_attention.schemas.stores.store_format import RootAttributes

_VALUES = {"mass": POSITIVE, "density": POSITIVE, "lift": POSITIVE, "share": SHARE}


@dataclass(frozen=True)
class WordStudy:
    """The words of the selected episodes.

    Attributes:
        question: what was asked, at a site whose keys spell words.
        instruction: the instruction, when one task was asked for and has a single one: words are then kept in its
            order.
        episodes: one row per episode, layer, head and word; see `words_table`.
    """

    question: Question
    instruction: str | None
    episodes: pl.DataFrame

    @cached_property
    def summary(self) -> pl.DataFrame:
        """Means over episodes with intervals; see `words_summary`."""
        return words_summary(self.episodes, self.question.sampling, self.instruction is not None)

    @property
    def leaders(self) -> list[NamedLeader]:
        """The leading word, and the leading (word, layer, head); see `leading_words`."""
        return leading_words(self.episodes, self.question.sampling)

    @property
    def layer(self) -> str:
        """The layer that the summary is of."""
        return overall_layer(self.episodes)


def study_words(stores: Sequence[Store], settings: AnalysisSettings, task: int | None = None) -> WordStudy:
    """Measure the words at the settings' site, or at the first one whose keys spell words.

    `task`: one task only, its instruction word by word.

    Raises:
        BadArgument: the site has no words, or both `task` and `settings.tasks` are given.
    """
    if task is not None and settings.tasks:
        raise BadArgument("Give --task or --tasks, not both: --task shows one instruction word by word.")
    tasks = settings.tasks if task is None else (task,)
    site = site_of_words(stores[0].attributes, settings.site)
    question = ask(stores, replace(settings, site=site, tasks=tasks))
    instructions = {visible(item.episode.attributes.instruction) for item in question.selected}
    one = instructions.pop() if task is not None and len(instructions) == 1 else None
    return WordStudy(question, one, words_table(question))


def site_of_words(root: RootAttributes, wanted: str | None) -> str:
    """The wanted site, or the first one whose keys spell a text.

    Raises:
        BadArgument: the keys of the wanted site, or of every site, spell no text.
    """
    site = site_that(root, wanted, lambda site: any(span.kind == "text" for span in site.spans))
    if site is None:
        raise BadArgument(f"Site '{wanted or root.sites[0].name}': {NO_WORDS}.")
    return site


def words_summary(
    table: pl.DataFrame,
    sampling: Sampling,
    by_place: bool = False,
    layer: str | None = None,
) -> pl.DataFrame:
    """Mean of every word over the episodes that have it, with intervals, from `words_table`.

    A word that occurs twice in an instruction is one item (its masses are added up) unless `by_place`, which keeps the
    places of one instruction apart and in reading order. `layer`: the label of one layer, else "layers_avg" where there
    is one. Heads that were kept apart are averaged. Sorted by lift, words first and scale last; columns as in
    `episode_intervals.means_with_intervals`, and `lift_q`: the p-value of lift 1 (uniform attention), adjusted for the
    number of words (Benjamini-Hochberg; apart from the rows for scale).
    """
    chosen = table.filter(pl.col("layer") == (layer or overall_layer(table)))
    if chosen.is_empty():
        raise BadArgument(f"There is no layer '{layer}' in the table.")
    places = pl.col("place") if by_place else pl.lit(None, dtype=pl.Int64).alias("place")
    item = ["kind", "item", "place", "word_class"]
    # A word that occurs twice: masses and pieces add up, and the lift of both is the mean of their lifts, by pieces.
    lift = (pl.col("lift") * pl.col("pieces")).sum() / pl.col("pieces").sum()
    share = pl.when(pl.col("share").is_not_null().any()).then(pl.col("share").sum())
    per_head = chosen.with_columns(places).group_by(*EPISODE_ID, "head", *item, maintain_order=True)
    joined = per_head.agg(
        pl.col("pieces").sum(), pl.col("mass").sum(), share.alias("share"), lift.alias("lift")
    ).with_columns(density=pl.col("mass") / pl.col("pieces"))
    episodes = joined.group_by(*EPISODE_ID, *item, maintain_order=True).agg(
        pl.col("pieces").first(), *(pl.col(name).mean() for name in _VALUES)
    )
    summary = means_with_intervals(episodes, item, {"pieces": POSITIVE, **_VALUES}, sampling, nulls={"lift": 1.0})
    summary = summary.drop("pieces_low", "pieces_high", "pieces_episodes")
    is_word = pl.col("kind") == "word"
    summary = pl.concat(
        part.with_columns(pl.Series("lift_q", adjusted_p_values(part["lift_p"].to_list()), dtype=pl.Float64))
        for part in (summary.filter(is_word), summary.filter(~is_word))
    ).drop("lift_p")
    words = summary.filter(is_word)
    words = words.sort("place") if by_place else words.sort("lift", descending=True, nulls_last=True)
    return pl.concat([words, summary.filter(pl.col("kind") == "scale")])


def leading_words(table: pl.DataFrame, sampling: Sampling) -> list[NamedLeader]:
    """The word with the highest lift over layers, and the (word, layer, head) with the highest, from `words_table`.

    Each with how surely it is above all the others (`many_looks.leader`). A word that occurs twice counts by the mean
    of its lifts. Fewer where there are no two words, or no two cells.
    """
    words = table.filter(pl.col("kind") == "word")
    overall, single = pl.col("layer") == overall_layer(table), pl.col("layer") != LAYERS_AVG
    found = []
    for which, item in ((overall, ("item",)), (single, ("item", "layer", "head"))):
        episodes = words.filter(which).group_by(*EPISODE_ID, *item, maintain_order=True).agg(pl.col("lift").mean())
        leading = leader_of_table(episodes, item, "lift", sampling)
        found += [] if leading is None else [leading]
    return found
