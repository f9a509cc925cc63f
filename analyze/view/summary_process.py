"""The process that computes a summary: `python -m vla_attention.analyze.view.summary_process STORE`.

It prints a line of JSON for some episodes at a time, and needs nobody who reads the last one: it ends when its output
is closed.
"""

from __future__ import annotations

import json
import math
import os
import sys
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import polars as pl

from vla_attention.analyze.ask import answer_to
from vla_attention.analyze.core.about import sides
from vla_attention.analyze.core.behaviour import behaviour, with_choices
from vla_attention.analyze.core.levels import levels_of
from vla_attention.analyze.core.listening import listens
from vla_attention.analyze.core.recorded_effects import recorded_effects
from vla_attention.analyze.core.result import Finding
from vla_attention.analyze.measures.question import KnownEpisodes, Question, ask, without_faulty
from vla_attention.analyze.measures.question_settings import AnalysisSettings
from vla_attention.analyze.measures.tables import LAYERS_AVG
from vla_attention.analyze.view.summaries import OURS
from vla_attention.schemas.cached_property import cached_property
from vla_attention.schemas.errors import UserError
from vla_attention.schemas.stores.reader import Store, StoredEpisode, open_store
from vla_attention.schemas.stores.store_format import episode_name, parse_episode_name

#: Whose answers are the findings of the run, in this order; those of the second need no rows, and are asked first.
_QUESTIONS = ("language", "failures", "objects")
_WITHOUT_ATTENTION = ("failures",)
#: Episodes that are measured together; their numbers appear together.
_AT_ONCE = 8


def main(place: str) -> int:
    """Print the summary of the store at a place; returns the exit code."""
    warnings.simplefilter("ignore")
    try:
        store = open_store(place)
        for part in summary_parts(store):
            print(f"\n{OURS}{json.dumps(part, allow_nan=False)}", flush=True)
    except BrokenPipeError:
        return 1
    except UserError as error:
        print(f"\n{OURS}{json.dumps({'failed': str(error)})}", flush=True)
    return 0


def summary_parts(store: Store) -> Iterator[dict[str, Any]]:
    """The summary of a store in parts: what needs no attention first, then entries of episodes with their numbers.

    `findings` are all that are known so far. An episode that cannot be read, or whose ratio is not defined, has no
    numbers, and `failed` is why.
    """
    readable = _Readable(store)
    found: dict[str, list[dict[str, str]]] = {name: [] for name in ("done", *_QUESTIONS)}
    if done := _done(readable.by_attributes):
        found["done"] = [done]
        yield _so_far(found)
    for name in _WITHOUT_ATTENTION:
        yield from readable.answer(name, found)
    yield from _effects(readable)
    for at in range(0, len(store.episodes), _AT_ONCE):
        yield from _entries(store, store.episodes[at : at + _AT_ONCE])
    for name in _QUESTIONS:
        if name not in _WITHOUT_ATTENTION:
            yield from readable.answer(name, found)
    yield _so_far(found)


def _entries(store: Store, batch: Sequence[StoredEpisode]) -> Iterator[dict[str, Any]]:
    try:
        yield _measured(store, batch)
    except UserError as error:
        if len(batch) == 1:
            yield {"failed": str(error)}
        else:  # one of them is the reason
            for episode in batch:
                yield from _entries(store, [episode])


