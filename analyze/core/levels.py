"""The groups of a grouping and their ratio at every level: steps, replans, episodes, tasks.

    level      a row of its cells is                                     of groups also
    steps      (episode, replan, layer, denoise step[, head])            group
    replans    (episode, replan, layer or "layers_avg")                  group
    episodes   (episode, layer or "layers_avg")                          group
    tasks      (task, all tasks or all suites; layer or "layers_avg")    group

Masses are averaged over denoise steps and heads first; fractions, lifts and ratios follow from these means. In
"layers_avg", as the published scripts define it, masses are means over the layers, fractions and lifts of groups follow
from these means. `ratio` is the one ratio of a replan that texts, pictures and the page show: the geometric mean of the
layers' finite positive ratios (the inverse ratio has the inverse mean), `ratio_mean` the mean of the layers' finite
ratios, which the published scripts take. Ratios that are not finite are never dropped silently: each table counts them.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeAlias

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.core.axes import OF_ROWS, weighted, with_time
from vla_attention.analyze.core.estimate import estimate
from vla_attention.analyze.core.measure import Items, Measured, averaged, axes_of, look_at, table_of
from vla_attention.analyze.measures.masses import finite_mean, ratio
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.measures.scan import Look, scan
from vla_attention.analyze.measures.selected import SelectedEpisode, check_not_empty, resolve_episode
from vla_attention.analyze.measures.tables import EPISODE_ID, EPISODE_KEYS, LAYERS_AVG, frame_of_episodes, long_table
from vla_attention.analyze.statistics.many_looks import NAMED_AT
from vla_attention.analyze.statistics.units import Sampling
from vla_attention.schemas.groupings.grouping import Grouping
from vla_attention.schemas.groupings.resolve import check_names

Array: TypeAlias = NDArray[np.float64]
LAYER = ("layer", "layer_number", "block")
SIDES = ("numerator", "denominator")
_TASK = ("scope", "suite", "task_id", "instruction")
_FRACTIONS = ("numerator_fraction", "denominator_fraction")


@dataclass(frozen=True)
class Levels:
    """A grouping measured on the selected episodes.

    Attributes:
        question: stores, selection and grouping.
        measured: the masses of the groups and of both sides of the ratio.
        heads: whether heads were kept apart.
    """

    question: Question
    measured: Sequence[Measured]
    heads: bool = False

    @property
    def grouping(self) -> Grouping:
        """The groups of keys and the ratio that the tables are about."""
        return self.question.grouping

    def steps(self) -> pl.LazyFrame:
        """`EPISODE_KEYS`, replan, env_step, layer, block, denoise_step, denoise_time, head, row_sum, valid_mass,
        num_valid; with a ratio numerator_mass, denominator_mass, ratio, uniform_ratio, ratio_lift (ratio /
        uniform_ratio), log2_ratio.
        """
        times = self.measured[0].denoise_time.tolist()
        named = dict(zip(self.question.selection.denoise_steps, times, strict=True))

        def then(cells: pl.DataFrame) -> pl.DataFrame:
            cells = cells.filter(pl.col("layer") != LAYERS_AVG).drop(_FRACTIONS, strict=False)
            return cells.with_columns(
                pl.col("layer_number").alias("layer"),
                denoise_time=pl.col("denoise_step").replace_strict(named, return_dtype=pl.Float64),
            ).drop("layer_number")

        by = OF_ROWS if self.heads else OF_ROWS[:3]
        return frame_of_episodes(self.measured, partial(cells_of, grouping=self.grouping, by=by), then)

    def steps_groups(self) -> pl.LazyFrame:
        """`groups` of every step; `layer` is a number."""
        single = self.groups(*(OF_ROWS if self.heads else OF_ROWS[:3])).filter(pl.col("layer") != LAYERS_AVG)
        return single.with_columns(layer="layer_number").drop("layer_number")

    def replans(self) -> pl.LazyFrame:
        """`EPISODE_KEYS`, replan, env_step, layer, layer_number, block, row_sum, valid_mass, num_valid; with a ratio
        numerator_mass, denominator_mass, uniform_ratio, ratio, ratio_mean, nonfinite_layers (1 where the ratio is not
        finite; in "layers_avg" the number of layers left out), ratio_lift, log2_ratio.
        """
        return frame_of_episodes(self.measured, partial(replan_cells, grouping=self.grouping))

    def groups(self, *by: str) -> pl.LazyFrame:
        """Keys, mass, density, lift and fraction of each group, kept apart by some of replan, layer, denoise, head."""
        return table_of(self.measured, by, (), _of_groups)

    def episodes(self) -> pl.DataFrame:
        """Over the episode's replans (see `over_replans`), sorted by suite, task, episode and layer."""

        cells = partial(replan_cells, grouping=self.grouping)
        return _sorted(frame_of_episodes(self.measured, cells, over_replans).collect())

    def episodes_groups(self) -> pl.DataFrame:
        """`EPISODE_ID`, layer, layer_number, block, group; mass, mass_std, fraction, fraction_std, keys, density, lift:
        means over the replans where they are finite, standard deviations with ddof 0.
        """
        frame = table_of(self.measured, ("layer",), ("mass_std", "share_std"), _of_groups).collect()
        return _sorted(frame)


