"""Which words are read: measured on every episode; means over episodes with intervals, and which word leads."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.measures.aggregate import overall_layer
from vla_attention.analyze.measures.baselines import uniform_keys, uniform_masses
from vla_attention.analyze.measures.frames import (
    EPISODE_ID,
    EPISODE_KEYS,
    LAYERS_AVG,
    LayerAxis,
    TableInParts,
    head_axis,
    in_larger_parts,
    long_table,
)
from vla_attention.analyze.measures.kept import measured_once
from vla_attention.analyze.measures.masses import finite_mean, group_measures, masses
from vla_attention.analyze.measures.not_in_memory import OnDisk
from vla_attention.analyze.measures.question import Question, ask
from vla_attention.analyze.measures.question_settings import AnalysisSettings
from vla_attention.analyze.measures.selected import SelectedEpisode
from vla_attention.analyze.statistics.episode_intervals import Sampling, means_with_intervals
from vla_attention.analyze.statistics.intervals import POSITIVE, SHARE
from vla_attention.analyze.statistics.many_looks import NamedLeader, adjusted_p_values, leader_of_table
from vla_attention.analyze.stores.parallel import each_episode
from vla_attention.analyze.stores.rows import layer_rows
from vla_attention.analyze.stores.selection import Selection, site_that
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.groupings.resolve import counted_keys
from vla_attention.schemas.groupings.vocabulary import NO_WORDS
from vla_attention.schemas.groupings.words import word_class
from vla_attention.schemas.layout import Role
from vla_attention.schemas.progress_bar import progress_bar
from vla_attention.schemas.safe_text import visible
from vla_attention.schemas.stores.reader import Store
from vla_attention.schemas.stores.store_format import RootAttributes

#: The roles of language: the linguistic group of the grouping 'default'. State digits are text, but not language.
LINGUISTIC_ROLES = (Role.BOS, Role.TEMPLATE, Role.INSTRUCTION, Role.TEXT)
#: Measured beside the words, for scale, where the site has such keys.
SCALE_ROLES = (Role.BOS, Role.TEMPLATE, Role.TEXT, Role.STATE, Role.IMAGE)
CONTENT, STOP = "content words", "stop words"


@dataclass(frozen=True)
class _Items:
    """What is measured in one episode: its words by place in the instruction, then classes and roles.

    `names`: (kind, word or name, place, class). `weights`: (replan or 1, key, item), then two further ones: all
    linguistic keys and all valid keys.
    """

    names: tuple[tuple[str, str, int | None, str | None], ...]
    weights: NDArray[np.float32]


def words_table(question: Question) -> TableInParts:
    """Measure every word of every selected episode; shows progress at a terminal.

    Returns:
        One row per (episode, layer or "layers_avg"[, head], item), means over the episode's replans. An item (`kind`)
        is a "word" at a `place` of the instruction, from 0, with its `word_class` (content or stop), or, for "scale",
        all content words, all stop words, or the keys of a role (bos, template, text, state, image). Columns:
            pieces    number of keys
            mass      sum of the rows over these keys, mean over denoise steps and heads
            density   mass / pieces
            lift      as of a group, see `masses.group_measures`: 1 is what uniform attention gives
            share     mass / mass of all linguistic keys (bos, template, instruction, text; null where there is none)
        `density`, `lift` and `share` are computed per replan from masses that were averaged over denoise steps and
        heads (for "layers_avg" also over layers), as everywhere in `vla_attention.analyze.measures`.

    Raises:
        BadArgument: the keys of the site spell no words.
    """
    if not question.vocabulary.words:
        raise BadArgument(f"Site '{question.site}': {NO_WORDS}.")
    selected, selection, site = question.selected, question.selection, question.site
    with progress_bar(len(selected), "episodes") as advance:

        def measure(positions: Sequence[int]) -> Iterator[dict[str, NDArray[Any]]]:
            scan = partial(_word_masses, selection=selection, site=site)
            return each_episode(scan, [selected[i] for i in positions], advance)

        arrays = measured_once("words", "masses of words", selected, selection, site, measure, {}, progress=advance)
        tables = (_episode_words(item, one["mass"], selection) for item, one in zip(selected, arrays, strict=True))
        return TableInParts(OnDisk(in_larger_parts(tables)))


def _episode_items(item: SelectedEpisode) -> _Items:
    tokens = item.tokens
    names: dict[tuple[str, str, int | None, str | None], int] = {}
    num_prompts, num_keys = max(1, len(tokens.prompts)), tokens.layout.num_keys
    by_prompt: list[NDArray[np.float32]] = []  # (prompt, key) of each item
    for which, words in enumerate(tokens.words):
        for place, word in enumerate(words):
            kind = word_class(word.text)
            for name in (
                ("word", word.text.casefold(), place, kind),
                ("scale", CONTENT if kind == "content" else STOP, None, kind),
            ):
                if name not in names:
                    names[name] = len(names)
                    by_prompt.append(np.zeros((num_prompts, num_keys), dtype=np.float32))
                by_prompt[names[name]][which, list(word.keys)] = 1.0
    stacked = np.stack(by_prompt, axis=-1) if by_prompt else np.zeros((num_prompts, num_keys, 0), dtype=np.float32)
    weights = stacked if len(stacked) == 1 else stacked[tokens.prompt_index]
    roles = tokens.static_roles
    members = []  # (replan or 1, key) of each role
    for role in SCALE_ROLES:
        if (roles == role).any():
            names[("scale", role.label, None, None)] = len(names)
            members.append(roles == role)
    members += [np.isin(roles, [int(role) for role in LINGUISTIC_ROLES]), item.valid]
    replans = max(len(weights), *(len(member) for member in members))
    parts = [np.broadcast_to(weights, (replans, *weights.shape[1:]))]
    parts += [np.broadcast_to(member, (replans, num_keys))[:, :, None].astype(np.float32) for member in members]
    whole = np.concatenate(parts, axis=2)
    whole[:, list(item.without)] = 0.0
    return _Items(tuple(names), whole)


def _word_masses(item: SelectedEpisode, selection: Selection, site: str) -> dict[str, NDArray[Any]]:
    """`mass` (replan, layer, head or 1, item), mean over denoise steps; the items are those of `_episode_items`."""
    items = _episode_items(item)
    heads = len(selection.heads) if selection.per_head else 1
    mass = np.zeros((item.tokens.num_replans, len(selection.layers), heads, items.weights.shape[2]))
    for part in layer_rows(item.store.attributes, item.episode, selection, site):
        mass[:, part.layer] += masses(part.rows, items.weights) / len(selection.denoise)
    return {"mass": mass}


def _episode_words(item: SelectedEpisode, mass: NDArray[np.float64], selection: Selection) -> pl.DataFrame:
    items = _episode_items(item)
    layers = LayerAxis.of(selection, average_one=False)
    mass = layers.with_average(mass)
    keys = counted_keys(items.weights, item.tokens.existing)
    uniform = uniform_masses(uniform_keys(item, selection), items.weights).mean(axis=2)
    if uniform.shape[1] > 1:
        uniform = layers.with_average(uniform)
    measures = group_measures(mass[..., :-2], mass[..., -1], keys[:, :-2], uniform[..., :-2], uniform[..., -1])
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.where(mass[..., -2:-1] > 0, measures.mass / mass[..., -2:-1], np.nan)
    outside = np.array([name in {Role.STATE.label, Role.IMAGE.label} for _, name, _, _ in items.names])
    share[..., outside] = np.nan  # no part of the linguistic mass
    pieces = np.broadcast_to(keys[:, None, None, :-2], measures.mass.shape)
    values = {
        "pieces": pieces,
        "mass": measures.mass,
        "density": measures.density,
        "lift": measures.lift,
        "share": share,
    }
    # Means over the replans whose prompt has the item.
    means = {name: finite_mean(np.where(pieces > 0, array, np.nan)) for name, array in values.items()}
    fields = (("kind", pl.String), ("item", pl.String), ("place", pl.Int64), ("word_class", pl.String))
    of_items = {
        field: pl.Series(field, [name[i] for name in items.names], dtype=kind) for i, (field, kind) in enumerate(fields)
    }
    return long_table(item, [layers.columns, head_axis(selection), of_items], means, EPISODE_KEYS)


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
    episodes: TableInParts

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
        return overall_layer(self.episodes.parts[0])

    def files(self) -> dict[str, pl.DataFrame | TableInParts]:
        """Both tables by the names of their files."""
        return {"words": self.episodes, "words_summary": self.summary}


def study_words(stores: Sequence[Store], settings: AnalysisSettings, task: int | None = None) -> WordStudy:
    """Measure the words at the settings' site, or at the first one whose keys spell words.

    `task`: one task only, its instruction word by word.

    Raises:
        BadArgument: the site has no words, or both `task` and `settings.tasks` are given.
    """
    if task is not None and settings.tasks:
        raise BadArgument("Give task or tasks, not both: task shows one instruction word by word.")
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
    table: TableInParts,
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
    chosen = table.filter(pl.col("layer") == (layer or overall_layer(table.parts[0])))
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


def leading_words(table: TableInParts, sampling: Sampling) -> list[NamedLeader]:
    """The word with the highest lift over layers, and the (word, layer, head) with the highest, from `words_table`.

    Each with how surely it is above all the others (`many_looks.leader`). A word that occurs twice counts by the mean
    of its lifts. Fewer where there are no two words, or no two cells.
    """
    overall, single = pl.col("layer") == overall_layer(table.parts[0]), pl.col("layer") != LAYERS_AVG
    found = []
    for which, item in ((overall, ("item",)), (single, ("item", "layer", "head"))):
        words = (part.filter(pl.col("kind") == "word", which) for part in table)
        lifts = (part.group_by(*EPISODE_ID, *item, maintain_order=True).agg(pl.col("lift").mean()) for part in words)
        leading = leader_of_table(lifts, item, "lift", sampling)
        found += [] if leading is None else [leading]
    return found
