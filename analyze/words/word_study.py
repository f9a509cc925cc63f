"""Which words are read, over episodes: means with intervals, and the layers and heads that read most."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import polars as pl

from vla_attention.analyze.measures.aggregate import overall_layer
from vla_attention.analyze.measures.frames import EPISODE_ID, LAYERS_AVG
from vla_attention.analyze.measures.question import Question, ask
from vla_attention.analyze.measures.question_settings import AnalysisSettings
from vla_attention.analyze.statistics.bootstrap import DEFAULT_SEED, POSITIVE, SHARE
from vla_attention.analyze.statistics.episode_intervals import means_with_intervals
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
        return words_summary(self.episodes, self.instruction is not None, seed=self.question.settings.seed)

    @property
    def readers(self) -> pl.DataFrame:
        """The layers and heads that read most; see `strongest_readers`."""
        return strongest_readers(self.episodes)

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
    table: pl.DataFrame, by_place: bool = False, layer: str | None = None, seed: int = DEFAULT_SEED
) -> pl.DataFrame:
    """Mean of every word over the episodes that have it, with two-level intervals, from `words_table`.

    A word that occurs twice in an instruction is one item (its masses are added up) unless `by_place`, which keeps the
    places of one instruction apart and in reading order. `layer`: the label of one layer, else "layers_avg" where there
    is one. Heads that were kept apart are averaged. Sorted by lift, words first and scale last; columns as in
    `episode_intervals.means_with_intervals`.
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
    summary = means_with_intervals(episodes, item, {"pieces": POSITIVE, **_VALUES}, seed)
    summary = summary.drop("pieces_low", "pieces_high", "pieces_episodes")
    words = summary.filter(pl.col("kind") == "word")
    words = words.sort("place") if by_place else words.sort("lift", descending=True, nulls_last=True)
    return pl.concat([words, summary.filter(pl.col("kind") == "scale")])


def strongest_readers(table: pl.DataFrame, most: int = 5) -> pl.DataFrame:
    """The layers (and heads, where they were kept apart) in which a word has its highest lift, mean over episodes.

    One row per (word, layer, head), highest lift first, at most one per word; words that occur twice count by their
    mean.
    """
    layers = table.filter((pl.col("kind") == "word") & (pl.col("layer") != LAYERS_AVG))
    episodes = layers.group_by(*EPISODE_ID, "item", "word_class", "layer", "head").agg(pl.col("lift").mean())
    means = episodes.group_by("item", "word_class", "layer", "head").agg(
        pl.col("lift").mean(), pl.len().cast(pl.Int64).alias("num_episodes")
    )
    ranked = means.drop_nulls("lift").sort(["lift", "item", "layer"], descending=[True, False, False])
    return ranked.unique("item", keep="first", maintain_order=True).head(most)
