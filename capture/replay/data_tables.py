"""Tables of a data set: of a Parquet file, polars decodes those columns and rows that are used."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.schemas.errors import UserError, listing


class DataSetError(UserError, ValueError):
    """A data set that cannot be used as it is."""


class DataSetNotFound(DataSetError, FileNotFoundError):
    """There is no data set, or a file of it is missing."""


class DamagedDataSet(DataSetError):
    """A file of a data set that cannot be read, or that contradicts the others."""


class DataTable:
    """One Parquet file of a data set. types: of its columns, by their names.

    Raises:
        DataSetNotFound: there is no such file.
        DamagedDataSet: it is no Parquet file, or damaged.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        if not path.is_file():
            raise DataSetNotFound(f"There is no '{path}', which the data set names.")
        with self._refusing():
            # Once: polars then reads the footer once. A name with brackets or a star is a name, not a pattern.
            self._scan = pl.scan_parquet(path, glob=False)
            self.types: Mapping[str, pl.DataType] = self._scan.collect_schema()

    def read(self, columns: Sequence[str], first: int = 0, count: int | None = None) -> pl.DataFrame:
        """Read columns in `count` rows from row `first` on; all rows without a count.

        Raises:
            DamagedDataSet: there is no such column, or it cannot be decoded.
        """
        missing = [name for name in columns if name not in self.types]
        if missing:
            raise DamagedDataSet(f"'{self.path}' has no column {listing(missing)}; it has {listing(self.types)}.")
        with self._refusing():
            return self._scan.select(columns).slice(first, count).collect()

    def numeric_columns(self) -> list[str]:
        """The columns of numbers or truth values, or of lists of them."""
        return [name for name, kind in self.types.items() if _is_numeric(kind)]

    def rows_of(self, episode: int) -> range:
        """The rows of an episode. They follow one another: rows between them count."""
        episodes, starts = self._runs
        runs = np.flatnonzero(episodes == episode)
        return range(int(starts[runs[0]]), int(starts[runs[-1] + 1])) if len(runs) else range(0)

    @cached_property
    def _runs(self) -> tuple[NDArray[np.generic], NDArray[np.int64]]:
        """Runs of rows of one episode: the episode of each, and where each begins, with the end of the last."""
        numbers = stacked(self.read(["episode_index"])["episode_index"])
        if numbers is None or numbers.shape[1] != 1:
            raise DamagedDataSet(f"'{self.path}' has no numbers in its column 'episode_index'.")
        changes = np.flatnonzero(numbers[1:, 0] != numbers[:-1, 0]) + 1
        starts = np.concatenate([[0], changes, [len(numbers)]])
        return numbers[starts[:-1], 0], starts

    @contextmanager
    def _refusing(self) -> Iterator[None]:
        try:
            yield
        except (pl.exceptions.PolarsError, pl.exceptions.PanicException, OSError) as error:
            raise DamagedDataSet(f"'{self.path}' cannot be read ({str(error).splitlines()[0]}).") from error


def _is_numeric(kind: Any) -> bool:
    while isinstance(kind, (pl.List, pl.Array)):
        kind = kind.inner
    return bool(kind.is_numeric() or kind == pl.Boolean)


def stacked(series: pl.Series) -> NDArray[np.generic] | None:
    """A column as (row, number), in the type that it is stored in; None unless each row has as many numbers.

    Lists of lists become one row of numbers. Where a number is missing, the column is of floats and has NaN.
    """
    rows = len(series)
    while isinstance(series.dtype, (pl.List, pl.Array)):
        if series.null_count():
            return None
        if isinstance(series.dtype, pl.List):
            lengths = series.list.len()
            if lengths.n_unique() > 1:
                return None
            if rows and not lengths[0]:  # an empty list is exploded to a missing value
                return np.zeros((rows, 0))
        series = series.explode()
    if not (series.dtype.is_numeric() or series.dtype == pl.Boolean):
        return None
    if series.dtype == pl.Boolean or series.dtype.is_decimal():
        series = series.cast(pl.Float64)
    values: NDArray[np.generic] = series.to_numpy()
    return values.reshape(rows, -1) if rows else np.zeros((0, 0))