class _Readable:
    """What can be read of a store, and what questions have read of it already."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._known: KnownEpisodes = {}

    @property
    def by_attributes(self) -> Store:
        """With the episodes whose attributes can be read."""
        return replace(self._store, episodes=tuple(filter(_has_attributes, self._store.episodes)))

    @cached_property
    def whole(self) -> Store:
        """With the episodes that are undamaged; the first question reads everything for it.

        Raises:
            StoreError: there are none.
        """
        kept, _ = without_faulty([(self._store, episode) for episode in self._store.episodes])
        return replace(self._store, episodes=tuple(episode for _, episode in kept))

    def answer(self, name: str, found: dict[str, list[dict[str, str]]]) -> Iterator[dict[str, Any]]:
        """What a command says of the run, added to what was found; of `failures` also where failed ones leave others.

        A question that the store cannot answer says nothing.
        """
        try:
            result = answer_to(name, [self.whole], AnalysisSettings(), known=self._known)
        except UserError:
            return
        found[name] = [*map(_shown, result.findings)]
        if name == "language":  # which says it of what can be read wholly
            found["done"] = []
        leaves: dict[str, int] = {}
        for table in result.tables:
            if table.name == "failures":
                rows = table.shown.drop_nulls("step").select("task_id", "episode_index", "step")
                leaves |= {episode_name(task, episode): step for task, episode, step in rows.iter_rows()}
        yield _so_far(found) | ({"leaves": leaves} if name == "failures" else {})

    def question(self) -> Question:
        """All of it, as the questions ask it."""
        return ask([self.whole], AnalysisSettings(), self._known)


def _has_attributes(episode: StoredEpisode) -> bool:
    try:
        return bool(replace(episode).attributes.num_replans)
    except UserError:
        return False


def _done(store: Store) -> dict[str, str] | None:
    """Whether the policy did what it was told, which needs attributes alone; None where nobody knows what it did."""
    asked = with_choices(behaviour((store, episode) for episode in store.episodes))
    return None if asked.is_empty() else _shown(listens(asked))


def _shown(finding: Finding) -> dict[str, str]:
    return {"asks": finding.asks, "sentence": finding.sentence, "limit": finding.limit}


def _so_far(found: Mapping[str, Sequence[dict[str, str]]]) -> dict[str, Any]:
    """Every sentence once; what was done stands first until `language` says it."""
    each = [one for findings in found.values() for one in findings]
    return {"findings": list({one["sentence"]: one for one in each}.values())}


def _effects(readable: _Readable) -> Iterator[dict[str, Any]]:
    """Of every episode how far its action moves with other words, or where none was exchanged without them: means."""
    try:
        question = readable.question()
        found = recorded_effects(question, attention=False)
    except UserError:
        return
    if found is None:
        return
    rows = found.episodes()
    exchanged = rows.filter(kind="prompt", item_kind="exchange")
    words = exchanged if exchanged.height else rows.filter(kind="without", item_kind="word")
    by_all = words.filter(pl.col("reader") == "total")  # where that was tried, as the page shows it
    words = words if exchanged.height else by_all if by_all.height else words.filter(reader="direct")
    means = words.group_by("task_id", "episode_index", maintain_order=True).agg(pl.mean("effect")).drop_nulls()
    title = f"{found.units.title}, words {'exchanged' if exchanged.height else 'left out'}"
    yield {
        "effects": {episode_name(task, one): _finite(size) for task, one, size in means.iter_rows()},
        "effect": title,
    }


def _measured(store: Store, batch: Sequence[StoredEpisode]) -> dict[str, Any]:
    """The entries of some episodes with their ratios over all layers and their lifts."""
    question = ask([replace(store, episodes=tuple(batch))], AnalysisSettings())
    cells = levels_of(question).episodes().filter(pl.col("layer") == LAYERS_AVG)
    by_episode = {(row["task_id"], row["episode_index"]): row for row in cells.iter_rows(named=True)}
    rows = []
    for episode in batch:
        numbers = by_episode[parse_episode_name(episode.name)]
        lift = _finite(numbers.get("ratio_lift"))
        rows.append({"name": episode.name, "ratio": _finite(numbers.get("geometric_mean")), "lift": lift})
    has_ratio = question.grouping.ratio is not None
    return {"episodes": rows, "ratio": " / ".join(map(_joined, sides(question.grouping))) if has_ratio else None}


def _joined(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"({' + '.join(names)})"


def _finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None


if __name__ == "__main__":
    if hasattr(os, "nice"):  # not on Windows
        os.nice(10)  # the first picture goes before the list's numbers
    sys.exit(main(sys.argv[1]))
