"""The numbers of one run beside those of the first one, paired where that is possible."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import polars as pl

from vla_attention.analyze.core.action_changes import units_of_recorded
from vla_attention.analyze.core.courses import PICTURES
from vla_attention.analyze.core.differences import (
    alone,
    differences,
    differences_unpaired,
    paired,
    pairing,
    pairs_of,
    ratios_of_shared_replans,
    values_of_groups,
)
from vla_attention.analyze.core.levels import SIDES, Levels, levels_of, task_cells, task_groups
from vla_attention.analyze.core.measure import measure, table_of
from vla_attention.analyze.core.object_shares import (
    ALL_CAMERAS,
    cameras_of,
    measure_objects,
    object_episodes,
    with_coverage,
)
from vla_attention.analyze.core.recorded_effects import recorded_effects
from vla_attention.analyze.core.runs import Run
from vla_attention.analyze.core.word_items import items_of
from vla_attention.analyze.measures.frames import EPISODE_ID, LAYERS_AVG
from vla_attention.analyze.measures.selected import SelectedEpisode
from vla_attention.analyze.statistics.units import Sampling
from vla_attention.schemas.errors import BadArgument

#: What is compared -> the columns that name an item of it, and inside of which looks are counted.
KINDS: Mapping[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "groups": (("layer", "quantity"), ("layer",)),
    "heads": (("layer", "head"), ()),
    "words": (("item",), ()),
    "objects": (("kind", "item"), ("kind",)),
    "effects": (("item_kind", "item", "reader"), ("reader",)),
}


@dataclass(frozen=True)
class RunValues:
    """What is measured of the episodes of a run.

    Attributes:
        run: the run.
        episodes: what pairs them, see `differences.pairing`.
        levels: the groups, heads kept apart.
    """

    run: Run
    episodes: pl.DataFrame
    levels: Levels

    @classmethod
    def of(cls, run: Run, ignore_seed: bool) -> RunValues:
        """Measure a run's groups; `ignore_seed`: episodes of different seeds may be pairs."""
        return cls(run, pairing(run, ignore_seed), levels_of(run.question, heads=True))

    @cached_property
    def values(self) -> Mapping[str, pl.DataFrame]:
        """By kind of `KINDS`, a table of values (see `differences`).

        Those of words and objects are log2 of their attention over what they would get if it were spread evenly.
        """
        tables = {"groups": values_of_groups(self.levels), "heads": self._heads()}
        if self.run.question.vocabulary.words:
            words = table_of(measure(self.run.question, items_of)).filter(pl.col("kind") == "word")
            tables["words"] = words.select(*EPISODE_ID, "item", value=pl.col("lift").log(2.0)).collect()
        if any(cameras_of(item) for item in self.run.question.selected):
            objects = object_episodes(measure_objects(with_coverage(self.run.question)))
            objects = objects.filter(camera=ALL_CAMERAS, layer=LAYERS_AVG)
            tables["objects"] = objects.select(
                *EPISODE_ID, "kind", "item", value=pl.col("enrichment").log(2.0)
            ).collect()
        return tables

    def _heads(self) -> pl.DataFrame:
        """`EPISODE_ID`, layer (a block), head, value: the part of the attention on one side of the ratio."""
        grouping = self.levels.grouping
        of_side = pl.col("group") == grouping.names[0] if grouping.ratio is None else pl.col("kind") == SIDES[0]
        rows = table_of(self.levels.measured, ("layer", "head")).filter(of_side, pl.col("layer") != LAYERS_AVG)
        values = rows.select(*EPISODE_ID, pl.col("block").alias("layer"), "head", value="share").collect()
        return values.unique([*EPISODE_ID, "layer", "head"], keep="first", maintain_order=True)


