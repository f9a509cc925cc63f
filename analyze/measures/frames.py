"""From arrays of one episode to rows of a table. Every table of `analyze` that comes from arrays is made here.

Tables are tidy: one row per cell (replan, layer, ...), or per cell and group, with measures as columns. NaN (undefined) is null in
a table; infinite ratios stay infinite.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.measures.selected import SelectedEpisode
from vla_attention.analyze.stores.selection import Selection

#: The columns that name an episode.
EPISODE_ID = ("suite", "task_id", "episode_index")
#: The columns that describe an episode; the last ones follow from its name.
EPISODE_KEYS = ("suite", "task_id", "instruction", "episode_index", "success", "num_steps")
#: The layer that stands for the mean over all layers.
LAYERS_AVG = "layers_avg"

#: One axis: the columns that label it, each with a value per position.
Axis = Mapping[str, Sequence[Any] | NDArray[Any] | pl.Series]


def long_table(
    item: SelectedEpisode,
    axes: Sequence[Axis],
    values: Mapping[str, NDArray[Any]],
    keys: Sequence[str] = EPISODE_ID,
) -> pl.DataFrame:
    """Arrays of one episode as rows, the last axis varying fastest.

    Args:
        item: the episode; its `keys` become columns with one value.
        axes: labels of the arrays' axes, in order.
        values: column name -> array with as many axes; an axis of length 1 is repeated along its labels.
        keys: which columns describe the episode, of `EPISODE_KEYS`.

    Returns:
        The columns `keys`, the labels of the axes, then `values`. Labels are Int64, Float64, Boolean or String; None is null.
    """
    shape = tuple(len(next(iter(axis.values()))) for axis in axes)
    height = int(np.prod(shape))
    columns: dict[str, pl.Series] = {name: _constant(name, item, height) for name in keys}
    for i, axis in enumerate(axes):
        inner = int(np.prod(shape[i + 1 :]))
        position = np.tile(np.repeat(np.arange(shape[i]), inner), height // max(1, shape[i] * inner))
        for name, labels in axis.items():
            columns[name] = _labels(name, labels).gather(position)
    for name, array in values.items():
        series = pl.Series(name, np.broadcast_to(array, shape).ravel())
        columns[name] = series.fill_nan(None) if series.dtype.is_float() else series
    return pl.DataFrame(columns)


def _constant(name: str, item: SelectedEpisode, height: int) -> pl.Series:
    value = item.store.suite if name == "suite" else getattr(item.episode.attributes, name)
    return _labels(name, [value]).new_from_index(0, height)


def _labels(name: str, labels: Sequence[Any] | NDArray[Any] | pl.Series) -> pl.Series:
    if isinstance(labels, pl.Series):  # labels that may all be null have a type of their own
        return labels
    given = labels.tolist() if isinstance(labels, np.ndarray) else list(labels)
    known = next((label for label in given if label is not None), 0)
    kinds = {bool: pl.Boolean, int: pl.Int64, float: pl.Float64, str: pl.String}
    return pl.Series(name, given, dtype=kinds[type(known)])


def rows_of_episode(table: pl.DataFrame, item: SelectedEpisode) -> pl.DataFrame:
    """The rows of one episode."""
    attributes = item.episode.attributes
    return table.filter(
        (pl.col("suite") == item.store.suite)
        & (pl.col("task_id") == attributes.task_id)
        & (pl.col("episode_index") == attributes.episode_index)
    )


def layer_name(layer: str) -> str:
    """A layer's label in tables as text: `layer 5`, or `all layers` for the mean over the selected ones."""
    return "all layers" if layer == LAYERS_AVG else f"layer {layer}"


def replan_axis(item: SelectedEpisode) -> Axis:
    """Labels `replan` and `env_step`."""
    steps = item.episode.read("env_step").astype(np.int64)
    return {"replan": range(len(steps)), "env_step": steps}


def layer_axis(selection: Selection) -> Axis:
    """Labels `layer` (the number that the user typed) and `block` (the transformer block)."""
    return {"layer": selection.layer_labels, "block": selection.blocks}


def denoise_axis(selection: Selection) -> Axis:
    """Label `denoise_step`."""
    return {"denoise_step": selection.denoise_steps}


