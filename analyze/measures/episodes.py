"""From replans to episodes, on arrays: what a replan's masses give, and the means, spreads and counts over replans.

Many episodes are one array along the axis of replans, with the position at which each begins: a table of all replans
and groups would be several times as large as the masses, and as slow.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.measures.frames import (
    EPISODE_ID,
    EPISODE_KEYS,
    LayerAxis,
    Tables,
    episode_columns,
    float_values,
)
from vla_attention.analyze.measures.masses import (
    GROUP_MEASURES,
    finite_mean,
    group_measures,
    ratio,
    relative_to_uniform,
    sides,
    uniform_ratio,
)
from vla_attention.analyze.measures.steps import MeasuredEpisode, in_order_of_episodes
from vla_attention.schemas.groupings.grouping import Grouping

Array = NDArray[np.float64]
LAYER_KEYS = ("layer", "layer_number", "block")
#: So many masses are reduced at once: a few arrays of 4 MB.
_MASSES_AT_ONCE = 500_000


@dataclass(frozen=True)
class ReplanValues:
    """What the masses of replans give, averaged over denoise steps and heads.

    Attributes:
        cells: column -> (replan, layer or 1); the columns of `aggregate.replan_tables`.
        groups: makes column -> (replan, layer, group).
    """

    cells: Mapping[str, NDArray[Any]]
    groups: Callable[[], Mapping[str, Array]]


def replan_values(measured: MeasuredEpisode | Sequence[MeasuredEpisode], grouping: Grouping) -> ReplanValues:
    """The values of an episode's replans, or of those of several episodes one after the other."""
    episodes = [measured] if isinstance(measured, MeasuredEpisode) else measured
    layers = LayerAxis.of(episodes[0].selection)
    mass, valid_mass, row_sum = (
        layers.with_average(np.concatenate([getattr(one, name) for one in episodes]).mean(axis=(2, 3)))
        for name in ("mass", "valid_mass", "row_sum")
    )
    num_keys, num_valid = (
        np.concatenate([_every_replan(getattr(one, name), len(one.mass)) for one in episodes])
        for name in ("num_keys", "num_valid")
    )
    uniform_mass, uniform_valid = (
        np.concatenate([_every_replan(_of_layers(getattr(one, name), layers), len(one.mass)) for one in episodes])
        for name in ("uniform_mass", "uniform_valid")
    )
    cells: dict[str, NDArray[Any]] = {
        "row_sum": row_sum,
        "valid_mass": valid_mass,
        "num_valid": num_valid[:, None].astype(np.float64),
    }
    if grouping.ratio is not None:
        above, below = sides(mass, grouping)
        of_layers = ratio(above, below)[:, : len(episodes[0].selection.layers)]
        left_out = ~np.isfinite(of_layers)
        of_uniform = uniform_ratio(uniform_mass, grouping)[:, : len(episodes[0].selection.layers)]
        uniform = _uniform_with_average(of_uniform, of_layers, layers)
        cells |= {"numerator_mass": above, "denominator_mass": below, "uniform_ratio": uniform}
        # The ratio of a replan: the mean of logarithms over layers has no preference for either side. The published
        # scripts take the mean of the ratios.
        value = layers.with_average(of_layers, mean=finite_geometric_mean)
        cells |= {"ratio": value, "ratio_mean": layers.with_average(of_layers, mean=finite_mean)}
        cells["nonfinite_layers"] = layers.with_average(left_out.astype(np.int64), mean=np.sum)
        cells |= relative_to_uniform(value, uniform)
    return ReplanValues(
        cells, lambda: group_measures(mass, valid_mass, num_keys, uniform_mass, uniform_valid).columns()
    )


def _of_layers(values: Array, layers: LayerAxis) -> Array:
    """Values (replan, layer or 1, denoise, head, ...) as means over denoise steps and heads, with "layers_avg"."""
    means = values.mean(axis=(2, 3))
    return layers.with_average(np.broadcast_to(means, (len(means), layers.num_layers, *means.shape[2:])))


