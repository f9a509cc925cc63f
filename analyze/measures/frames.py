"""Arrays of one episode as rows of a table. Every table of `analyze` that comes from arrays is made here.

Tables are tidy: one row per cell (replan, layer, ...), or per cell and group, with measures as columns. NaN (undefined)
is null in a table; infinite ratios stay infinite.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.measures.selected import SelectedEpisode
from vla_attention.analyze.stores.selection import Selection
from vla_attention.schemas.safe_text import visible

#: The columns that name an episode.
EPISODE_ID = ("suite", "task_id", "episode_index")
#: The columns that describe an episode; the last ones follow from its name.
EPISODE_KEYS = ("suite", "task_id", "instruction", "episode_index", "success", "num_steps")
#: The layer that stands for the mean over all layers.
LAYERS_AVG = "layers_avg"

#: What tables are made of, one for each episode.
Measured = TypeVar("Measured")
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
        The columns `keys`, the labels of the axes, then `values`. Labels are Int64, Float64, Boolean or String; None is
        null.
    """
    shape = tuple(len(next(iter(axis.values()))) for axis in axes)
    height = int(np.prod(shape))
    columns: dict[str, pl.Series] = {name: _constant(name, item, height) for name in keys}
    for i, axis in enumerate(axes):
        inner = int(np.prod(shape[i + 1 :]))
        position = np.tile(np.repeat(np.arange(shape[i]), inner), height // max(1, shape[i] * inner))
        for name, labels in axis.items():
            columns[name] = _labels(name, labels)[position]
    columns |= {name: pl.Series(name, np.broadcast_to(array, shape).ravel()) for name, array in values.items()}
    measured = [name for name in values if columns[name].dtype.is_float()]
    # At once: each call takes polars as long as a column of one episode.
    return pl.DataFrame(columns).with_columns(pl.col(measured).fill_nan(None))


def _constant(name: str, item: SelectedEpisode, height: int) -> pl.Series:
    value = item.store.suite if name == "suite" else getattr(item.episode.attributes, name)
    if name == "success":
        return pl.Series(name, [value], dtype=pl.Boolean).new_from_index(0, height)  # null where it is not known
    # Instructions are any text, and tables are printed and drawn.
    return _labels(name, [visible(value) if isinstance(value, str) else value]).new_from_index(0, height)


def episode_columns(items: Sequence[SelectedEpisode], keys: Sequence[str]) -> dict[str, pl.Series]:
    """The columns that describe episodes, of `EPISODE_KEYS`, with one value for each episode."""
    return {name: pl.concat([_constant(name, item, 1) for item in items]) for name in keys}


def _labels(name: str, labels: Sequence[Any] | NDArray[Any] | pl.Series) -> pl.Series:
    if isinstance(labels, pl.Series):  # a Series keeps its type where all labels are null
        return labels
    given = labels.tolist() if isinstance(labels, np.ndarray) else list(labels)
    known = next((label for label in given if label is not None), 0)
    kinds = {bool: pl.Boolean, int: pl.Int64, float: pl.Float64, str: pl.String}
    return pl.Series(name, given, dtype=kinds[type(known)])


def layer_name(layer: str, average: str = "all layers", noun: str = "layer") -> str:
    """A layer's label in tables as text: `layer 5`, or `average` for the mean over the selected ones."""
    return average if layer == LAYERS_AVG else f"{noun} {layer}"


def float_values(column: pl.Series) -> NDArray[np.float64]:
    """A column of numbers as an array; NaN for null."""
    return column.cast(pl.Float64).fill_null(float("nan")).to_numpy()


def episode_id(item: SelectedEpisode) -> tuple[str, int, int]:
    """The values of `EPISODE_ID`."""
    attributes = item.episode.attributes
    return item.store.suite, attributes.task_id, attributes.episode_index


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
        once = tuple(i for i in range(len(blocks)) if selection.is_first_of_block(i))
        if len(labels) == 1 and not average_one:
            return cls(labels, numbers, blocks, once)
        return cls((*labels, LAYERS_AVG), (*numbers, None), (*blocks, None), once)

    @property
    def num_layers(self) -> int:
        """Number of layers, without the average."""
        return sum(number is not None for number in self.numbers)

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
