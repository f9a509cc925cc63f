"""A rerun of the first run: the same policy calls under an intervention, which pair replan by replan."""

from __future__ import annotations

import polars as pl

from vla_attention.analyze.compare.runs import Run, RunsDiffer
from vla_attention.analyze.measures.frames import EPISODE_ID, Tables
from vla_attention.schemas.errors import listing
from vla_attention.schemas.safe_text import visible
from vla_attention.schemas.stores.store_format import episode_name

_REPLAN = [*EPISODE_ID, "replan", "layer"]


def is_rerun(first: Run, other: Run) -> bool:
    """Whether a run repeats the policy calls of the first one."""
    sources = [store.attributes.rerun_of for store in other.stores]
    runs = {store.run for store in first.stores}
    return all(source is not None and source.run in runs for source in sources)


def intervention_notes(first: Run, other: Run) -> list[str]:
    """A line on what the other run changed, or the first one; none where neither changed anything."""
    mine, theirs = (
        listing(dict.fromkeys(visible(store.attributes.interventions.describe()) for store in run.stores))
        for run in (first, other)
    )
    if is_rerun(first, other):
        return [f"{other.name} is a rerun of {first.name}: every replan is a pair. It changed: {theirs}."]
    return (
        [f"{first.name} and {other.name} differ in their interventions ({mine}; {theirs})."] if mine != theirs else []
    )


def with_paired_replans(first: Tables, other: Tables, name: str) -> tuple[Tables, Tables]:
    """Replans of a run and of its rerun (`aggregate.replan_tables`), with ratios where both have a finite one.

    A mean of differences over pairs of replans is then the difference of the means that each episode gets.

    Raises:
        RunsDiffer: an episode has other replans in the rerun, which is called `name`.
    """
    steps = [table.cells.select(*EPISODE_ID, "replan", "env_step").unique() for table in (first, other)]
    shared = steps[0].join(steps[1].select(EPISODE_ID).unique(), on=EPISODE_ID, how="semi")
    alone = [
        shared.join(steps[1], on=[*EPISODE_ID, "replan", "env_step"], how="anti"),
        steps[1]
        .join(shared.select(EPISODE_ID).unique(), on=EPISODE_ID, how="semi")
        .join(shared, on=[*EPISODE_ID, "replan", "env_step"], how="anti"),
    ]
    differing = pl.concat(alone).select("task_id", "episode_index").unique().sort("task_id", "episode_index")
    if differing.height:
        names = [episode_name(task, episode) for task, episode in differing.iter_rows()]
        raise RunsDiffer(
            f"{listing(names, 6)} of the rerun {name} has other replans than in its base; make the rerun again."
        )
    if "log2_ratio" not in first.cells.columns:
        return first, other
    has_ratio = pl.col("log2_ratio").is_finite().fill_null(False)
    having = [table.cells.filter(has_ratio).select(_REPLAN) for table in (first, other)]
    both = having[0].join(having[1], on=_REPLAN, how="inner").with_columns(pl.lit(True).alias("_both"))
    return _masked(first, both), _masked(other, both)


def _masked(table: Tables, both: pl.DataFrame) -> Tables:
    cells = table.cells.join(both, on=_REPLAN, how="left", maintain_order="left")
    kept = cells.with_columns(pl.when("_both").then("log2_ratio").alias("log2_ratio")).drop("_both")
    return Tables(kept, lambda: table.groups, table.parts)
