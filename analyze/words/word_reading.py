"""Which words of the instruction are read: mass, density and lift of every word, and of classes that need no model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.measures.aggregate import EPISODE_KEYS, LAYERS_AVG, overall_layer
from vla_attention.analyze.measures.masses import group_measures, masses
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.measures.selected import SelectedEpisode
from vla_attention.analyze.show.progress import progress_bar
from vla_attention.analyze.statistics.bootstrap import DEFAULT_SEED, POSITIVE, SHARE
from vla_attention.analyze.statistics.episode_intervals import means_with_intervals
from vla_attention.analyze.stores.parallel import map_episodes
from vla_attention.analyze.stores.rows import layer_rows
from vla_attention.analyze.stores.selection import Selection
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.groupings.vocabulary import NO_WORDS
from vla_attention.schemas.groupings.words import word_class
from vla_attention.schemas.layout import Role
from vla_attention.schemas.stores.store_format import RootAttributes

#: What is language: the linguistic group of the grouping 'default'. State digits are not, though they are text.
LINGUISTIC_ROLES = (Role.BOS, Role.TEMPLATE, Role.INSTRUCTION, Role.TEXT)
#: Shown beside the words for scale, where the site has such keys.
SCALE_ROLES = (Role.BOS, Role.TEMPLATE, Role.TEXT, Role.STATE, Role.IMAGE)
CONTENT, STOP = "content words", "stop words"
_VALUES = {"mass": POSITIVE, "density": POSITIVE, "lift": POSITIVE, "share": SHARE}


@dataclass(frozen=True)
class _Items:
    """What is measured in one episode: its words by place in the instruction, then classes and roles.

    `names`: (kind, word or name, place, class). `weights`: (replan or 1, key, item).
    """

    names: tuple[tuple[str, str, int | None, str | None], ...]
    weights: NDArray[np.float32]


def site_of_words(root: RootAttributes, wanted: str | None) -> str:
    """The wanted site, or the first one whose keys spell a text; an error when the wanted one does not."""
    reading = [site.name for site in root.sites if any(span.kind == "text" for span in site.spans)]
    if wanted is None and reading:
        return reading[0]
    if wanted is not None and (wanted in reading or wanted not in [site.name for site in root.sites]):
        return wanted  # a name that does not exist is `choose_site`'s to refuse
    raise BadArgument(f"Site '{wanted or root.sites[0].name}': {NO_WORDS}.")


def words_table(question: Question) -> pl.DataFrame:
    """Measure every word of every selected episode; shows progress at a terminal.

    Returns:
        One row per (episode, layer or "layers_avg"[, head], item), means over the episode's replans. An item (`kind`) is a "word"
        at a `place` of the instruction, from 0, with its `word_class` (content or stop), or, for "scale", all content words, all
        stop words, or the keys of a role (bos, template, text, state, image). Columns:
            pieces    number of keys
            mass      sum of the rows over these keys, mean over denoise steps and heads
            density   mass / pieces
            lift      density / (mass of all valid keys / their number): 1 is what uniform attention gives
            share     mass / mass of all linguistic keys (bos, template, instruction, text; null where there is none)
        `density`, `lift` and `share` are computed per replan from masses that were averaged over denoise steps and heads (for
        "layers_avg" also over layers), as everywhere in `vla_attention.analyze.measures.aggregate`.

    Raises:
        BadArgument: the keys of the site spell no words.
    """
    if not question.vocabulary.words:
        raise BadArgument(f"Site '{question.site}': {NO_WORDS}.")
    with progress_bar(len(question.selected), "episodes") as advance:

        def measure(item: SelectedEpisode) -> pl.DataFrame:
            return _episode_words(item, question.selection, question.site)

        return pl.concat(map_episodes(measure, question.selected, advance))


def words_summary(
    table: pl.DataFrame,
    by_place: bool = False,
    layer: str | None = None,
    seed: int = DEFAULT_SEED,
) -> pl.DataFrame:
    """Mean of every word over the episodes that have it, with two-level intervals, from `words_table`.

    A word that occurs twice in an instruction is one item (its masses are added up) unless `by_place`, which keeps the places of
    one instruction apart and in reading order. `layer`: the label of one layer, else "layers_avg" where there is one. Heads that
    were kept apart are averaged. Sorted by lift, words first and scale last; columns as in `episode_intervals.means_with_intervals`.
    """
    chosen = table.filter(pl.col("layer") == (layer or overall_layer(table)))
    if chosen.is_empty():
        raise BadArgument(f"There is no layer '{layer}' in the table.")
    places = pl.col("place") if by_place else pl.lit(None, dtype=pl.Int64).alias("place")
    item = ["kind", "item", "place", "word_class"]
    # Words that stand twice: masses and pieces add up, and the lift of both is the mean of their lifts, by pieces.
    lift = (pl.col("lift") * pl.col("pieces")).sum() / pl.col("pieces").sum()
    share = pl.when(pl.col("share").is_not_null().any()).then(pl.col("share").sum())
    per_head = chosen.with_columns(places).group_by(*_EPISODE, "head", *item, maintain_order=True)
    joined = per_head.agg(
        pl.col("pieces").sum(), pl.col("mass").sum(), share.alias("share"), lift.alias("lift")
    ).with_columns(density=pl.col("mass") / pl.col("pieces"))
    episodes = joined.group_by(*_EPISODE, *item, maintain_order=True).agg(
        pl.col("pieces").first(), *(pl.col(name).mean() for name in _VALUES)
    )
    summary = means_with_intervals(episodes, item, {"pieces": POSITIVE, **_VALUES}, seed)
    summary = summary.drop("pieces_low", "pieces_high", "pieces_episodes")
    words = summary.filter(pl.col("kind") == "word")
    words = words.sort("place") if by_place else words.sort("lift", descending=True, nulls_last=True)
    return pl.concat([words, summary.filter(pl.col("kind") == "scale")])


def strongest_readers(table: pl.DataFrame, most: int = 5) -> pl.DataFrame:
    """The layers (and heads, where they were kept apart) in which a word has its highest lift, mean over episodes.

    One row per (word, layer, head), highest lift first, at most one per word; words that stand twice count by their mean.
    """
    layers = table.filter((pl.col("kind") == "word") & (pl.col("layer") != LAYERS_AVG))
    episodes = layers.group_by(*_EPISODE, "item", "word_class", "layer", "head").agg(pl.col("lift").mean())
    means = episodes.group_by("item", "word_class", "layer", "head").agg(
        pl.col("lift").mean(), pl.len().cast(pl.Int64).alias("num_episodes")
    )
    ranked = means.drop_nulls("lift").sort(["lift", "item", "layer"], descending=[True, False, False])
    return ranked.unique("item", keep="first", maintain_order=True).head(most)


_EPISODE = ("suite", "task_id", "episode_index")


def _episode_items(item: SelectedEpisode) -> _Items:
    tokens = item.tokens
    names: dict[tuple[str, str, int | None, str | None], int] = {}
    members = []  # (key,) per prompt, or (replan or 1, key)
    num_prompts, num_keys = max(1, len(tokens.prompts)), tokens.layout.num_keys
    by_prompt: list[NDArray[np.float32]] = []
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


def _episode_words(item: SelectedEpisode, selection: Selection, site: str) -> pl.DataFrame:
    items = _episode_items(item)
    heads = len(selection.heads) if selection.per_head else 1
    shape = (item.tokens.num_replans, len(selection.layers), heads, items.weights.shape[2])
    mass = np.zeros(shape)
    for part in layer_rows(item.episode, selection, site):
        rows = part.rows if selection.per_head else part.rows.mean(axis=1, keepdims=True)
        mass[:, part.layer] += masses(rows, items.weights) / len(selection.denoise)
    labels: list[tuple[str, int | None]] = [
        (str(label), block) for label, block in zip(selection.layer_labels, selection.blocks, strict=True)
    ]
    if len(labels) > 1:
        # A block that was named by two layer numbers counts once.
        once = [i for i, block in enumerate(selection.blocks) if selection.blocks.index(block) == i]
        mass = np.concatenate([mass, mass[:, once].mean(axis=1, keepdims=True)], axis=1)
        labels.append((LAYERS_AVG, None))
    keys = items.weights.sum(axis=1, dtype=np.float64)
    measures = group_measures(mass[..., :-2], mass[..., -1], keys[:, :-2], keys[:, -1].astype(np.int64))
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.where(mass[..., -2:-1] > 0, measures.mass / mass[..., -2:-1], np.nan)
    outside = np.array([name in {Role.STATE.label, Role.IMAGE.label} for _, name, _, _ in items.names])
    share[..., outside] = np.nan  # no part of the linguistic mass
    present = np.broadcast_to(keys[:, None, None, :-2] > 0, measures.mass.shape)
    frame = {
        "pieces": np.broadcast_to(keys[:, None, None, :-2], measures.mass.shape),
        "mass": measures.mass,
        "density": measures.density,
        "lift": measures.lift,
        "share": share,
    }
    means = {name: _mean_where(values, present) for name, values in frame.items()}
    return _as_table(item, items, labels, selection, means)


def _mean_where(values: NDArray[np.float64], present: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Mean over replans (axis 0) of the finite values of items that the replan's prompt has; NaN where there is none."""
    usable = present & np.isfinite(values)
    count = usable.sum(axis=0)
    total = np.where(usable, values, 0.0).sum(axis=0)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def _as_table(
    item: SelectedEpisode,
    items: _Items,
    labels: Sequence[tuple[str, int | None]],
    selection: Selection,
    means: dict[str, NDArray[np.float64]],
) -> pl.DataFrame:
    layers, heads, count = next(iter(means.values())).shape
    height = layers * heads * count
    attributes = item.episode.attributes
    constant: dict[str, Any] = {"suite": item.store.suite}
    constant |= {name: getattr(attributes, name) for name in EPISODE_KEYS if name != "suite"}
    head_numbers = list(selection.head_numbers) if selection.per_head else [None]
    columns: dict[str, Any] = {
        "layer": pl.Series([label for label, _ in labels for _ in range(heads * count)], dtype=pl.String),
        "layer_number": pl.Series(
            [None if block is None else int(label) for label, block in labels for _ in range(heads * count)],
            dtype=pl.Int64,
        ),
        "block": pl.Series([block for _, block in labels for _ in range(heads * count)], dtype=pl.Int64),
        "head": pl.Series([head for head in head_numbers for _ in range(count)] * layers, dtype=pl.Int64),
    }
    fields = (("kind", pl.String), ("item", pl.String), ("place", pl.Int64), ("word_class", pl.String))
    for i, (name, kind) in enumerate(fields):
        columns[name] = pl.Series([entry[i] for entry in items.names] * (layers * heads), dtype=kind)
    columns |= {name: np.ascontiguousarray(values).ravel() for name, values in means.items()}
    frame = pl.DataFrame({**{name: [value] * height for name, value in constant.items()}, **columns})
    return frame.with_columns(pl.col(pl.Float64).fill_nan(None))
