"""What differs between the episodes of two runs: within pairs, or where none pairs between independent episodes.

Two episodes are a pair when suite, task, initial state (by its digest) and seed are equal: the same scene, the same
noise, other weights. A rerun repeats the calls of its base, and pairs by episode. Differences within pairs do not
contain differences between scenes. Every difference is the other run's value minus the first one's.

A table of values has one row per (episode, item): `EPISODE_ID`, the columns of the item, `value`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import polars as pl

from vla_attention.analyze.core.estimate import estimate, with_q
from vla_attention.analyze.core.levels import Levels
from vla_attention.analyze.core.runs import Run, RunsDiffer
from vla_attention.analyze.measures.frames import EPISODE_ID, LAYERS_AVG, float_values
from vla_attention.analyze.statistics.two_samples import mean_difference
from vla_attention.analyze.statistics.units import Sampling
from vla_attention.schemas.errors import listing
from vla_attention.schemas.stores.store_format import episode_name

#: Two episodes with equal values here are a pair; `occurrence` counts the episodes of a run with the same first state.
PAIR = ("suite", "task_id", "initial_state_digest", "seed", "occurrence")
_TASK = ["suite", "task_id", "instruction"]
_SIDES = {"first": "plain", "other": "plain", "difference": "plain"}


def pairing(run: Run, ignore_seed: bool) -> pl.DataFrame:
    """`EPISODE_ID`, instruction and `PAIR` of each selected episode; of other seeds too where they may differ."""
    rows = [
        (
            *item.key,
            item.episode.attributes.instruction,
            item.episode.attributes.initial_state,
            0 if ignore_seed else item.store.attributes.protocol.seed,
        )
        for item in run.question.selected
    ]
    schema = {
        "suite": pl.String, "task_id": pl.Int64, "episode_index": pl.Int64, "instruction": pl.String,
        "initial_state_digest": pl.String, "seed": pl.Int64,
    }  # fmt: skip
    frame = pl.DataFrame(rows, schema=schema, orient="row")
    return frame.with_columns(occurrence=pl.col("episode_index").rank("ordinal").over(PAIR[:-1]).cast(pl.Int64))


def pairs_of(first: pl.DataFrame, other: pl.DataFrame, rerun: bool) -> pl.DataFrame:
    """The pairs of two runs, from `pairing` of each.

    Returns:
        `PAIR`, instruction, episode_first, episode_other.
    """
    mine = first.rename({"episode_index": "episode_first"})
    theirs = other.rename({"episode_index": "episode_other"}).drop("instruction")
    keys = list(PAIR)
    if rerun:
        theirs = theirs.drop("occurrence").with_columns(episode_first="episode_other")
        keys[-1] = "episode_first"
    return mine.join(theirs, on=keys, how="inner").sort("suite", "task_id", "episode_first")


def alone(episodes: pl.DataFrame, pairs: pl.DataFrame, side: str) -> pl.DataFrame:
    """`EPISODE_ID` of the episodes of one side ("first" or "other") that are in no pair."""
    paired = pairs.select("suite", "task_id", pl.col(f"episode_{side}").alias("episode_index"))
    return episodes.join(paired, on=EPISODE_ID, how="anti", maintain_order="left").select(EPISODE_ID)


def paired(pairs: pl.DataFrame, first: pl.DataFrame, other: pl.DataFrame, item: Sequence[str]) -> pl.DataFrame:
    """The values of both episodes of every pair, and their difference: the pair, the item, first, other, difference."""
    joined = pairs
    for side, values in (("first", first), ("other", other)):
        keys = [*(["suite", "task_id", f"episode_{side}"]), *(item if side == "other" else ())]
        of_side = values.select(
            "suite", "task_id", pl.col("episode_index").alias(f"episode_{side}"), *item, pl.col("value").alias(side)
        )
        joined = joined.join(of_side, on=keys, how="inner", nulls_equal=True, maintain_order="left_right")
    return joined.with_columns(difference=pl.col("other") - pl.col("first"))


def differences(
    joined: pl.DataFrame, item: Sequence[str], sampling: Sampling, looks: Sequence[str] = (), null: float = 0.0
) -> pl.DataFrame:
    """Mean differences of pairs (`paired`) for every item, by task, by suite where there are several, and over all.

    looks: columns of `item`; one look for each value of the others is counted in `difference_q` over all tasks, and one
    for each task in those of tasks (Benjamini-Hochberg).

    Returns:
        One row per (scope, item): scope "task", "suite" or "all"; suite, task_id, instruction; paired; num_tasks,
        num_families, intervals; num_first, num_other, the episodes; mean_first, mean_other, and `difference` with
        `difference_low`, `difference_high` and `difference_q`, of none.
    """
    known, found = joined.filter(pl.col("difference").is_finite()), []
    for scope, names in _scopes(joined):
        of = item if scope == "task" else [*(["suite"] if scope == "suite" else []), *looks]
        rows = estimate(known, [*names, *item], _SIDES, sampling, {"difference": null}, of)  # type: ignore[arg-type]
        found.append(rows.with_columns(scope=pl.lit(scope), paired=pl.lit(True), num_first="num_episodes"))
    rows = pl.concat(found, how="diagonal").rename({"first": "mean_first", "other": "mean_other"})
    rows = rows.with_columns(num_other="num_episodes").drop("num_episodes")
    return _in_order(rows.drop("first_low", "first_high", "other_low", "other_high"), joined, item)


def differences_unpaired(
    first: pl.DataFrame,
    other: pl.DataFrame,
    episodes: tuple[pl.DataFrame, pl.DataFrame],
    item: Sequence[str],
    sampling: Sampling,
    looks: Sequence[str] = (),
) -> pl.DataFrame:
    """As `differences`, of means of independent episodes; `episodes`: both runs' `pairing`.

    A task that both runs have moves both means, and its difference has less noise than that of two different tasks.
    """
    both = pl.concat(
        [
            table.join(of.select(*EPISODE_ID, "instruction"), on=EPISODE_ID).with_columns(_other=pl.lit(number == 1))
            for number, (table, of) in enumerate(zip((first, other), episodes, strict=True))
        ]
    )
    found = []
    for scope, names in _scopes(both):
        rows = []
        for part in both.partition_by([*names, *item], maintain_order=True):
            is_other, units = part["_other"].to_numpy(), sampling.units(part)
            if is_other.all() or not is_other.any():
                continue  # a task of one run only
            one = mean_difference(float_values(part["value"]), is_other, units)
            low, high = one.difference.interval() or (None, None)
            rows.append(
                {**part.select(*names, *item).row(0, named=True), "num_tasks": units.num_tasks, **units.about}
                | {"intervals": one.estimand.value, "num_first": one.num_second, "num_other": one.num_first}
                | {"mean_first": one.mean_second, "mean_other": one.mean_first, "difference": one.difference.value}
                | {"difference_low": low, "difference_high": high, "difference_p": one.difference.p_value(0.0)}
            )
        if rows:
            of = item if scope == "task" else [*(["suite"] if scope == "suite" else []), *looks]
            frame = pl.DataFrame(rows, infer_schema_length=None)
            found.append(with_q(frame, "difference", of).with_columns(scope=pl.lit(scope), paired=pl.lit(False)))
    return _in_order(pl.concat(found, how="diagonal_relaxed"), both, item)


def _scopes(rows: pl.DataFrame) -> list[tuple[str, list[str]]]:
    several = rows["suite"].n_unique() > 1
    return [("task", _TASK), *([("suite", ["suite"])] if several else []), ("all", [])]


def _in_order(rows: pl.DataFrame, of: pl.DataFrame, item: Sequence[str]) -> pl.DataFrame:
    """With the names of tasks as columns in front, and the suite where it is the only one."""
    missing = [pl.lit(None, of.schema[name]).alias(name) for name in _TASK if name not in rows.columns]
    rows = rows.with_columns(missing)
    if of["suite"].n_unique() == 1:
        rows = rows.with_columns(suite=pl.lit(of["suite"][0]))
    front = ["scope", *_TASK, *item, "paired", "num_tasks", "num_families", "intervals", "num_first", "num_other"]
    return rows.select(*front, "mean_first", "mean_other", pl.col(r"^difference.*$"))


def values_of_groups(levels: Levels, log2_ratio: pl.DataFrame | None = None) -> pl.DataFrame:
    """One row per (episode, layer, quantity): log2_ratio, then GROUP_fraction of every group, then success.

    Two runs may name a block by different numbers (7 and 25): `layer` is the block's number as text, or "layers_avg".

    Args:
        levels: the measured groups.
        log2_ratio: `EPISODE_ID`, layer and value, if the ratio is not that of all replans.
    """
    cells, place = levels.episodes(), [*EPISODE_ID, "layer", "block"]
    parts = []
    if levels.grouping.ratio is not None:
        ratios = cells.select(*place, value=pl.col("log_ratio_mean") / np.log(2.0))
        if log2_ratio is not None:
            ratios = ratios.drop("value").join(log2_ratio, on=place[:-1], how="left", maintain_order="left")
        parts.append(ratios.with_columns(quantity=pl.lit("log2_ratio")))
    groups = levels.episodes_groups()
    with_mass = groups.group_by("group").agg(pl.col("mass").max()).filter(pl.col("mass") > 0)["group"]
    groups = groups.filter(pl.col("group").is_in(with_mass.implode()))
    parts.append(groups.select(*place, value="fraction", quantity=pl.format("{}_fraction", "group")))
    parts.append(cells.select(*place, value=pl.col("success").cast(pl.Float64), quantity=pl.lit("success")))
    of_block = pl.when(pl.col("layer") == LAYERS_AVG).then("layer").otherwise(pl.col("block").cast(pl.String))
    values = pl.concat([part.select(*place, "quantity", "value") for part in parts]).with_columns(layer=of_block)
    return values.unique([*EPISODE_ID, "layer", "quantity"], keep="first", maintain_order=True)


def ratios_of_shared_replans(first: Levels, other: Levels, name: str) -> tuple[pl.DataFrame, pl.DataFrame]:
    """log2 of the ratio of a run and of its rerun, means over the replans in which both have a finite one.

    Returns:
        For each run `EPISODE_ID`, layer, value.

    Raises:
        RunsDiffer: an episode has other replans in the rerun, which is called `name`.
    """
    key = [*EPISODE_ID, "replan", "env_step", "layer"]
    tables = [levels.replans().select(*key, pl.col("log2_ratio").alias("value")).collect() for levels in (first, other)]
    shared = tables[0].join(tables[1].select(EPISODE_ID).unique(), on=EPISODE_ID, how="semi")
    theirs = tables[1].join(shared.select(EPISODE_ID).unique(), on=EPISODE_ID, how="semi")
    unlike = pl.concat([one.join(two, on=key, how="anti") for one, two in ((shared, theirs), (theirs, shared))])
    if unlike.height:
        episodes = unlike.select("task_id", "episode_index").unique().sort("task_id", "episode_index")
        names = [episode_name(task, episode) for task, episode in episodes.iter_rows()]
        raise RunsDiffer(
            f"{listing(names, 6)} of the rerun {name} has other replans than in its base; make the rerun again."
        )
    finite = [one.filter(pl.col("value").is_finite()) for one in (shared, theirs)]
    both = finite[0].join(finite[1].select(key), on=key, how="semi").select(key)
    return tuple(  # type: ignore[return-value]
        one.join(both, on=key, how="semi").group_by(*EPISODE_ID, "layer", maintain_order=True).agg(pl.mean("value"))
        for one in finite
    )