def levels_of(question: Question, heads: bool = False) -> Levels:
    """Measure the question's grouping; heads are kept apart where `heads` says so. Raises as `look_at_groups`."""
    (measured,) = scan(question, [look_at_groups(question, heads)])
    return Levels(question, measured, heads)


def look_at_groups(question: Question, heads: bool = False) -> Look[Measured]:
    """The look at the question's grouping.

    Raises:
        SelectorError, EmptyGroup: a group names what no episode has, or has no key in any.
    """
    grouping = question.grouping
    check_names(grouping, question.vocabulary)
    names = len(grouping.names)
    keep = ("denoise", "head") if heads else ("denoise",)

    def check(num_keys: Sequence[NDArray[np.float64]]) -> None:
        check_not_empty(grouping, [keys[:, :names] for keys in num_keys])

    return look_at(question, partial(items_of, grouping=grouping), keep, check)


def items_of(item: SelectedEpisode, grouping: Grouping) -> Items:
    """The groups, then with a ratio the sums of the groups on each side; a share is of the groups' summed mass."""
    weights = resolve_episode(grouping, item).weights
    names, parts = [("group", name) for name in grouping.names], [weights]
    if grouping.ratio is not None:
        for kind, side in zip(SIDES, (grouping.ratio.numerator, grouping.ratio.denominator), strict=True):
            names.append((kind, kind))
            parts.append(weights[..., [grouping.names.index(name) for name in side]].sum(axis=-1, keepdims=True))
    labels = {
        column: pl.Series([name[i] for name in names], dtype=pl.String) for i, column in enumerate(("kind", "group"))
    }
    # A group without a key at a replan has mass 0 there: fractions of all groups add up to 1.
    return Items(labels, np.concatenate(parts, axis=-1), len(grouping.names), absent="zero")


def _of_groups(rows: pl.DataFrame) -> pl.DataFrame:
    names: dict[str, str] = {"share": "fraction"}
    if "share_std" in rows.columns:
        names["share_std"] = "fraction_std"
    return rows.filter(pl.col("kind") == "group").drop("kind").rename(names)


def cells_of(one: Measured, grouping: Grouping, by: Collection[str]) -> pl.DataFrame:
    """The masses of both sides of the ratio and their ratio, in every replan and cell of the axes `by`.

    Returns:
        One row per cell: `EPISODE_KEYS`, replan, env_step, layer, layer_number, block (the layers, then "layers_avg"),
        denoise_step, head, row_sum, valid_mass, num_valid; with a ratio numerator_mass, denominator_mass,
        numerator_fraction, denominator_fraction, ratio, uniform_ratio, ratio_lift, log2_ratio.
    """
    by = {"replan", "layer", *by}
    return long_table(one.item, axes_of(one, by), _cell_values(one, grouping, by), EPISODE_KEYS)


