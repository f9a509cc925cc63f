"""Question 3: how much of the effect of words is left when text cannot read pictures in the prefix, and the reverse."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from benchmarks.validation.calls import changed_episodes
from benchmarks.validation.changes import mixing_changes
from benchmarks.validation.tables import means
from vla_attention.analyze.core.action_changes import ActionSpread
from vla_attention.schemas.stores.reader import Store

CUTS = {
    "whole": "nothing is cut",
    "blind": "text cannot read pictures",
    "deaf": "pictures cannot read text",
    "apart": "neither can read the other",
}
#: Words that are taken from one kind of queries each, and these queries.
READ = {"instruction": "the instruction's words", "colour": "the colour's word"}
READERS = {
    "whole": "the action queries",
    "by_pictures": "the queries of pictures, in the prefix",
    "by_text": "the queries of text, in the prefix",
    "everywhere": "all queries",
    "random": "all queries; as many random keys",
}
GROUPS = {
    "instruction": "the instruction's words",
    "colour": "the colour's word",
    "text": "the whole prompt",
    "visual": "the pictures",
}


def mixing(
    policy: Any, store: Store, spread: ActionSpread, folder: Path, replans: int, say: Callable[[str], None]
) -> list[dict[str, Any]]:
    """Effects of cuts in the prefix, and of groups that the action queries cannot read under each cut.

    Rows: cut, group (empty: the cut by itself, against the stored actions), value with low and high; the effect of a
    group is against the same cut with all groups there. Rows whose cut is one of `READERS` are knockouts of a group for
    these queries.
    """
    suite = store.attributes.protocol.suite
    rows: list[tuple[str, str, str, int, int, float]] = []
    for episode in changed_episodes(policy, store, mixing_changes, replans, folder, say):
        place = (suite, episode.task_id, episode.episode_index)
        for cut in CUTS:
            if cut != "whole":
                rows.append((cut, "", *place, float(np.mean(episode.effect(f"nothing_{cut}", spread)))))
            for group in GROUPS:
                if f"{group}_{cut}" in episode.actions:
                    effect = episode.effect(f"{group}_{cut}", spread, f"nothing_{cut}")
                    rows.append((cut, group, *place, float(np.mean(effect))))
        for group, reader in product(READ, READERS):
            if reader != "whole" and f"{group}_{reader}" in episode.actions:
                rows.append((reader, group, *place, float(np.mean(episode.effect(f"{group}_{reader}", spread)))))
    table = pl.DataFrame(rows, schema=["cut", "group", "suite", "task_id", "episode_index", "value"], orient="row")
    return means(table, ["cut", "group"])