def _uniform_with_average(uniform: Array, ratios: Array, layers: LayerAxis) -> Array:
    """Uniform ratios (replan, layer) with that of "layers_avg" as the last.

    It is the geometric mean of the layers whose ratio has a logarithm, of all layers where none has; where all layers
    have the same, this one, finite or not.
    """
    known = np.isfinite(logs_of(ratios))
    counted = np.where(known | ~known.any(axis=1, keepdims=True), uniform, np.nan)
    average = layers.with_average(counted, mean=finite_geometric_mean)[:, -1:]
    same = (uniform == uniform[:, :1]).all(axis=1, keepdims=True)
    return np.concatenate([uniform, np.where(same, uniform[:, :1], average)], axis=1)


def _every_replan(values: NDArray[Any], replans: int) -> NDArray[Any]:
    return np.broadcast_to(values, (replans, *values.shape[1:]))


def episode_tables(replans: Tables, grouping: Grouping) -> Tables:
    """Every (episode, layer), over the episode's replans; standard deviations with ddof 0.

    Returns:
        cells: `EPISODE_KEYS`, layer, layer_number, block, num_replans, row_sum and num_valid (means); with a ratio
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
        groups: suite, task_id, episode_index, layer, layer_number, block, group; mass, mass_std, fraction,
            fraction_std, keys, density, lift (means over the replans where it is finite).
    """
    return _joined([_of_table(part, grouping) for part in replans.parts])


def episode_tables_of(measured: Sequence[MeasuredEpisode], grouping: Grouping) -> Tables:
    """`episode_tables` of the replans of measured episodes, without a table of their replans."""
    # Each batch sorted by itself: sorting all of them together would need the same memory again.
    parts = [_joined([_of_episodes(batch, grouping)]) for batch in _batches(in_order_of_episodes(measured))]
    return Tables(pl.concat([part.cells for part in parts]), pl.concat([part.groups for part in parts]))


def _batches(measured: Iterable[MeasuredEpisode]) -> Iterator[list[MeasuredEpisode]]:
    batch: list[MeasuredEpisode] = []
    size = 0
    for one in measured:
        if batch and size + one.mass.size > _MASSES_AT_ONCE:
            yield batch
            batch, size = [], 0
        batch.append(one)
        size += one.mass.size
    yield batch


def _of_episodes(measured: Sequence[MeasuredEpisode], grouping: Grouping) -> Tables:
    layers, values = LayerAxis.of(measured[0].selection), replan_values(measured, grouping)
    replans = _Parts(np.array([len(one.mass) for one in measured]))
    shape = len(measured), len(layers.labels)
    rows = pl.DataFrame(
        {
            **{
                name: column.gather(np.repeat(np.arange(shape[0]), shape[1]))
                for name, column in episode_columns([one.item for one in measured], EPISODE_KEYS).items()
            },
            **{
                name: pl.Series(name, list(labels), dtype=pl.String if name == "layer" else pl.Int64).gather(
                    np.tile(np.arange(shape[1]), shape[0])
                )
                for name, labels in layers.columns.items()
            },
        }
    )
    every = {
        name: np.broadcast_to(array, (len(array), shape[1])) if name != "nonfinite_layers" else array
        for name, array in values.cells.items()
    }
    cells = {name: array.ravel() for name, array in _cells_over(replans, every, grouping).items()}
    groups = {
        name: np.broadcast_to(array, (*shape, len(grouping.names))).ravel()
        for name, array in _groups_over(replans, values.groups()).items()
    }
    return _tables(rows, cells, groups, grouping.names)