def replan_cells(one: Measured, grouping: Grouping) -> pl.DataFrame:
    """`Levels.replans` of an episode."""
    by = {"replan", "layer"}
    values = _cell_values(one, grouping, by)
    if grouping.ratio is not None:
        values |= _of_whole_replans(values["ratio"], values["uniform_ratio"], list(one.selection.once))
        values = _relative(values)
    table = long_table(one.item, axes_of(one, by), values, EPISODE_KEYS).drop("denoise_step", "head")
    return table.drop(_FRACTIONS, strict=False)


def _cell_values(one: Measured, grouping: Grouping, by: Collection[str]) -> dict[str, NDArray[Any]]:
    """Columns of `cells_of`, each (replan, layer, denoise, head)."""
    found = averaged(one, by)
    values: dict[str, NDArray[Any]] = {
        "row_sum": found["row_sum"],
        "valid_mass": found["valid"],
        "num_valid": one.num_valid[:, None, None, None].astype(np.float64),
    }
    if grouping.ratio is None:
        return values
    first = len(grouping.names)  # behind the groups, both sides of the ratio
    for i, side in enumerate(SIDES, first):
        mass = found["mass"][..., i]
        values |= {f"{side}_mass": mass, f"{side}_fraction": ratio(mass, found["whole"])}
    values["ratio"] = ratio(values["numerator_mass"], values["denominator_mass"])
    even = ratio(found["uniform"][..., first], found["uniform"][..., first + 1])
    return _relative(values | {"uniform_ratio": np.broadcast_to(even, values["ratio"].shape)})


