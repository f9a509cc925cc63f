"""Arrays of one episode as rows of a table. Every table of `analyze` that comes from arrays is made here.

Tables are tidy: one row per cell (replan, layer, ...), or per cell and group, with measures as columns. NaN (undefined)
is null in a table; infinite ratios stay infinite.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np
import polars as pl
from numpy.typing import NDArray
from polars.io.plugins import register_io_source

from vla_attention.analyze.measures.selected import SelectedEpisode
from vla_attention.analyze.stores.selection import Selection
from vla_attention.schemas.safe_text import visible

#: The columns that name an episode.
EPISODE_ID = ("suite", "task_id", "episode_index")
_EPISODE_TYPES = {
    "suite": pl.String, "task_id": pl.Int64, "instruction": pl.String, "episode_index": pl.Int64,
    "success": pl.Boolean, "num_steps": pl.Int64,
}  # fmt: skip
#: The columns that describe an episode; the last ones follow from its name.
EPISODE_KEYS = tuple(_EPISODE_TYPES)
#: The layer that stands for the mean over all layers.
LAYERS_AVG = "layers_avg"

#: What tables are made of, one for each episode.
Measured = TypeVar("Measured")
#: One axis: the columns that label it, each with a value per position.
Axis = Mapping[str, Sequence[Any] | NDArray[Any] | pl.Series]
#: Rows of so many are handed on at once: whatever polars is asked takes a millisecond, of an episode as of a dozen.
_ROWS_AT_ONCE = 20_000


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
    columns = episode_columns(item, keys, height)
    for i, axis in enumerate(axes):
        inner = int(np.prod(shape[i + 1 :]))
        position = np.tile(np.repeat(np.arange(shape[i]), inner), height // max(1, shape[i] * inner))
        for name, labels in axis.items():
            columns[name] = _labels(name, labels)[position]
    columns |= {name: pl.Series(name, np.broadcast_to(array, shape).ravel()) for name, array in values.items()}
    measured = [name for name in values if columns[name].dtype.is_float()]
    # At once: each call takes polars as long as a column of one episode.
    return pl.DataFrame(columns).with_columns(pl.col(measured).fill_nan(None))


def episode_columns(item: SelectedEpisode, keys: Sequence[str], height: int) -> dict[str, pl.Series]:
    """The columns that describe an episode, of `EPISODE_KEYS`, each with its value in so many rows."""
    values = {name: item.store.suite if name == "suite" else getattr(item.episode.attributes, name) for name in keys}
    # Instructions are any text, and tables are printed and drawn.
    shown = {name: visible(value) if isinstance(value, str) else value for name, value in values.items()}
    return {
        name: pl.Series(name, [value], dtype=_EPISODE_TYPES[name]).new_from_index(0, height)
        for name, value in shown.items()
    }


def _labels(name: str, labels: Sequence[Any] | NDArray[Any] | pl.Series) -> pl.Series:
    if isinstance(labels, pl.Series):  # a Series keeps its type where all labels are null
        return labels
    series = pl.Series(name, labels.tolist() if isinstance(labels, np.ndarray) else list(labels))
    return series.cast(pl.Int64) if series.dtype == pl.Null else series


def layer_name(layer: str, average: str) -> str:
    """A layer's label in tables as text: `layer 5`, or `average` for the mean over the selected ones."""
    return average if layer == LAYERS_AVG else f"layer {layer}"


def float_values(column: pl.Series) -> NDArray[np.float64]:
    """A column of numbers as an array; NaN for null."""
    return column.cast(pl.Float64).fill_null(float("nan")).to_numpy()


def replan_axis(item: SelectedEpisode) -> Axis:
    """Labels `replan` and `env_step`."""
    steps = item.episode.read("env_step").astype(np.int64)
    return {"replan": range(len(steps)), "env_step": steps}


def layer_axis(selection: Selection) -> Axis:
    """Labels `layer`, `layer_number` (as the user numbers it, as text and as number) and `block`, then "layers_avg"."""
    return {
        "layer": [*map(str, selection.layer_labels), LAYERS_AVG],
        "layer_number": [*selection.layer_labels, None],
        "block": [*selection.blocks, None],
    }


def head_axis(selection: Selection) -> Axis:
    """Label `head`; null where heads were averaged."""
    return {"head": selection.head_numbers if selection.per_head else (None,)}


def with_average(
    values: NDArray[np.float64],
    selection: Selection,
    axis: int = 1,
    mean: Callable[[NDArray[np.float64], int], NDArray[np.float64]] = np.mean,
) -> NDArray[np.float64]:
    """Append the mean over the layers along `axis`; `mean(values, axis)` says how, for instance `finite_mean`."""
    average = mean(np.take(values, selection.once, axis=axis), axis)
    return np.concatenate([values, np.expand_dims(average, axis)], axis=axis)


def frame_of_episodes(
    measured: Sequence[Measured],
    make: Callable[[Measured], pl.DataFrame],
    then: Callable[[pl.DataFrame], pl.DataFrame] = lambda rows: rows,
) -> pl.LazyFrame:
    """The rows that `make` gives of each member, in order; the same columns of each. They are made at each collect.

    `then` makes other rows of those of some whole episodes. Neither reads a store: polars would wrap the error of a
    damaged one into its own.
    """
    schema = then(make(measured[0])).schema

    def batches() -> Iterator[pl.DataFrame]:
        batch: list[pl.DataFrame] = []
        for number, one in enumerate(measured, start=1):
            batch.append(make(one))
            if number == len(measured) or sum(table.height for table in batch) >= _ROWS_AT_ONCE:
                yield then(pl.concat(batch))
                batch = []

    def source(
        columns: list[str] | None, predicate: pl.Expr | None, most: int | None, _batch: int | None
    ) -> Iterator[pl.DataFrame]:
        left = most
        for part in batches():
            rows = part if predicate is None else part.filter(predicate)
            rows = rows if columns is None else rows.select(columns)
            yield rows if left is None else rows.head(left)
            if left is not None and (left := left - rows.height) <= 0:
                return

    return register_io_source(source, schema=schema, validate_schema=False)