def _of_table(part: Tables, grouping: Grouping) -> Tables:
    """Of a table of replans in any order."""
    keys = [*EPISODE_KEYS, *LAYER_KEYS]
    found = part.cells.with_row_index("_row").group_by(*keys, maintain_order=True).agg("_row")
    order = found["_row"].explode().to_numpy()
    replans = _Parts(found["_row"].list.len().to_numpy().astype(np.int64))
    names = part.group_names()
    cells = {name: float_values(part.cells[name])[order] for name in _needed(grouping)}
    made = part.kept()
    groups = {name: made.values(name)[order] for name in GROUP_MEASURES}
    return _tables(
        found.drop("_row"),
        _cells_over(replans, cells, grouping),
        {name: array.ravel() for name, array in _groups_over(replans, groups).items()},
        names,
    )


def _needed(grouping: Grouping) -> tuple[str, ...]:
    plain = ("row_sum", "num_valid")
    if grouping.ratio is None:
        return plain
    of_ratio = ("numerator_mass", "denominator_mass", "ratio_mean", "log2_ratio", "nonfinite_layers", "uniform_ratio")
    return (*plain, *of_ratio, "ratio_lift")


def _cells_over(replans: _Parts, values: Mapping[str, NDArray[Any]], grouping: Grouping) -> dict[str, NDArray[Any]]:
    """Columns of cells from values (replan, ...) of all replans: (part, ...) each."""
    found: dict[str, NDArray[Any]] = {
        "num_replans": np.broadcast_to(
            replans.counts.reshape(-1, *(1,) * (values["row_sum"].ndim - 1)),
            (len(replans.counts), *values["row_sum"].shape[1:]),
        ),
        "row_sum": replans.mean(values["row_sum"]),
        "num_valid": replans.mean(values["num_valid"]),
    }
    if grouping.ratio is None:
        return found
    finite, logs = only_finite(values["ratio_mean"]), only_finite(values["log2_ratio"])
    above, below = replans.mean(values["numerator_mass"]), replans.mean(values["denominator_mass"])
    log_ratio = replans.mean(logs) * np.log(2.0)
    return found | {
        "numerator_mass": above,
        "denominator_mass": below,
        "ratio_mean": replans.mean(finite),
        "ratio_std": replans.std(finite),
        "ratio_median": replans.median(finite),
        "ratio_min": replans.extreme(np.fmin, finite),
        "ratio_max": replans.extreme(np.fmax, finite),
        "ratio_of_means": ratio(above, below),
        "log_ratio_mean": log_ratio,
        "num_nonfinite": replans.count(np.isnan(finite)),
        "geometric_left_out": replans.count(np.isnan(logs)),
        "nonfinite_layers": replans.total(np.nan_to_num(values["nonfinite_layers"])).astype(np.int64),
        "uniform_ratio": _geometric(replans, values["uniform_ratio"]),
        "ratio_lift": _geometric(replans, values["ratio_lift"]),
        "geometric_mean": np.exp(log_ratio),
    }


def _geometric(replans: _Parts, values: Array) -> Array:
    geometric: Array = np.exp(replans.mean(only_finite(logs_of(values))))
    return geometric


def _groups_over(replans: _Parts, values: Mapping[str, Array]) -> dict[str, Array]:
    """Columns of groups from values (replan, ..., group) of all replans: (part, ..., group) each."""
    found = {}
    for name in GROUP_MEASURES:
        found[name] = replans.mean(only_finite(values[name]))
        if name in ("mass", "fraction"):
            found[f"{name}_std"] = replans.std(values[name])
    return found