def _relative(values: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """The values with `ratio_lift`, the ratio / the uniform ratio, and `log2_ratio`."""
    with np.errstate(divide="ignore", invalid="ignore"):
        logs = np.log2(values["ratio"])
    return values | {"ratio_lift": ratio(values["ratio"], values["uniform_ratio"]), "log2_ratio": logs}


def _of_whole_replans(ratios: Array, uniform: Array, once: list[int]) -> dict[str, NDArray[Any]]:
    """Ratios (replan, layer and their mean, 1, 1) with what "layers_avg" says of the layers' ratios.

    Geometric means are over layers whose ratio has a finite logarithm, and so is that of the uniform ratios, unless
    these are all the same. once: layers; a block that two layer numbers name counts once.
    """
    layers, even = ratios[:, once], uniform[:, once]
    finite = np.isfinite(layers)
    has_log = finite & (layers > 0)
    counted = has_log | ~has_log.any(axis=1, keepdims=True)
    one = np.where((even == even[:, :1]).all(axis=1), even[:, 0], _geometric_mean(even, counted))
    nonfinite = (~np.isfinite(ratios)).astype(np.int64)
    nonfinite[:, -1] = (~finite).sum(axis=1)

    def joined(of_layers: Array, average: Array) -> Array:
        return np.concatenate([of_layers[:, :-1], average[:, None]], axis=1)

    return {
        "ratio": joined(ratios, _geometric_mean(layers, has_log)),
        "ratio_mean": joined(ratios, finite_mean(layers, 1)),
        "uniform_ratio": joined(uniform, one),
        "nonfinite_layers": nonfinite,
    }


def _geometric_mean(values: Array, which: NDArray[np.bool_]) -> Array:
    """exp of the mean of the logarithms of positive finite values among `which`, along axis 1; NaN without any."""
    with np.errstate(divide="ignore", invalid="ignore"):
        logs = np.log(np.where(which & np.isfinite(values) & (values > 0), values, np.nan))
    return np.exp(finite_mean(logs, 1))


def _finite(name: str) -> pl.Expr:
    return pl.col(name).filter(pl.col(name).is_finite())


def _num_without(name: str) -> pl.Expr:
    """Number of values that are not finite."""
    return (~pl.col(name).is_finite().fill_null(False)).sum().cast(pl.Int64)


def _spread() -> list[pl.Expr]:
    """ratio_std, ratio_median, ratio_min and ratio_max of the finite values of ratio_mean."""
    of = _finite("ratio_mean")
    numbers = {"std": of.std(ddof=0), "median": of.median(), "min": of.min(), "max": of.max()}
    return [number.alias(f"ratio_{name}") for name, number in numbers.items()]


def _geometric(name: str) -> pl.Expr:
    """exp of the mean of logarithms over the finite positive values; null without any."""
    return pl.col(name).filter(pl.col(name).is_finite() & (pl.col(name) > 0)).log().mean().exp()


def ratios_by(levels: Levels, by: Collection[str]) -> pl.DataFrame:
    """The ratio of every episode and cell of the axes; the grouping has one.

    Returns:
        `EPISODE_KEYS`, the columns of the axes; ratio, uniform_ratio and ratio_lift (geometric means over replans and,
        unless they are kept, over layers, of ratios with a finite logarithm), numerator_fraction, denominator_fraction,
        numerator_mass, denominator_mass (means), num_nonfinite (ratios without a finite logarithm).
    """

    def then(cells: pl.DataFrame) -> pl.DataFrame:
        cells = cells.filter(pl.col("layer") != LAYERS_AVG)
        if "layer" not in by:  # a block that two layer numbers name counts once
            cell = [*EPISODE_ID, "replan", "block", "denoise_step", "head"]
            cells = cells.unique(cell, keep="first", maintain_order=True)
        cells = with_time(cells, levels.measured) if "time" in by else cells.with_columns(weight=1.0)
        logs = {name: pl.col(name).log() for name in ("ratio", "uniform_ratio", "ratio_lift")}
        plain = ("numerator_fraction", "denominator_fraction", "numerator_mass", "denominator_mass")
        return cells.group_by(*EPISODE_KEYS, *_columns_of(by), maintain_order=True).agg(
            *(weighted(log, pl.col("weight")).exp().alias(name) for name, log in logs.items()),
            *(weighted(pl.col(name), pl.col("weight")).alias(name) for name in plain),
            (~logs["ratio"].is_finite().fill_null(False)).sum().cast(pl.Int64).alias("num_nonfinite"),
        )

    cells_of_axes = partial(cells_of, grouping=levels.grouping, by=[axis for axis in OF_ROWS if axis in by])
    return frame_of_episodes(levels.measured, cells_of_axes, then).collect()


def groups_by(levels: Levels, by: Collection[str]) -> pl.DataFrame:
    """Keys, mass, fraction and lift of every group in every episode and cell of the axes, means over replans."""

    def then(rows: pl.DataFrame) -> pl.DataFrame:
        rows = _of_groups(rows)
        if "layer" in by:
            rows = rows.filter(pl.col("layer") != LAYERS_AVG)
        if "time" not in by:
            return rows
        rows = with_time(rows, levels.measured)
        return rows.group_by(*EPISODE_KEYS, *_columns_of(by), "group", maintain_order=True).agg(
            weighted(pl.col(name), pl.col("weight")).alias(name) for name in ("keys", "mass", "fraction", "lift")
        )

    inner = {*(axis for axis in OF_ROWS if axis in by), *(("replan",) if "time" in by else ())}
    return table_of(levels.measured, inner, then=then).collect()


def _columns_of(by: Collection[str]) -> list[str]:
    """The columns of `means` for axes that are kept."""
    columns = {"replan": ("replan", "env_step"), "layer": LAYER, "denoise": ("denoise_step",), "head": ("head",)}
    names = [name for axis in OF_ROWS if axis in by for name in columns[axis]]
    return [*names, "phase"] if "time" in by else names


def over_replans(replans: pl.DataFrame) -> pl.DataFrame:
    """Every (episode, layer), from the cells of replans; standard deviations with ddof 0.

    Returns:
        `EPISODE_KEYS`, layer, layer_number, block, num_replans, row_sum and num_valid (means); with a ratio
            numerator_mass, denominator_mass  means
            ratio_mean, ratio_std, ratio_median, ratio_min, ratio_max   over the replans' finite `ratio_mean`
            ratio_of_means      mean numerator mass / mean denominator mass
            log_ratio_mean      mean over the replans of the logarithm of `ratio`, where it is finite and positive
            num_nonfinite       replans whose ratio is infinite or undefined
            geometric_left_out  replans whose ratio has no finite logarithm (not finite, or 0)
            nonfinite_layers    sum over replans of the layers left out of "layers_avg"
            uniform_ratio       geometric mean of the ratios that uniform attention would give
            ratio_lift          geometric mean over replans of ratio / uniform_ratio, finite positive ones
            geometric_mean      exp(log_ratio_mean)
    """
    plain = [pl.len().cast(pl.Int64).alias("num_replans"), pl.col("row_sum", "num_valid").mean()]
    grouped = replans.group_by(*EPISODE_KEYS, *LAYER, maintain_order=True)
    if "ratio" not in replans.columns:
        return grouped.agg(plain)
    found = grouped.agg(
        *plain,
        pl.col("numerator_mass", "denominator_mass").mean(),
        _finite("ratio_mean").mean(),
        *_spread(),
        (pl.col("numerator_mass").mean() / pl.col("denominator_mass").mean()).fill_nan(None).alias("ratio_of_means"),
        (_finite("log2_ratio").mean() * np.log(2.0)).alias("log_ratio_mean"),
        _num_without("ratio_mean").alias("num_nonfinite"),
        _num_without("log2_ratio").alias("geometric_left_out"),
        pl.col("nonfinite_layers").sum(),
        _geometric("uniform_ratio").alias("uniform_ratio"),
        _geometric("ratio_lift").alias("ratio_lift"),
    )
    return found.with_columns(geometric_mean=pl.col("log_ratio_mean").exp())


def task_cells(episodes: pl.DataFrame, sampling: Sampling) -> pl.DataFrame:
    """Every (task, layer) and, over tasks, rows with `task_id` null: means over tasks of the tasks' means.

    `scope` is "task", "all" (every task of one suite) or "combined" (every suite; only when there are several).
    `X_low` and `X_high` bound the interval of X (see `statistics.intervals`): over episodes inside a task, else about
    what the row's `intervals` says; null where there is none.

    Returns:
        scope, suite, task_id, instruction, layer, layer_number, block, num_tasks, num_families, intervals,
        num_episodes, num_replans, success_rate; with a ratio ratio_std, ratio_median, ratio_min, ratio_max (over the
        episodes' mean ratios), episodes_with_ratio and tasks_with_ratio (of how many the geometric means are),
        episodes_without_ratio (without a finite ratio), num_nonfinite, geometric_left_out, nonfinite_layers (sums),
        numerator_mass, denominator_mass (means), uniform_ratio (geometric mean), and with bounds geometric_mean and
        ratio_lift (geometric means), ratio_mean, ratio_of_means.
    """
    has_ratio = "ratio_mean" in episodes.columns
    rows = episodes.with_columns(success_rate=pl.col("success").cast(pl.Float64))
    if has_ratio:
        rows = rows.with_columns(_uniform="uniform_ratio")
    counts = [pl.col("num_replans").sum()]
    if has_ratio:
        has_log = pl.col("log_ratio_mean").is_finite().fill_null(False)
        counts += [
            *_spread(),
            _num_without("ratio_mean").alias("episodes_without_ratio"),
            has_log.sum().cast(pl.Int64).alias("episodes_with_ratio"),
            pl.struct("suite", "task_id").filter(has_log).n_unique().cast(pl.Int64).alias("tasks_with_ratio"),
            pl.col("num_nonfinite", "geometric_left_out", "nonfinite_layers").sum(),
        ]
    found = []
    for scope, names in _scopes(rows):
        by = [*names, *LAYER]
        if has_ratio:
            # With the mean and the episodes of the headline, so that ratio / uniform ratio is the lift.
            none = ~has_log.any().over(by)
            rows = rows.with_columns(uniform_ratio=pl.when(has_log | none).then("_uniform"))
        part = estimate(rows, by, _VALUES if has_ratio else _PLAIN, sampling, quotients=_QUOTIENTS if has_ratio else {})
        part = part.join(rows.group_by(by).agg(counts), on=by, how="left", nulls_equal=True, maintain_order="left")
        found.append(part.with_columns(scope=pl.lit(scope)))
    bounds = [f"{name}_{end}" for name in _UNBOUNDED for end in ("low", "high")]
    return (
        pl.concat(found, how="diagonal").drop(bounds, strict=False).select(*_TASK, *LAYER, pl.exclude(*_TASK, *LAYER))
    )


_PLAIN: dict[str, Any] = {"success_rate": "plain"}
_VALUES: dict[str, Any] = {
    "success_rate": "plain",
    "numerator_mass": "plain",
    "denominator_mass": "plain",
    "uniform_ratio": "geometric",
    "ratio_mean": "positive",
    "geometric_mean": "geometric",
    "ratio_lift": "geometric",
}
_QUOTIENTS = {"ratio_of_means": ("numerator_mass", "denominator_mass")}
#: Of these no interval is given.
_UNBOUNDED = ("success_rate", "numerator_mass", "denominator_mass", "uniform_ratio")


def detectable_lift(episodes: pl.DataFrame, sampling: Sampling) -> float | None:
    """The least ratio over its even one that would have been shown to exceed 1, see `Estimate.detectable`."""
    rows, one = episodes.filter(pl.col("layer") == LAYERS_AVG), {"ratio_lift": 1.0}
    found = estimate(rows, ["layer"], {"ratio_lift": "geometric"}, sampling, one, detect={"ratio_lift": NAMED_AT})
    least: float | None = found["ratio_lift_detectable"].item()
    return least


def task_groups(groups: pl.DataFrame, sampling: Sampling) -> pl.DataFrame:
    """`scope`, suite, task_id, instruction, layer, layer_number, block, group as in `task_cells`; mass, keys, density,
    lift (means over tasks); fraction, fraction_low, fraction_high.
    """
    found = []
    values: dict[str, Any] = dict.fromkeys(("mass", "keys", "density", "lift"), "plain") | {"fraction": "share"}
    for scope, names in _scopes(groups):
        rows = estimate(groups, [*names, *LAYER, "group"], values, sampling)
        found.append(rows.with_columns(scope=pl.lit(scope)))
    kept = [*values, "fraction_low", "fraction_high"]
    return pl.concat(found, how="diagonal").select(*_TASK, *LAYER, "group", *kept)


def _scopes(rows: pl.DataFrame) -> list[tuple[str, list[str]]]:
    several = rows["suite"].n_unique() > 1
    return [("task", ["suite", "task_id", "instruction"]), ("all", ["suite"]), *([("combined", [])] if several else [])]


def overall(tasks: pl.DataFrame) -> pl.DataFrame:
    """The rows of `task_cells` or `task_groups` over everything: all suites when there are several, else the suite."""
    scope = "combined" if (tasks["scope"] == "combined").any() else "all"
    return tasks.filter(pl.col("scope") == scope)


def _sorted(table: pl.DataFrame) -> pl.DataFrame:
    """By episode and layer, "layers_avg" last: results do not depend on the order in which episodes were read."""
    return table.sort(*EPISODE_ID, "layer_number", nulls_last=True, maintain_order=True)
