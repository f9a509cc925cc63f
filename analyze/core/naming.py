"""Does attention go to what the instruction names, or to what is there? Named against not named, at the first call.

At the first policy call of an episode the hand has not moved: later it goes to what is named, and attention that
follows the hand follows the name with it. An object that a sentence names is compared with the same object in episodes
of other tasks, which do not name it. With x of an object in an episode, N the objects that its sentence names, and m(o)
the mean over the other tasks of the means of x(o) over their episodes that do not name o,

    an episode's log ratio = mean over o in N of x(o) - m(o)

and the answer is the mean over tasks of its means over episodes. Nothing but the sentence differs in the first form:

    same state    m is over episodes that begin in the same initial state (the same pictures); x is the logarithm of the
                  object's share of the attention to all pictures.
    other tasks   where no two tasks share a state, m is over the whole suite; x is the logarithm of what the map gives
                  the object over what the same map gives the places where the object stands in the task's other
                  episodes (`object_maps.over_place`). An object that all tasks name, or of which an instance is always
                  named (`bowl_1` of `bowl_1`, `bowl_2`), is compared by its kind: the name without the number.

An object, or kind, that is never unnamed shows nothing, nor does a sentence that names everything. Episodes are used as
what is compared and as what it is compared with, so errors come from leaving one out (`statistics.left_out`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal, TypeAlias

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.core.behaviour import named_things, told_goal
from vla_attention.analyze.core.estimate import estimate
from vla_attention.analyze.core.measure import Measured
from vla_attention.analyze.core.object_maps import ObjectMaps, look_at_maps, over_place
from vla_attention.analyze.core.object_shares import (
    ALL_CAMERAS,
    look_at_objects,
    object_times,
    positions_with_coverage,
    with_coverage,
)
from vla_attention.analyze.measures.masses import finite_mean
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.measures.scan import Look, scan
from vla_attention.analyze.measures.selected import SelectedEpisode
from vla_attention.analyze.measures.tables import EPISODE_ID, LAYERS_AVG
from vla_attention.analyze.statistics.left_out import pseudo_values
from vla_attention.analyze.statistics.units import Units
from vla_attention.analyze.stores.run_notes import same_words, told_instruction

Array: TypeAlias = NDArray[np.float64]
Form: TypeAlias = Literal["same state", "other tasks"]
#: Stands for all named objects together in the column `item`.
ALL_NAMED = "what is named"
_COMPARED = ("object", "fixture")


@dataclass(frozen=True)
class Naming:
    """Named against not named.

    Attributes:
        form: which comparison it is; None: there is none.
        rows: one row per (camera or all together, `ALL_NAMED` and then every object): ratio (attention when named over
            when not) with its interval, its q over the objects of the camera, num_episodes, num_tasks.
        episodes: `EPISODE_ID`, log_ratio of each episode whose sentence names something that is compared, all cameras
            together.
        always: objects or kinds that are named wherever they are.
    """

    form: Form | None
    rows: pl.DataFrame
    episodes: pl.DataFrame
    always: tuple[str, ...]

    @property
    def answer(self) -> dict[str, Any]:
        """The row of what is named, all cameras together, of a form that is not None."""
        return self.rows.row(by_predicate=(pl.col("camera") == ALL_CAMERAS) & (pl.col("item") == ALL_NAMED), named=True)


def told_things(item: SelectedEpisode) -> set[str] | None:
    """The objects that the episode's sentence names; None where nobody knows which."""
    attributes = item.episode.attributes
    told, change = told_instruction(item.store, attributes), item.store.attributes.interventions.prompt
    if same_words(told, attributes.instruction):
        return named_things(attributes, None)
    if attributes.steps is None:
        return None
    aim = told_goal(attributes, attributes.steps, told)
    if aim is None and change is not None and change.kind == "synonyms":
        return named_things(attributes, None)
    return None if aim is None else named_things(attributes, aim)


def first_calls(measured: Sequence[Measured]) -> pl.DataFrame:
    """`object_shares.object_times` of single objects at the first policy call of each episode."""
    return object_times(measured).filter(pl.col("replan") == 0, pl.col("kind") == "object").collect()