@dataclass(frozen=True)
class Compared:
    """A run beside the first one.

    Attributes:
        first, other: what was measured of both.
        pairs: of their episodes, see `differences.pairs_of`; without any, means of independent episodes are compared.
        rows: by kind, see `differences.differences`.
        values: by kind, both values of every pair.
    """

    first: RunValues
    other: RunValues
    pairs: pl.DataFrame
    rows: Mapping[str, pl.DataFrame]
    values: Mapping[str, pl.DataFrame]

    @property
    def name(self) -> str:
        """The name of the other run."""
        return self.other.run.name

    def alone(self) -> pl.DataFrame:
        """The episodes without a partner: run, compared_with, `EPISODE_ID`."""
        sides = {"first": (self.first, self.other), "other": (self.other, self.first)}
        return pl.concat(
            alone(one.episodes, self.pairs, side).select(
                pl.lit(one.run.name).alias("run"), pl.lit(against.run.name).alias("compared_with"), *EPISODE_ID
            )
            for side, (one, against) in sides.items()
        )


def compared(first: RunValues, other: RunValues, sampling: Sampling) -> Compared:
    """A run beside the first one; of a rerun, ratios are those of the replans in which both have one.

    Raises:
        RunsDiffer: a rerun has other replans than its base.
    """
    rerun = other.run.repeats(first.run)
    pairs = pairs_of(first.episodes, other.episodes, rerun)
    sides = [dict(first.values), dict(other.values)]
    if rerun:
        shared: Sequence[pl.DataFrame | None] = [None, None]
        if first.levels.grouping.ratio is not None:
            shared = ratios_of_shared_replans(first.levels, other.levels, other.run.name)
        of_groups = [values_of_groups(one.levels, ratios) for one, ratios in zip((first, other), shared, strict=True)]
        # Its success is that of its base, which it did not earn.
        sides = [
            {**side, "groups": groups.filter(pl.col("quantity") != "success")}
            for side, groups in zip(sides, of_groups, strict=True)
        ]
    if (effects := _effects(first.run, other.run)) is not None:
        for side, of_side in zip(sides, effects, strict=True):
            side["effects"] = of_side
    rows, values = {}, {}
    for kind, (item, looks) in KINDS.items():
        if not all(kind in side for side in sides):
            continue
        if pairs.height:
            values[kind] = paired(pairs, sides[0][kind], sides[1][kind], item)
            rows[kind] = differences(values[kind], item, sampling, looks)
        else:
            episodes = first.episodes, other.episodes
            rows[kind] = differences_unpaired(sides[0][kind], sides[1][kind], episodes, item, sampling, looks)
    return Compared(first, other, pairs, rows, values)


def _effects(first: Run, other: Run) -> tuple[pl.DataFrame, pl.DataFrame] | None:
    """log2 of the recorded effects of both runs on their actions; None where one recorded none.

    Each is in units of its own run's actions, over the dimensions that both compare.
    """
    if not all(store.attributes.recording.effects is not None for run in (first, other) for store in run.stores):
        return None
    questions = [run.question for run in (first, other)]
    try:
        units = [units_of_recorded(*one.stores, skip_corrupt=one.settings.skip_corrupt) for one in questions]
        used = units[0].used & units[1].used
        found = [
            recorded_effects(one, attention=False, spread=replace(unit, used=used))
            for one, unit in zip(questions, units, strict=True)
        ]
    except BadArgument:  # the question `effects` says why none is shown
        return None
    tables = []
    for one in found:
        assert one is not None
        rows = one.episodes().filter(pl.col("kind").is_in(["without", "prompt", "image"]))
        rows = rows.with_columns(pl.col("reader").fill_null("total"))
        # An episode has few words to exchange: all together they say what none of them shows.
        exchanged = rows.filter(kind="prompt", reader="total").group_by(EPISODE_ID).agg(pl.mean("effect"))
        exchanged = exchanged.with_columns(
            item_kind=pl.lit("exchange"), item=pl.lit("any word exchanged"), reader=pl.lit("total")
        )
        rows = pl.concat([exchanged, rows.filter(pl.col("reader").is_in(["total", "direct"]))], how="diagonal")
        tables.append(rows.select(*EPISODE_ID, "item_kind", "item", "reader", value=pl.col("effect").log(2.0)))
    return tables[0], tables[1]


