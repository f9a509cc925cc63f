"""Whether the groups with more attention are those without which the action changes more."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

import vla_attention as va
from benchmarks.validation.calls import changed_episodes
from benchmarks.validation.changes import without
from vla_attention.analyze.core.action_changes import ActionSpread
from vla_attention.analyze.statistics.student import student_quantile
from vla_attention.schemas.groupings.words import split_words
from vla_attention.schemas.interventions import Interventions, Queries
from vla_attention.schemas.stores.reader import Store, StoredEpisode

#: Family of groups that are ranked together -> what it is, and of which kinds its groups are.
FAMILIES = {
    "words": ("each word of the instruction", ("words",)),
    "tokens": ("each token of the prompt", ("tokens",)),
    "regions": ("sixteen equal blocks of patches of each camera", ("regions",)),
    "parts": ("each camera and each part of the prompt", ("parts",)),
    "groups": ("objects, words, cameras and parts of the prompt, of different sizes", ("parts", "words", "objects")),
}
_ROLES = ("bos", "template", "instruction", "state")


def groups_of(store: Store, episode: StoredEpisode) -> dict[str, dict[str, str]]:
    """Kind -> name of a group -> its selector, at the policy's first site. Groups of a kind share no token."""
    tokens = episode.tokens(store.attributes, store.attributes.sites[0].name)
    cameras, regions, keys = {}, {}, {}
    for span in tokens.layout.spans:
        there = [key for key in range(span.start, span.stop) if tokens.valid[0, key]]
        if span.kind == "text":
            keys |= {f"key_{key}": f"keys:{key}-{key}" for key in there}
        if span.grid is not None and there:
            cameras[str(span.camera)] = f"camera:{span.camera}"
            rows, columns = span.grid.rows // 4, span.grid.columns // 4
            for row, column in np.ndindex(4, 4):
                block = f"{row * rows}:{(row + 1) * rows},{column * columns}:{(column + 1) * columns}"
                regions[f"{span.camera}_{row}_{column}"] = f"patch:{span.camera}[{block}]"
    text = episode.attributes.instruction
    words = {word: f'word:"{word}"' for word in (text[start:stop] for start, stop in split_words(text))}
    objects = {one.name: f'object:"{one.name}"' for one in episode.attributes.objects if one.kind == "object"}
    parts = cameras | {role: f"role:{role}" for role in _ROLES}
    return {"words": words, "tokens": keys, "regions": regions, "parts": parts, "objects": objects}


def masses(store: Store, episode: StoredEpisode, groups: Mapping[str, str]) -> dict[str, np.ndarray]:
    """Selector -> the mass of its tokens at every replan (replan,), mean over layers, heads and denoise steps."""
    named = {f"group_{number}": selector for number, selector in enumerate(groups.values())}
    answer = va.open(store.path).analyze(groups=named | {"rest": "*"}, tasks=episode.attributes.task_id)
    rows = answer["replans_groups"].filter(pl.col("layer") == "layers_avg").sort("replan")
    return {selector: rows.filter(group=name)["mass"].to_numpy() for name, selector in named.items()}


def ranks(
    policy: Any, store: Store, spread: ActionSpread, folder: Path, replans: int, say: Callable[[str], None]
) -> list[dict[str, Any]]:
    """Spearman's rank correlation between attention and effect over the groups of an episode, mean over episodes.

    Rows of family, queries (who cannot read the group), items, value, low and high: the interval is Student's t over
    the episodes, each of a task of its own.
    """
    kinds = {episode.name: groups_of(store, episode) for episode in store.episodes}
    queries: tuple[Queries, ...] = ("action", "all")

    def changes_of(episode: StoredEpisode) -> dict[str, Interventions]:
        selectors = [one for groups in kinds[episode.name].values() for one in groups.values()]
        return {f"{one} {which}": without(one, which) for one in selectors for which in queries}

    made = changed_episodes(policy, store, changes_of, replans, folder, say)
    values: dict[tuple[str, str], list[float]] = {}
    counts: dict[str, list[int]] = {family: [] for family in FAMILIES}
    for episode, changed in zip(store.episodes, made, strict=True):
        say(f"attention in {episode.name}")
        attention: dict[str, np.ndarray] = {}
        for groups in kinds[episode.name].values():
            attention |= masses(store, episode, groups)
        for family, (_, members) in FAMILIES.items():
            selectors = [one for kind in members for one in kinds[episode.name][kind].values()]
            for which in queries:
                effects = np.array([changed.effect(f"{one} {which}", spread) for one in selectors])
                mass = np.where(np.isnan(effects), np.nan, [attention[one][changed.replans] for one in selectors])
                seen = ~np.isnan(effects).all(axis=1)  # an object may be out of view
                found = spearman(np.nanmean(mass[seen], axis=1), np.nanmean(effects[seen], axis=1))
                values.setdefault((family, which), []).append(found)
            counts[family].append(len(selectors))
    return [
        {"family": family, "queries": which, "items": float(np.mean(counts[family]))} | _mean(of)
        for (family, which), of in values.items()
    ]


def _mean(values: list[float]) -> dict[str, float | None]:
    """The mean, and Student's t interval where there are several values."""
    mean, n = float(np.mean(values)), len(values)
    half = student_quantile(0.95, n - 1) * float(np.std(values, ddof=1)) / n**0.5 if n > 1 else None
    return {"value": mean, "low": None if half is None else mean - half, "high": None if half is None else mean + half}


def spearman(first: np.ndarray, second: np.ndarray) -> float:
    """Rank correlation (Spearman 1904); equal values share their mean rank."""
    one, other = (pl.Series(values).rank("average").to_numpy() for values in (first, second))
    return float(np.corrcoef(one, other)[0, 1])