def naming(question: Question, measured: Sequence[Measured], found: Sequence[ObjectMaps]) -> Naming:
    """Named against not named in the episodes of a question `with_coverage`.

    Args:
        question: its episodes.
        measured: what `look_at_objects` found in them.
        found: what `look_at_maps` found in them, heads and layers together.
    """
    cases = _cases(question)
    kinds = by_kind(cases.with_columns(camera=pl.lit(ALL_CAMERAS), x=pl.lit(0.0)))
    always = tuple(kinds.filter(pl.col("named").all().over("suite", "item"))["item"].unique().sort())
    shares = first_calls(measured)
    one = in_same_states(question, shares.select(*EPISODE_ID, "camera", "item", x=pl.col("share").log()), always)
    if one.form is not None or cases.is_empty():
        return one
    x = over_place(question, found).filter(kind="object", layer=LAYERS_AVG)
    x = x.select(*EPISODE_ID, "camera", "item", x=(pl.col("at_place") / pl.col("elsewhere")).log())
    kinds = by_kind(cases.join(x, on=[*EPISODE_ID, "item"]))
    return _compared(question, "other tasks", kinds.with_columns(stratum="suite"), always)


def in_same_states(question: Question, x: pl.DataFrame, always: tuple[str, ...] = ()) -> Naming:
    """Named against not named in episodes that begin in the same state.

    Args:
        question: its episodes.
        x: EPISODE_ID, camera, item, x: the logarithm of what is compared, at the first policy call.
        always: see `Naming`.
    """
    states = _cases(question).filter(pl.col("state") != "").join(x, on=[*EPISODE_ID, "item"])
    states = states.with_columns(stratum=pl.concat_str("suite", "state", separator=" "))
    return _compared(question, "same state", states, always)


@dataclass(frozen=True)
class ObjectAttention:
    """What objects get in the episodes whose coverage is known: their question, masses and maps."""

    question: Question
    measured: Sequence[Measured]
    maps: Sequence[ObjectMaps]

    @classmethod
    def of(cls, question: Question, measured: Sequence[Measured], maps: Sequence[ObjectMaps]) -> ObjectAttention:
        """What the looks of `looks_at_objects` found."""
        return cls(with_coverage(question), measured, maps)

    @classmethod
    def measured_in(cls, question: Question) -> ObjectAttention | None:
        """That of a question, measured now; None without object coverage."""
        looks = looks_at_objects(question)
        return cls.of(question, *scan(question, looks)) if looks else None


def looks_at_objects(question: Question) -> list[Look[Any]]:
    """The looks that `ObjectAttention` takes; none without object coverage."""
    having = positions_with_coverage(question)
    if not having:
        return []
    maps = look_at_maps(question, heads=False, layers=False, iou=False, positions=having)
    return [look_at_objects(question, positions=having), maps]


def named_in(objects: ObjectAttention) -> list[Naming]:
    """`naming` of each suite, where it shows something."""
    found = []
    for suite in dict.fromkeys(item.store.suite for item in objects.question.selected):
        own = [i for i, item in enumerate(objects.question.selected) if item.store.suite == suite]
        of_suite = replace(objects.question, selected=tuple(objects.question.selected[i] for i in own))
        one = naming(of_suite, [objects.measured[i] for i in own], [objects.maps[i] for i in own])
        found += [one] if one.form is not None else []
    return found


def _cases(question: Question) -> pl.DataFrame:
    """EPISODE_ID, state, item, named: of every object in episodes whose sentence names some of them and not all."""
    rows = []
    for item in question.selected:
        things = {thing.name for thing in item.tokens.objects if thing.kind in _COMPARED}
        named, state = told_things(item), item.episode.attributes.initial_state_digest
        if named is not None and things & named and things - named:
            rows += [(*item.key, state, thing, thing in named) for thing in sorted(things)]
    schema = {"suite": pl.String, "task_id": pl.Int64, "episode_index": pl.Int64, "state": pl.String,
              "item": pl.String, "named": pl.Boolean}  # fmt: skip
    return pl.DataFrame(rows, schema=schema, orient="row")