def strip_of_pair(
    part: Compared, told_first: pl.DataFrame, told_other: pl.DataFrame
) -> tuple[tuple[SelectedEpisode, SelectedEpisode], pl.DataFrame]:
    """A pair of episodes, one that ended otherwise if there is one, and three moments of both.

    Returns:
        The two episodes; and one row per picture: row (0: the first run, 1: the other), column, above, replan, camera;
        none where the stores have no pictures.
    """
    keys, pairs = ["suite", "task_id"], part.pairs
    for side, told in (("first", told_first), ("other", told_other)):
        did = told.select(*keys, pl.col("episode_index").alias(f"episode_{side}"), pl.col("did").alias(f"did_{side}"))
        pairs = pairs.join(did, on=[*keys, f"episode_{side}"], how="left", maintain_order="left")
    pair = pairs.sort(pl.col("did_first").eq_missing(pl.col("did_other")), maintain_order=True).row(0, named=True)
    items, rows = [], []
    for row, (side, of) in enumerate((("first", part.first), ("other", part.other))):
        key = (pair["suite"], pair["task_id"], pair[f"episode_{side}"])
        named = {item.key: item for item in of.run.question.selected}
        items.append(item := named[key])
        last, steps = item.episode.attributes.num_replans - 1, item.episode.attributes.env_step
        cameras = [camera.name for camera in item.store.attributes.policy.cameras]
        camera = next((name for name in cameras if item.episode.has(f"frames/{name}")), None)
        for column, replan in enumerate(sorted({0, last // 2, last}) if camera else []):
            rows.append((row, column, f"{of.run.name}, step {steps[replan] - steps[0]}", replan, camera))
    return (items[0], items[1]), pl.DataFrame(rows, schema=PICTURES, orient="row")


def side_by_side(part: Compared, told: Mapping[str, pl.DataFrame]) -> pl.DataFrame | None:
    """What both runs did in the same episodes, counted; those in which they did not do the same come first.

    told: by run, the rows of `behaviour`.

    Returns:
        run, told, touched_first, did_first, touched_other, did_other, episodes; None where no steps are known.
    """
    rows = part.pairs
    for side, name in (("first", part.first.run.name), ("other", part.name)):
        frame = told[name].select(*EPISODE_ID, *(["told"] if side == "first" else []), "did", "touched")
        named = frame.rename({"episode_index": f"episode_{side}", "did": f"did_{side}", "touched": f"touched_{side}"})
        rows = rows.join(named, on=["suite", "task_id", f"episode_{side}"], how="inner")
    if rows.is_empty():
        return None
    what = ("told", "touched_first", "did_first", "touched_other", "did_other")
    counted = rows.group_by(pl.lit(part.name).alias("run"), *what).agg(pl.len().alias("episodes"))
    same = pl.col("did_first").eq_missing(pl.col("did_other"))
    return counted.sort(same, "episodes", *what, descending=[False, True, *(False for _ in what)], nulls_last=True)


def by_themselves(base: RunValues, rest: Sequence[RunValues], sampling: Sampling) -> tuple[pl.DataFrame, pl.DataFrame]:
    """`levels.task_cells` and `levels.task_groups` of every run, with a column `run`; reruns have no outcome."""
    cells, groups = [], []
    for one in (base, *rest):
        name = pl.lit(one.run.name).alias("run")
        tasks = task_cells(one.levels.episodes(), sampling).select(name, pl.all())
        repeats = one is not base and one.run.repeats(base.run)
        cells.append(tasks.with_columns(success_rate=pl.lit(None, pl.Float64)) if repeats else tasks)
        groups.append(task_groups(one.levels.episodes_groups(), sampling).select(name, pl.all()))
    return pl.concat(cells, how="diagonal"), pl.concat(groups, how="diagonal")
