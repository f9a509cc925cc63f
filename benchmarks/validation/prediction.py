"""Question 2: whether attention to a group of keys predicts how much the action changes without it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

import vla_attention as va
from benchmarks.validation.calls import ChangedEpisode, changed_episodes
from benchmarks.validation.changes import LINGUISTIC, VISUAL
from benchmarks.validation.group_attention import MEASURES, GroupAttention, GroupOfKeys, Place, group_attention
from benchmarks.validation.tables import means, spearman
from vla_attention.analyze.core.action_changes import ActionSpread
from vla_attention.analyze.core.sinks import SinkRule, search_sinks, without_sinks
from vla_attention.analyze.measures.question import Question
from vla_attention.schemas.groupings.vocabulary import EpisodeTokens
from vla_attention.schemas.groupings.words import split_words
from vla_attention.schemas.interventions import Interventions, KeyKnockout
from vla_attention.schemas.layout import Role, Span
from vla_attention.schemas.stores.reader import Store, StoredEpisode

#: Families of items, and what is alike in each of them.
FAMILIES = {
    "groups": "objects, words, cameras and parts of the prompt, of different sizes",
    "regions": "sixteen equal blocks of patches of each camera",
    "tokens": "every single key of the prompt: one key each",
    "words": "every word of the instruction: one key each, where a word is one piece",
    "parts": "each camera and each part of the prompt",
    "parts and layers": "each camera and part of the prompt in each layer",
    "heads, pictures": "all picture keys in each head of each layer",
    "heads, text": "the linguistic keys in each head of each layer",
}
#: Measure -> where it comes from.
ATTENTION = ("mass", "lift", "mass without sinks", "contribution norm")
#: What needs no attention at all: a larger group has a larger effect. Without spread where all items have one size.
BASELINE = "keys"
_PARTS = {"bos": Role.BOS, "template": Role.TEMPLATE, "instruction": Role.INSTRUCTION, "state": Role.STATE}


@dataclass(frozen=True)
class Item:
    """A group of keys in one place of the model, as a member of a family."""

    family: str
    name: str
    group: GroupOfKeys

    @property
    def key(self) -> str:
        """The same for items of different families that are one intervention."""
        place = self.group.place
        return f"{self.group.text} @ {place.layers} {place.heads}"

    @property
    def change(self) -> Interventions:
        """The group knocked out for the action queries."""
        place = self.group.place
        return Interventions(keys=(KeyKnockout(self.group.selectors[0], layers=place.layers, heads=place.heads),))

    @property
    def everywhere(self) -> Interventions | None:
        """The group knocked out for all queries; None for an item that is in some layers or heads only."""
        whole = self.group.place == Place()
        return Interventions(keys=(KeyKnockout(self.group.selectors[0], queries="all"),)) if whole else None


def items_of(store: Store, episode: StoredEpisode) -> list[Item]:
    """All items of an episode, at all sites of the policy."""
    attributes, recording = store.attributes, store.attributes.recording
    layers, heads = recording.layers, recording.heads
    sites = [episode.tokens(attributes, site.name) for site in attributes.sites]
    spans = [span for tokens in sites for span in tokens.layout.spans if _has_valid_keys(tokens, span)]
    parts = {span.camera: f"camera:{span.camera}" for span in spans if span.camera is not None}
    there = {int(role) for tokens in sites for role in tokens.static_roles[0][tokens.valid[0]]}
    parts |= {name: f"role:{name}" for name, role in _PARTS.items() if int(role) in there}
    instruction = episode.attributes.instruction
    words = list(dict.fromkeys(instruction[start:stop] for start, stop in split_words(instruction)))
    objects = [thing.name for thing in episode.attributes.objects if thing.kind == "object"]
    found = [Item("groups", name, GroupOfKeys((selector,))) for name, selector in parts.items()]
    found += [Item(family, word, GroupOfKeys((f'word:"{word}"',))) for family in ("groups", "words") for word in words]
    found += [Item("groups", name, GroupOfKeys((f'object:"{name}"',))) for name in objects]
    found += [Item("regions", text, GroupOfKeys((text,))) for tokens in sites for text in _regions(tokens)]
    found += [Item("tokens", text, GroupOfKeys((text,))) for tokens in sites for text in _single_keys(tokens)]
    found += [
        Item("parts and layers", f"{name}, layer {layer}", GroupOfKeys((selector,), Place(layers=(layer,))))
        for name, selector in parts.items()
        for layer in layers
    ]
    found += [
        Item(family, f"layer {layer}, head {head}", GroupOfKeys((selector,), Place(layers=(layer,), heads=(head,))))
        for family, selector in (("heads, pictures", VISUAL), ("heads, text", LINGUISTIC))
        for layer in layers
        for head in heads
    ]
    return found + [Item("parts", name, GroupOfKeys((selector,))) for name, selector in parts.items()]


def _has_valid_keys(tokens: EpisodeTokens, span: Span) -> bool:
    return bool(tokens.valid[0, span.start : span.stop].any())


def _regions(tokens: EpisodeTokens) -> Iterator[str]:
    for span in tokens.layout.spans:
        if span.grid is None or not _has_valid_keys(tokens, span):
            continue
        rows, columns = (max(1, size // 4) for size in (span.grid.rows, span.grid.columns))
        for row in range(0, span.grid.rows, rows):
            for column in range(0, span.grid.columns, columns):
                yield f"patch:{span.camera}[{row}:{row + rows},{column}:{column + columns}]"


def _single_keys(tokens: EpisodeTokens) -> Iterator[str]:
    for span in tokens.layout.spans:
        if span.kind == "text":
            for key in range(span.start, span.stop):
                if tokens.valid[0, key]:
                    yield f"keys:{key}-{key}"


def predicted_effects(
    policy: Any, store: Store, spread: ActionSpread, folder: Path, replans: int, say: Callable[[str], None]
) -> pl.DataFrame:
    """One row per episode and item: its effect and its attention in the same replans.

    Returns:
        family, item, suite, task_id, episode_index, effect (of a knockout for the action queries), everywhere (for all
        queries; null for items in some layers or heads), and a column for each of `ATTENTION`; null where there is
        none: norms exist for whole parts and for all heads together only.
    """
    items = {episode.name: items_of(store, episode) for episode in store.episodes}

    def changes_of(episode: StoredEpisode) -> dict[str, Interventions]:
        return {item.key: item.change for item in items[episode.name]}

    def everywhere_of(episode: StoredEpisode) -> dict[str, Interventions]:
        found = {item.key: item.everywhere for item in items[episode.name]}
        return {key: change for key, change in found.items() if change is not None}

    episodes = changed_episodes(policy, store, changes_of, replans, folder / "action", say)
    all_queries = changed_episodes(policy, store, everywhere_of, replans, folder / "all", say)
    say("attention to the same groups ...")
    question = va.open(store.path).ask()
    groups = list(dict.fromkeys(item.group for of_episode in items.values() for item in of_episode))
    attention = group_attention(question, groups)
    cleaned = group_attention(_without_sinks(question), groups)
    rows = []
    for episode, whole in zip(episodes, all_queries, strict=True):
        for item in items[episode.name]:
            effects = episode.effect(item.key, spread)
            there = np.isfinite(effects)
            if not there.any():
                continue
            values = _values(attention[item.group], episode)[there].mean(axis=0)
            clean = np.nan_to_num(_values(cleaned[item.group], episode)[there, MEASURES.index("mass")]).mean()
            row = {"family": item.family, "item": item.name, "suite": store.attributes.protocol.suite}
            row |= {"task_id": episode.task_id, "episode_index": episode.episode_index}
            row |= {"effect": float(effects[there].mean()), "everywhere": None}
            if item.key in whole.actions:
                row["everywhere"] = _number(float(np.mean(whole.effect(item.key, spread))))
            row |= {"keys": float(values[MEASURES.index("keys")])}
            known = (values[0], values[1], clean, values[2])
            rows.append(row | {name: _number(value) for name, value in zip(ATTENTION, known, strict=True)})
    return pl.DataFrame(rows, infer_schema_length=None)


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _values(attention: GroupAttention, episode: ChangedEpisode) -> np.ndarray:
    if episode.name not in attention.values:
        return np.full((len(episode.replans), len(MEASURES)), np.nan)
    return attention.values[episode.name][episode.replans]


def _without_sinks(question: Question) -> Question:
    rule = SinkRule()
    return without_sinks(question, search_sinks(question, rule).sinks, rule)


def correlations(table: pl.DataFrame, effect: str = "effect") -> list[dict[str, Any]]:
    """Rank correlations between attention and effect over the items of an episode, and their means over episodes.

    effect: the column of the effects. A measure that some items of a family have not is left out.

    Each is computed inside of an episode, then averaged over tasks; intervals take the task as unit. Not on Fisher's
    scale: of few items the order is often the same, and there a correlation of 1 has no finite value.
    `highest`: in how many episodes the item with most attention has the largest effect; `chance`: 1 / items.
    """
    found = []
    for family in FAMILIES:
        for measure in (*ATTENTION, BASELINE):
            chosen = table.filter(pl.col(effect).is_not_null(), family=family)
            if not chosen.height or chosen[measure].null_count():
                continue
            rows = []
            for (suite, task, episode), part in chosen.group_by(
                "suite", "task_id", "episode_index", maintain_order=True
            ):
                first, second = part[measure].to_numpy(), part[effect].to_numpy()
                value = spearman(first, second)
                if np.isfinite(value):
                    hit = float(np.argmax(first) == np.argmax(second))
                    rows.append((family, suite, task, episode, part.height, hit, value))
            if not rows:
                continue
            names = ["family", "suite", "task_id", "episode_index", "items", "hit", "value"]
            episodes = pl.DataFrame(rows, schema=names, orient="row")
            row = means(episodes, ["family"])[0]
            items, highest = (float(np.mean(episodes[name].to_numpy())) for name in ("items", "hit"))
            row |= {"measure": measure, "items": items, "highest": highest, "chance": 1 / items}
            found.append(row)
    return found


def item_means(table: pl.DataFrame) -> list[dict[str, Any]]:
    """Means over episodes of every item of some families, for the picture."""
    chosen = table.filter(pl.col("family").is_in(["groups", "parts and layers", "heads, pictures", "heads, text"]))
    grouped = chosen.group_by("family", "item", maintain_order=True).agg(
        pl.col("effect", "everywhere", "keys", *ATTENTION).mean(), pl.len().alias("episodes")
    )
    return grouped.to_dicts()
