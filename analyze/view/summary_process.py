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
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import polars as pl

from vla_attention.analyze.ask import answer_to
from vla_attention.analyze.core.about import sides
from vla_attention.analyze.core.levels import levels_of
from vla_attention.analyze.measures.question import ask
from vla_attention.analyze.measures.question_settings import AnalysisSettings
from vla_attention.analyze.measures.tables import LAYERS_AVG
from vla_attention.analyze.view.summaries import OURS
from vla_attention.schemas.errors import UserError
from vla_attention.schemas.stores.reader import Store, StoredEpisode, open_store
from vla_attention.schemas.stores.store_format import episode_name, parse_episode_name

#: Whose answers are the findings of the run, in this order.
_QUESTIONS = ("language", "failures", "objects")
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
    """The summary of a store in parts: entries of episodes with their numbers, then what is said of all.

    An episode that cannot be read, or whose ratio is not defined, has no numbers, and `failed` is why.
    """
    for at in range(0, len(store.episodes), _AT_ONCE):
        yield from _entries(store, store.episodes[at : at + _AT_ONCE])
    yield _findings(store)


def _entries(store: Store, batch: Sequence[StoredEpisode]) -> Iterator[dict[str, Any]]:
    try:
        yield _measured(store, batch)
    except UserError as error:
        if len(batch) == 1:
            yield {"failed": str(error)}
        else:  # one of them is the reason
            for episode in batch:
                yield from _entries(store, [episode])


def _findings(store: Store) -> dict[str, Any]:
    """What the commands say of the run, each sentence once; and the steps at which failed episodes leave solved ones.

    A question that the store cannot answer says nothing.
    """
    found: dict[str, dict[str, Any]] = {}
    leaves: dict[str, int] = {}
    for name in _QUESTIONS:
        try:
            result = answer_to(name, [store], AnalysisSettings(skip_corrupt=True))
        except UserError:
            continue
        for one in result.findings:
            found.setdefault(one.sentence, {"asks": one.asks, "sentence": one.sentence, "limit": one.limit})
        for table in result.tables:
            if table.name == "failures":
                rows = table.shown.drop_nulls("step").select("task_id", "episode_index", "step")
                leaves |= {episode_name(task, episode): step for task, episode, step in rows.iter_rows()}
    return {"findings": list(found.values()), "leaves": leaves}


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
