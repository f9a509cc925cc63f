"""Which episodes of two runs are compared with each other, and what says that they begin alike.

Two episodes are a pair when suite, task, initial state and seed are equal. Where a store does not say in which state
its episodes begin (`va.record` in a loop that does not give it), the episodes of one number are. The pictures of the
first policy call can then show that they begin otherwise: such episodes are no pair.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import polars as pl

from vla_attention.analyze.core.runs import Run
from vla_attention.analyze.measures.selected import SelectedEpisode

#: Two episodes with equal values here are a pair; `occurrence` counts the episodes of a run with the same first state.
PAIR = ("suite", "task_id", "initial_state_digest", "seed", "occurrence")
#: Pictures of one state differ by less, as a mean over a camera's numbers of 0 to 255: drivers draw a little otherwise.
MOST_APART = 2.0
_SCHEMA = {"suite": pl.String, "task_id": pl.Int64, "episode_index": pl.Int64, "instruction": pl.String,
           "initial_state_digest": pl.String, "stated": pl.Boolean, "seed": pl.Int64}  # fmt: skip


def pairing(run: Run, ignore_seed: bool) -> pl.DataFrame:
    """What pairs each selected episode: `EPISODE_ID`, instruction, stated (whether its state is known), and `PAIR`.

    seed: the run's, which seeds environment and noise; in a loop that is not ours that of the first call's noise, null
    where it is not known. ignore_seed: 0 for all.
    """
    rows = []
    for item in run.question.selected:
        about, protocol = item.episode.attributes, item.store.attributes.protocol
        stated = bool(about.initial_state_digest)
        seed = next(iter(about.noise_seed), None) if protocol.of_other_loop else protocol.seed
        state = about.initial_state_digest or f"episode {about.episode_index}"
        rows.append((*item.key, about.instruction, state, stated, 0 if ignore_seed else seed))
    frame = pl.DataFrame(rows, schema=_SCHEMA, orient="row")
    return frame.with_columns(occurrence=pl.col("episode_index").rank("ordinal").over(PAIR[:-1]).cast(pl.Int64))


def pairs_of(first: pl.DataFrame, other: pl.DataFrame, rerun: bool) -> pl.DataFrame:
    """The pairs of two runs, from `pairing` of each.

    Returns:
        `PAIR`, instruction, stated, episode_first, episode_other.
    """
    mine = first.rename({"episode_index": "episode_first"})
    theirs = other.rename({"episode_index": "episode_other", "seed": "seed_other"}).drop("instruction")
    keys = ["suite", "task_id", "initial_state_digest", "stated", "occurrence"]
    if rerun:
        theirs = theirs.drop("occurrence").with_columns(episode_first="episode_other")
        keys[-1] = "episode_first"
    pairs = mine.join(theirs, on=keys, how="inner")
    apart = (pl.col("seed") != pl.col("seed_other")).fill_null(False)
    pairs = pairs.filter(~apart).sort("suite", "task_id", "episode_first", "episode_other")
    for side in ("first", "other"):  # a seed that is not known fits several
        pairs = pairs.unique(["suite", "task_id", f"episode_{side}"], keep="first", maintain_order=True)
    return pairs.with_columns(seed=pl.when(pl.col("seed_other").is_not_null()).then("seed")).drop("seed_other")


def with_first_pictures(pairs: pl.DataFrame, first: Run, other: Run) -> pl.DataFrame:
    """The pairs with pictures_apart: how far the pictures of the first call differ, of 255, where the state is unknown.

    The mean over the numbers of a picture, of the camera in which it is largest; null where the state is known, or
    where no camera is stored in both with pictures of one size.
    """
    items = [{item.key: item for item in run.question.selected} for run in (first, other)]
    found = [None if row["stated"] else _apart(items, row) for row in pairs.iter_rows(named=True)]
    return pairs.with_columns(pictures_apart=pl.Series(found, dtype=pl.Float64))


def _apart(items: list[dict[tuple[str, int, int], SelectedEpisode]], pair: Mapping[str, Any]) -> float | None:
    one, other = (
        of_run[pair["suite"], pair["task_id"], pair[f"episode_{side}"]].episode
        for of_run, side in zip(items, ("first", "other"), strict=True)
    )
    found = []
    for path in one.attributes.arrays:
        if path.startswith("frames/") and other.has(path):
            mine, theirs = (np.asarray(episode.read(path, slice(0, 1)), np.float64) for episode in (one, other))
            if mine.shape == theirs.shape:
                found.append(float(np.abs(mine - theirs).mean()))
    return max(found, default=None)