def head_axis(selection: Selection) -> Axis:
    """Label `head`; null where heads were averaged."""
    return {"head": selection.head_numbers if selection.per_head else (None,)}


@dataclass(frozen=True)
class LayerAxis:
    """The selected layers and, after them, `layers_avg`.

    Attributes:
        labels: the layers as the user numbers them, as text, then "layers_avg".
        numbers: the same as numbers; None for the average.
        blocks: transformer blocks; None for the average.
        once: positions of the layers that the average is over. A block that was named by two layer numbers counts once.
    """

    labels: tuple[str, ...]
    numbers: tuple[int | None, ...]
    blocks: tuple[int | None, ...]
    once: tuple[int, ...]

    @classmethod
    def of(cls, selection: Selection, average_one: bool = True) -> LayerAxis:
        """The layers of a selection. `average_one`: append the average also where there is a single layer."""
        labels = tuple(str(label) for label in selection.layer_labels)
        numbers, blocks = tuple(selection.layer_labels), tuple(selection.blocks)
        once = tuple(i for i, block in enumerate(blocks) if blocks.index(block) == i)
        if len(labels) == 1 and not average_one:
            return cls(labels, numbers, blocks, once)
        return cls((*labels, LAYERS_AVG), (*numbers, None), (*blocks, None), once)

    @property
    def columns(self) -> Axis:
        """Labels `layer`, `layer_number` and `block`."""
        return {"layer": self.labels, "layer_number": self.numbers, "block": self.blocks}

    def with_average(
        self,
        values: NDArray[np.float64],
        axis: int = 1,
        mean: Callable[[NDArray[np.float64], int], NDArray[np.float64]] = np.mean,
    ) -> NDArray[np.float64]:
        """Append the mean over the layers along `axis`; `mean(values, axis)` says how, for instance `finite_mean`."""
        if len(self.labels) == values.shape[axis]:
            return values
        average = mean(np.take(values, self.once, axis=axis), axis)
        return np.concatenate([values, np.expand_dims(average, axis)], axis=axis)


@dataclass(frozen=True)
class Level:
    """Tables of one level: steps, replans, episodes or tasks.

    Attributes:
        cells: one row per cell, with everything that is said of the whole row or of the ratio.
        groups: one row per cell and group, in the order of the grouping; column `group`.
    """

    cells: pl.DataFrame
    groups: pl.DataFrame
    _known: dict[tuple[str, ...], dict[tuple[Any, ...], dict[str, Any]]] = field(default_factory=dict, repr=False)

    def filter(self, *conditions: pl.Expr) -> Level:
        """The cells for which conditions on the columns of both tables hold."""
        return Level(self.cells.filter(*conditions), self.groups.filter(*conditions))

    def groups_with_mass(self) -> tuple[str, ...]:
        """The groups that have mass in a cell, in the order of the grouping."""
        return self._where("mass")

    def groups_with_keys(self) -> tuple[str, ...]:
        """The groups that have a key in a cell, or of which the number of keys is unknown, in the order of the grouping."""
        unknown = self.groups.filter(pl.col("keys").is_null())["group"].unique()
        having = {*self._where("keys"), *unknown}
        return tuple(name for name in self.groups["group"].unique(maintain_order=True) if name in having)

    def _where(self, column: str) -> tuple[str, ...]:
        return tuple(self.groups.filter(pl.col(column) > 0)["group"].unique(maintain_order=True))

    def by_group(self, *by: str) -> dict[tuple[Any, ...], dict[str, Any]]:
        """Rows of `groups` as dictionaries, by the values of the columns `by` and the group: `level.by_group("layer")[layer, name]`."""
        if by not in self._known:
            rows = self.groups.iter_rows(named=True)
            self._known[by] = {(*(row[name] for name in by), row["group"]): row for row in rows}
        return self._known[by]


def concat_levels(parts: Sequence[Level]) -> Level:
    """The rows of all parts, in order."""
    return Level(pl.concat([part.cells for part in parts]), pl.concat([part.groups for part in parts]))


def wide(groups: pl.DataFrame, measures: Sequence[str]) -> pl.DataFrame:
    """A table with a column `group` as one with a column `{measure}_{group}` (a single measure: `{group}`) for each."""
    index = groups.columns[: groups.columns.index("group")]
    return groups.pivot("group", index=index, values=list(measures), maintain_order=True)