class _Parts:
    """Values along the axis of replans in consecutive parts, none of them empty. NaN is a value that is not there."""

    def __init__(self, counts: NDArray[np.int64]) -> None:
        self.counts = counts
        self._starts = np.concatenate([[0], np.cumsum(counts)[:-1]]).astype(np.int64)

    def total(self, values: NDArray[Any]) -> NDArray[Any]:
        """Sums (part, ...) of values (replan, ...)."""
        sums: NDArray[Any] = np.add.reduceat(values, self._starts, axis=0)
        return sums

    def count(self, chosen: NDArray[np.bool_]) -> NDArray[np.int64]:
        """How many are true."""
        return self.total(chosen.astype(np.int64))

    def mean(self, values: Array) -> Array:
        """Means over the values that are there; NaN where there is none."""
        missing = np.isnan(values)
        if not missing.any():
            plain: Array = self.total(values) / self._like(values)
            return plain
        count = self.count(~missing)
        means: Array = self.total(np.where(missing, 0.0, values)) / np.where(count > 0, count, np.nan)
        return means

    def std(self, values: Array) -> Array:
        """Standard deviations with ddof 0."""
        with np.errstate(invalid="ignore"):
            apart = values - np.repeat(self.mean(values), self.counts, axis=0)
        spread: Array = np.sqrt(self.mean(apart * apart))
        return spread

    def extreme(self, which: np.ufunc, values: Array) -> Array:
        """Smallest or largest (`np.fmin`, `np.fmax`)."""
        found: Array = which.reduceat(values, self._starts, axis=0)
        return found

    def median(self, values: Array) -> Array:
        """Medians; of an even number the mean of the two in the middle."""
        medians = []
        for start, count in zip(self._starts, self.counts, strict=True):
            ordered = np.sort(values[start : start + count], axis=0)  # NaN at the end
            there = (~np.isnan(ordered)).sum(axis=0)
            below, above = (
                np.take_along_axis(ordered, np.maximum(middle, 0)[None], axis=0)[0]
                for middle in ((there - 1) // 2, np.minimum(there // 2, count - 1))
            )
            medians.append(np.where(there > 0, (below + above) / 2.0, np.nan))
        return np.stack(medians)

    def _like(self, values: Array) -> Array:
        return self.counts.reshape(-1, *(1,) * (values.ndim - 1)).astype(np.float64)


def only_finite(values: Array) -> Array:
    """The values, NaN where they are not finite."""
    return values if np.isfinite(values).all() else np.where(np.isfinite(values), values, np.nan)


def logs_of(values: Array) -> Array:
    """Natural logarithms, not finite where a value has none."""
    with np.errstate(divide="ignore", invalid="ignore"):
        logs: Array = np.log(values)
    return logs


def finite_geometric_mean(values: Array, axis: int | tuple[int, ...] = 0) -> Array:
    """Geometric mean over the finite positive values along an axis; NaN where there is none."""
    means: Array = np.exp(finite_mean(logs_of(values), axis))
    return means


def _tables(
    rows: pl.DataFrame, cells: Mapping[str, NDArray[Any]], groups: Mapping[str, Array], names: Sequence[str]
) -> Tables:
    """Tables from the rows' labels, and flat values of cells and of cells and groups."""
    position = np.repeat(np.arange(rows.height), len(names))
    labels = rows.select(*EPISODE_ID, *LAYER_KEYS)[position]
    group = pl.Series("group", list(names), dtype=pl.String).gather(np.tile(np.arange(len(names)), rows.height))
    return Tables(rows.with_columns(_columns(cells)), labels.with_columns(group, *_columns(groups)))


def _columns(values: Mapping[str, NDArray[Any]]) -> list[pl.Series]:
    made = [pl.Series(name, np.ascontiguousarray(array)) for name, array in values.items()]
    return [series.fill_nan(None) if series.dtype.is_float() else series for series in made]


def _joined(parts: Sequence[Tables]) -> Tables:
    """Sorted by episode and layer: results do not depend on the order in which episodes were read."""
    cells, groups = (pl.concat([getattr(part, name) for part in parts]) for name in ("cells", "groups"))
    return Tables(sorted_by_episode(cells), sorted_by_episode(groups))


def sorted_by_episode(table: pl.DataFrame) -> pl.DataFrame:
    """A table sorted by episode and layer, "layers_avg" last."""
    return table.sort(*EPISODE_ID, "layer_number", nulls_last=True, maintain_order=True)