def by_kind(rows: pl.DataFrame) -> pl.DataFrame:
    """The rows, those of a kind as one if an object of the kind is always named: the mean of the named ones, if any."""
    rows = rows.with_columns(kind=pl.col("item").str.replace(r"_\d+$", ""))
    rows = rows.with_columns(always=pl.col("named").all().over("suite", "item"))
    whole = pl.col("always").any().over("suite", "kind")
    rows = rows.with_columns(item=pl.when(whole).then("kind").otherwise("item"))
    x = pl.when(pl.col("named").any()).then(pl.col("x").filter("named").mean()).otherwise(pl.mean("x"))
    return rows.group_by(*EPISODE_ID, "camera", "item", maintain_order=True).agg(pl.col("named").any(), x)


def _compared(question: Question, form: Form, rows: pl.DataFrame, always: tuple[str, ...]) -> Naming:
    """Named against not named within strata: EPISODE_ID, stratum, camera, item, named, x."""
    parts, episodes = [], []
    for camera, part in rows.group_by("camera", maintain_order=True):
        one = _Cells.of(question, part)
        shown = [i for i, column in enumerate(np.isfinite(one.found()).T) if column.any()]
        for name, chosen in ((ALL_NAMED, shown), *((one.items[i], [i]) for i in shown)) if shown else ():
            logs = pseudo_values(partial(one.statistic, chosen), one.units)
            parts.append(one.rows(logs).with_columns(camera=pl.lit(camera[0]), item=pl.lit(name)))
        if camera[0] == ALL_CAMERAS:
            episodes.append(one.rows(finite_mean(one.found(), axis=1)))
    if not parts:
        return Naming(None, pl.DataFrame(), pl.DataFrame(), always)
    table = pl.concat(parts).with_columns(ratio=pl.col("log_ratio").exp(), whole=pl.col("item") == ALL_NAMED)
    found = estimate(table, ["camera", "whole", "item"], {"ratio": "geometric"}, question.sampling, {"ratio": 1.0},
                     ["camera", "whole"])  # fmt: skip
    return Naming(form, found.drop("whole"), pl.concat(episodes), always)


@dataclass(frozen=True)
class _Cells:
    """One camera's values: x and whether it is named, (episode, item) each; and the stratum of every episode."""

    ids: pl.DataFrame
    items: Sequence[str]
    values: Array
    named: NDArray[np.bool_]
    strata: NDArray[np.intp]
    units: Units

    @classmethod
    def of(cls, question: Question, rows: pl.DataFrame) -> _Cells:
        ids = rows.select(*EPISODE_ID, "stratum").unique().sort(EPISODE_ID)
        items = sorted(rows["item"].unique())
        place = {key: i for i, key in enumerate(ids.select(EPISODE_ID).iter_rows())}
        values, named = np.full((ids.height, len(items)), np.nan), np.zeros((ids.height, len(items)), dtype=bool)
        for *key, item, is_named, x in rows.select(*EPISODE_ID, "item", "named", "x").iter_rows():
            at = place[tuple(key)], items.index(item)
            values[at], named[at] = np.nan if x is None else x, is_named
        strata = ids["stratum"].rank("dense").to_numpy().astype(np.intp) - 1
        return cls(ids, items, values, named, strata, question.sampling.units(ids))

    def found(self, kept: NDArray[np.bool_] | None = None) -> Array:
        """`differences`, of the episodes that are kept; (episode, item)."""
        kept = np.ones(len(self.strata), dtype=bool) if kept is None else kept
        return differences(self.values, self.named, self.strata, self.units.tasks, kept)

    def statistic(self, items: Sequence[int], kept: NDArray[np.bool_]) -> float:
        """The mean over tasks of the means over episodes of the means over items; NaN: none is named and compared."""
        of_episode = finite_mean(self.found(kept)[:, list(items)], axis=1)
        known = np.isfinite(of_episode)
        number, sums = (np.bincount(self.units.tasks[known], weights) for weights in (None, of_episode[known]))
        return float((sums[number > 0] / number[number > 0]).mean()) if known.any() else float("nan")

    def rows(self, logs: Array) -> pl.DataFrame:
        """EPISODE_ID, log_ratio of the episodes that have one."""
        return self.ids.select(*EPISODE_ID, log_ratio=pl.Series(logs)).filter(pl.col("log_ratio").is_finite())


