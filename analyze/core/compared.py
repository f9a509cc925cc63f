"""The numbers of one run beside those of the first one: within pairs, or where none pairs of independent episodes.

Differences within pairs (`core.pairs`) do not contain differences between scenes. A rerun repeats the calls of its
base, and pairs by episode. Every difference is the other run's value minus the first one's.

A table of values has one row per (episode, item): `EPISODE_ID`, the columns of the item, `value`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import polars as pl

from vla_attention.analyze.core.action_changes import ActionUnits, units_of
from vla_attention.analyze.core.courses import strip
from vla_attention.analyze.core.estimate import Scale, estimate, with_q
from vla_attention.analyze.core.levels import SIDES, Levels, look_at_groups, task_cells, task_groups
from vla_attention.analyze.core.measure import Measured, look_at, table_of
from vla_attention.analyze.core.naming import Naming, ObjectAttention, looks_at_objects, named_in
from vla_attention.analyze.core.object_shares import object_values
from vla_attention.analyze.core.pairs import MOST_APART, pairing, pairs_of, with_first_pictures
from vla_attention.analyze.core.patch_maps import calls_of_maps, episodes_of_maps, map_of, patch_maps
from vla_attention.analyze.core.recorded_effects import ITEM, recorded_effects
from vla_attention.analyze.core.runs import Run, RunsDiffer
from vla_attention.analyze.core.word_items import items_of
from vla_attention.analyze.measures.scan import scan
from vla_attention.analyze.measures.selected import SelectedEpisode
from vla_attention.analyze.measures.tables import EPISODE_ID, LAYERS_AVG, float_values
from vla_attention.analyze.statistics.two_samples import mean_difference
from vla_attention.analyze.statistics.units import Sampling
from vla_attention.schemas.errors import BadArgument, listing
from vla_attention.schemas.stores.store_format import episode_name

#: What is compared -> the columns that name an item of it, and inside of which looks are counted.
KINDS: Mapping[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "groups": (("layer", "quantity"), ("layer",)),
    "heads": (("layer", "head"), ()),
    "words": (("item",), ()),
    "objects": (("item",), ()),
    "effects": ((*ITEM, "reader"), ("reader",)),
    "maps": (("item",), ()),
}
_TASK = ["suite", "task_id", "instruction"]
#: In units of an action: what float32 rounds off one. No effect to the bit (a deaf policy) counts as this.
_LEAST_EFFECT = 1e-6


@dataclass(frozen=True)
class RunValues:
    """What is measured of the episodes of a run.

    Attributes:
        run: the run.
        episodes: what pairs them, see `pairing`.
        levels: the groups, heads kept apart.
        words: every word; None where the site spells none.
        objects: what objects get; None without object coverage.
    """

    run: Run
    episodes: pl.DataFrame
    levels: Levels
    words: Sequence[Measured] | None
    objects: ObjectAttention | None

    @classmethod
    def of(cls, run: Run, ignore_seed: bool) -> RunValues:
        """Measure a run's groups, words and objects; `ignore_seed`: episodes of different seeds may be pairs."""
        question = run.question
        words = [look_at(question, items_of)] if question.vocabulary.words else []
        objects = looks_at_objects(question)
        groups, *rest = scan(question, [look_at_groups(question, heads=True), *words, *objects])
        found = ObjectAttention.of(question, *rest[len(words) :]) if objects else None
        levels = Levels(question, groups, heads=True)
        return cls(run, pairing(run, ignore_seed), levels, rest[0] if words else None, found)

    @cached_property
    def values(self) -> Mapping[str, pl.DataFrame]:
        """By kind of `KINDS`, a table of values (see the module).

        Those of words and objects are log2 of their attention over what they would get if it were spread evenly.
        """
        tables = {"groups": values_of_groups(self.levels), "heads": self._heads()}
        if self.words is not None:
            words = table_of(self.words).filter(pl.col("kind") == "word")
            tables["words"] = words.select(*EPISODE_ID, "item", value=pl.col("lift").log(2.0)).collect()
        if self.objects is not None:
            tables["objects"] = object_values(self.objects.measured)
        return tables

    @cached_property
    def named(self) -> Sequence[Naming]:
        """What is named against what is not, of each suite in which something shows it."""
        return [] if self.objects is None else named_in(self.objects)

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
        pairs: of their episodes, see `core.pairs`; without any, means of independent episodes are compared.
        refuted: what would be pairs, but for the pictures that they begin with.
        rows: by kind, see `differences`.
        values: by kind, both values of every pair.
        units: of recorded effects; None where one of the runs has none.
    """

    first: RunValues
    other: RunValues
    pairs: pl.DataFrame
    rows: Mapping[str, pl.DataFrame]
    values: Mapping[str, pl.DataFrame]
    units: ActionUnits | None = None
    refuted: pl.DataFrame = field(default_factory=pl.DataFrame)

    @property
    def name(self) -> str:
        """The name of the other run."""
        return self.other.run.name

    def alone(self) -> pl.DataFrame:
        """The episodes without a partner: run, compared_with, `EPISODE_ID`."""
        found = []
        for side, one, against in (("first", self.first, self.other), ("other", self.other, self.first)):
            paired = self.pairs.select("suite", "task_id", episode_index=f"episode_{side}")
            rest = one.episodes.join(paired, on=EPISODE_ID, how="anti", maintain_order="left")
            found.append(rest.select(run=pl.lit(one.run.name), compared_with=pl.lit(against.run.name), **_SAME_NAMES))
        return pl.concat(found)


_SAME_NAMES = {name: pl.col(name) for name in EPISODE_ID}


def compared(first: RunValues, other: RunValues, sampling: Sampling) -> Compared:
    """A run beside the first one; of a rerun, ratios are those of the replans in which both have one.

    Raises:
        RunsDiffer: a rerun has other replans than its base.
    """
    rerun = other.run.repeats(first.run)
    pairs = with_first_pictures(pairs_of(first.episodes, other.episodes, rerun), first.run, other.run)
    otherwise = (pl.col("pictures_apart") > MOST_APART).fill_null(False)
    pairs, refuted = pairs.filter(~otherwise), pairs.filter(otherwise)
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
    units = None
    if (effects := _effects(first.run, other.run)) is not None:
        of_sides, units = effects
        for side, of_side in zip(sides, of_sides, strict=True):
            side["effects"] = of_side
        for side, of_side in zip(sides, _maps(first.run, other.run, units), strict=False):
            side["maps"] = of_side
    rows, values = {}, {}
    for kind, (item, looks) in KINDS.items():
        if not all(kind in side for side in sides):
            continue
        of_kind = sides[0][kind], sides[1][kind]
        if pairs.height:
            values[kind] = paired(pairs, *of_kind, item)
            rows[kind] = differences(values[kind], item, sampling, looks)
        else:
            rows[kind] = differences_unpaired(of_kind, (first.episodes, other.episodes), item, sampling, looks)
    return Compared(first, other, pairs, rows, values, units, refuted)


def _effects(first: Run, other: Run) -> tuple[list[pl.DataFrame], ActionUnits] | None:
    """log2 of the recorded effects of both runs on their actions, in units of both; None where one recorded none."""
    if not all(store.attributes.recording.effects is not None for run in (first, other) for store in run.stores):
        return None
    questions = [run.question for run in (first, other)]
    try:
        settings = questions[0].settings
        units = units_of([*first.stores, *other.stores], settings.units, settings.skip_corrupt)
        found = [recorded_effects(one, attention=False, units=units) for one in questions]
    except BadArgument:  # the question `effects` says why none is shown
        return None
    tables = []
    for one in found:
        assert one is not None
        rows = one.episodes().filter(pl.col("kind").is_in(["without", "prompt", "image"]))
        rows = rows.with_columns(pl.col("reader").fill_null("total"))
        # An episode has few words to exchange: all together they say what none of them shows.
        is_exchange = pl.col("item_kind").is_in(["exchange", "exchanged"])
        exchanged = rows.filter(is_exchange, kind="prompt", reader="total").group_by(EPISODE_ID).agg(pl.mean("effect"))
        any_word = {"kind": "prompt", "item_kind": "exchange", "label": "any word exchanged", "reader": "total"}
        exchanged = exchanged.with_columns(**{name: pl.lit(any_word.get(name, "")) for name in (*ITEM, "reader")})
        rows = pl.concat([exchanged, rows.filter(pl.col("reader").is_in(["total", "direct"]))], how="diagonal")
        size = pl.col("effect").clip(lower_bound=_LEAST_EFFECT)
        tables.append(rows.select(*EPISODE_ID, *ITEM, "reader", value=size.log(2.0)))
    return tables, units


def _maps(first: Run, other: Run, units: ActionUnits) -> list[pl.DataFrame]:
    """The parts of what moves the action, of `patch_maps`, of both runs; none unless both have maps made alike."""
    maps = [patch_maps(run.question, units) for run in (first, other)]
    forms = {one.made_like for run in (first, other) for item in run.question.selected if (one := map_of(item))}
    if any(one.is_empty() for one in maps) or len(forms) > 1:
        return []
    which = "top" if maps[0]["way"][0] == "first order" else "all"
    names = {f"{which}_{name}": name for name in ("named", "robot", "other")}
    found = []
    for run, patches in zip((first, other), maps, strict=True):
        episodes = episodes_of_maps(calls_of_maps(patches, run.question)).rename(names)
        found.append(episodes.unpivot(list(names.values()), index=EPISODE_ID, variable_name="item"))
    return found


def strip_of_pair(
    part: Compared, told_first: pl.DataFrame, told_other: pl.DataFrame
) -> tuple[tuple[SelectedEpisode, SelectedEpisode], pl.DataFrame]:
    """A pair of episodes, one that ended otherwise if there is one, and three moments of both.

    Returns:
        The two episodes; and their `courses.strip`, the first run's above.
    """
    keys, pairs = ["suite", "task_id"], part.pairs
    for side, told in (("first", told_first), ("other", told_other)):
        did = told.select(*keys, pl.col("episode_index").alias(f"episode_{side}"), pl.col("did").alias(f"did_{side}"))
        pairs = pairs.join(did, on=[*keys, f"episode_{side}"], how="left", maintain_order="left")
    pair = pairs.sort(pl.col("did_first").eq_missing(pl.col("did_other")), maintain_order=True).row(0, named=True)
    items, shown = [], []
    for side, of in (("first", part.first), ("other", part.other)):
        named = {item.key: item for item in of.run.question.selected}
        items.append(item := named[pair["suite"], pair["task_id"], pair[f"episode_{side}"]])
        last, steps = item.episode.attributes.num_replans - 1, item.episode.attributes.env_step
        moments = sorted({0, last // 2, last})
        shown.append([(replan, f"{of.run.name}, step {steps[replan] - steps[0]}") for replan in moments])
    return (items[0], items[1]), strip(items, shown)


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


def paired(pairs: pl.DataFrame, first: pl.DataFrame, other: pl.DataFrame, item: Sequence[str]) -> pl.DataFrame:
    """The values of both episodes of every pair, and their difference: the pair, the item, first, other, difference."""
    joined = pairs.drop("stated", "pictures_apart")
    for side, values in (("first", first), ("other", other)):
        keys = ["suite", "task_id", f"episode_{side}", *(item if side == "other" else ())]
        of_side = values.rename({"episode_index": f"episode_{side}", "value": side}).select(*keys[:3], *item, side)
        joined = joined.join(of_side, on=keys, how="inner", nulls_equal=True, maintain_order="left_right")
    return joined.with_columns(difference=pl.col("other") - pl.col("first"))


def differences(
    joined: pl.DataFrame, item: Sequence[str], sampling: Sampling, looks: Sequence[str] = ()
) -> pl.DataFrame:
    """Mean differences of pairs (`paired`) for every item, by task, by suite where there are several, and over all.

    looks: columns of `item`; one look for each value of the others is counted in `difference_q` over all tasks, and one
    for each task in those of tasks (Benjamini-Hochberg).

    Returns:
        One row per (scope, item): scope "task", "suite" or "all"; suite, task_id, instruction; paired; num_tasks,
        num_families, intervals; num_first, num_other, the episodes; mean_first, mean_other, and `difference` with
        `difference_low`, `difference_high` and `difference_q`, of none.
    """
    known = joined.filter(pl.col("difference").is_finite())
    values: dict[str, Scale] = dict.fromkeys(("first", "other", "difference"), "plain")

    def rows_of(by: list[str], of: Sequence[str]) -> pl.DataFrame:
        rows = estimate(known, [*by, *item], values, sampling, {"difference": 0.0}, of)
        numbers = {"num_first": "num_episodes", "num_other": "num_episodes", "mean_first": "first"}
        return rows.with_columns(**numbers, mean_other="other", paired=pl.lit(True))

    return _by_scope(joined, item, looks, rows_of)


def differences_unpaired(
    values: tuple[pl.DataFrame, pl.DataFrame],
    episodes: tuple[pl.DataFrame, pl.DataFrame],
    item: Sequence[str],
    sampling: Sampling,
    looks: Sequence[str] = (),
) -> pl.DataFrame:
    """As `differences`, of means of independent episodes; `episodes`: both runs' `pairing`.

    A task that both runs have moves both means, and its difference has less noise than that of two different tasks.
    """
    both = pl.concat(
        table.join(of.select(*EPISODE_ID, "instruction"), on=EPISODE_ID).with_columns(_other=pl.lit(number == 1))
        for number, (table, of) in enumerate(zip(values, episodes, strict=True))
    )

    def rows_of(by: list[str], of: Sequence[str]) -> pl.DataFrame:
        rows = []
        for part in both.partition_by([*by, *item], maintain_order=True):
            is_other, units = part["_other"].to_numpy(), sampling.units(part)
            if is_other.all() or not is_other.any():
                continue  # a task of one run only
            one = mean_difference(float_values(part["value"]), is_other, units)
            low, high = one.difference.interval() or (None, None)
            rows.append(
                {**part.select(*by, *item).row(0, named=True), "num_tasks": units.num_tasks, **units.about}
                | {"intervals": one.estimand.value, "num_first": one.num_second, "num_other": one.num_first}
                | {"mean_first": one.mean_second, "mean_other": one.mean_first, "difference": one.difference.value}
                | {"difference_low": low, "difference_high": high, "difference_p": one.difference.p_value(0.0)}
            )
        bounds = dict.fromkeys(("difference_low", "difference_high", "difference_p"), pl.Float64)
        frame = pl.DataFrame(rows, infer_schema_length=None, schema_overrides=bounds) if rows else pl.DataFrame()
        return with_q(frame, ["difference"], of).with_columns(paired=pl.lit(False)) if rows else frame

    return _by_scope(both, item, looks, rows_of)


def _by_scope(
    values: pl.DataFrame,
    item: Sequence[str],
    looks: Sequence[str],
    rows_of: Callable[[list[str], Sequence[str]], pl.DataFrame],
) -> pl.DataFrame:
    """Rows of every task, of every suite where there are several, and over all, from the columns that tell them apart.

    rows_of: gives the rows, from these columns and from those inside of which looks are counted.
    """
    several = values["suite"].n_unique() > 1
    scopes = [("task", _TASK), *([("suite", ["suite"])] if several else []), ("all", [])]
    found = [(scope, rows_of(by, item if scope == "task" else [*by, *looks])) for scope, by in scopes]
    named = [rows.with_columns(scope=pl.lit(scope)) for scope, rows in found if rows.width]
    rows = pl.concat(named, how="diagonal_relaxed")
    missing = [name for name in _TASK if name not in rows.columns]
    rows = rows.with_columns(pl.lit(None, values.schema[name]).alias(name) for name in missing)
    if values.height and not several:
        rows = rows.with_columns(suite=pl.lit(values["suite"][0]))
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
            f"{listing(names, 6)} of the rerun {name} has other policy calls than in its base; make the rerun again."
        )
    finite = [one.filter(pl.col("value").is_finite()) for one in (shared, theirs)]
    both = finite[0].join(finite[1].select(key), on=key, how="semi").select(key)
    return tuple(  # type: ignore[return-value]
        one.join(both, on=key, how="semi").group_by(*EPISODE_ID, "layer", maintain_order=True).agg(pl.mean("value"))
        for one in finite
    )