def differences(
    values: Array,
    named: NDArray[np.bool_],
    strata: NDArray[np.intp],
    tasks: NDArray[np.intp],
    kept: NDArray[np.bool_],
) -> Array:
    """What named objects have above their means in the other tasks of the stratum that do not name them.

    Args:
        values: (episode, object), NaN where there is none.
        named: (episode, object).
        strata, tasks: numbers from 0, (episode,).
        kept: the episodes that are used, (episode,).

    Returns:
        (episode, object); NaN where an object is not named, or named in all other tasks.
    """
    known = np.isfinite(values) & kept[:, None]
    shape = (strata.max() + 1, tasks.max() + 1, values.shape[1])
    total, number = np.zeros(shape), np.zeros(shape)
    np.add.at(total, (strata, tasks), np.where(known & ~named, values, 0.0))
    np.add.at(number, (strata, tasks), known & ~named)
    with np.errstate(invalid="ignore", divide="ignore"):
        there, mean = number > 0, np.where(number > 0, total / number, 0.0)
        others = (mean.sum(axis=1)[strata] - mean[strata, tasks]) / (there.sum(axis=1)[strata] - there[strata, tasks])
        return np.where(known & named, values - others, np.nan)


def at_objects(question: Question, measured: Sequence[Measured], found: Sequence[ObjectMaps]) -> dict[str, Any]:
    """What objects get at the first call, named or not: `estimate`'s row of over_area and over_place.

    Empty where pictures show none beside the robot and the background. Of an episode each is the geometric mean over
    its objects, all cameras together.
    """
    keys = [*EPISODE_ID, "item"]
    things = [(*item.key, one.name) for item in question.selected for one in item.tokens.objects
              if one.kind in _COMPARED]  # fmt: skip
    rows = first_calls(measured).filter(camera=ALL_CAMERAS)
    rows = rows.join(pl.DataFrame(things, schema=rows.select(keys).schema, orient="row"), on=keys, how="semi")
    place = over_place(question, found).filter(camera=ALL_CAMERAS, kind="object", layer=LAYERS_AVG)
    rows = rows.join(place, on=keys, how="left")
    logs = {"over_area": pl.col("share") / pl.col("even_share"), "over_place": pl.col("at_place") / pl.col("elsewhere")}
    means = [(log := value.log()).filter(log.is_finite()).mean().exp().alias(name) for name, value in logs.items()]
    episodes = rows.group_by(EPISODE_ID, maintain_order=True).agg(means).with_columns(one=pl.lit(1))
    seen = episodes.drop_nulls("over_area")
    return next(estimate(seen, ["one"], dict.fromkeys(logs, "geometric"), question.sampling).iter_rows(named=True), {})


def course(question: Question, measured: Sequence[Measured]) -> pl.DataFrame:
    """By policy call what objects get over their area, all cameras together: replan, which, `estimate` of enrichment.

    which: "named" or "others", in the episodes whose sentence names some objects and not all; geometric means.
    """
    rows = object_times(measured).filter(pl.col("camera") == ALL_CAMERAS, pl.col("kind") == "object").collect()
    rows = rows.join(_cases(question), on=[*EPISODE_ID, "item"]).filter(pl.col("share") > 0)
    which = pl.when("named").then(pl.lit("named")).otherwise(pl.lit("others")).alias("which")
    log = (pl.col("share") / pl.col("even_share")).log()
    each = rows.group_by(*EPISODE_ID, "replan", which).agg(enrichment=log.mean().exp())
    each = each.sort("replan", "which", *EPISODE_ID)
    return estimate(each, ["replan", "which"], {"enrichment": "geometric"}, question.sampling)
