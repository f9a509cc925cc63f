"""Tables of a data set: Parquet files that are checked; polars decodes those columns and rows that are used."""

from __future__ import annotations

import os
import sys
import tempfile
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.capture.foreign_files.parquet_files import ParquetFile, ParquetRefused
from vla_attention.schemas.errors import UserError, listing
from vla_attention.schemas.regular_files import NotRegular


class DataSetError(UserError, ValueError):
    """A data set that cannot be used as it is."""


class DataSetNotFound(DataSetError, FileNotFoundError):
    """There is no data set, or a file of it is missing."""


class DamagedDataSet(DataSetError):
    """A file of a data set that cannot be read, or that contradicts the others."""


#: The descriptor of stderr belongs to the whole process.
_STDERR = threading.Lock()


class DataTable:
    """One Parquet file of a data set. columns: their names.

    Raises:
        DataSetNotFound: there is no such file.
        DamagedDataSet: it is no Parquet file, or damaged.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        if not path.is_file():
            raise DataSetNotFound(f"There is no '{path}', which the data set names.")
        with self._refusing():
            self.file = ParquetFile(path)
            # Once: polars then reads the footer once. A name with brackets or a star is a name, not a pattern.
            self._scan = pl.scan_parquet(path, glob=False)
            with _quietly():
                self._types = self._scan.collect_schema()
        self.columns = self.file.columns
        self._runs: tuple[NDArray[np.generic], NDArray[np.int64]] | None = None

    def read(self, columns: Sequence[str], first: int = 0, count: int | None = None) -> pl.DataFrame:
        """Read columns in `count` rows from row `first` on; all rows without a count.

        Raises:
            DamagedDataSet: there is no such column, it cannot be decoded, or takes more memory than what is stored of
                it can be worth.
        """
        count = self.file.rows - first if count is None else count
        missing = [name for name in columns if name not in self.columns]
        if missing:
            raise DamagedDataSet(f"'{self.path}' has no column {listing(missing)}; it has {listing(self.columns)}.")
        with self._refusing():
            self.file.check(columns, first, count)
            for name in columns:
                self._check_lists(name, first, count)
            with _quietly():
                return self._scan.select(columns).slice(first, count).collect()

    def rows_of(self, column: str, value: int) -> range:
        """The rows in which a column of whole numbers has a value. They follow one another: rows between them count."""
        if self._runs is None:
            numbers = stacked(self.read([column])[column])
            if numbers is None or numbers.shape[1] != 1:
                raise DamagedDataSet(f"'{self.path}' has no numbers in its column '{column}'.")
            changes = np.flatnonzero(numbers[1:, 0] != numbers[:-1, 0]) + 1
            starts = np.concatenate([[0], changes, [len(numbers)]])
            self._runs = numbers[starts[:-1], 0], starts
        values, starts = self._runs
        runs = np.flatnonzero(values == value)
        return range(int(starts[runs[0]]), int(starts[runs[-1] + 1])) if len(runs) else range(0)

    def _check_lists(self, column: str, first: int, count: int) -> None:
        """Raise `DamagedDataSet` where lists of a fixed size, which a few bytes may say is a billion, are missing.

        Polars makes a list of that size for each.
        """
        kind: object = self._types[column]
        size = 1
        while isinstance(kind, pl.Array):
            size *= kind.size
            kind = kind.inner
        if _has_fixed_lists(kind):
            raise DamagedDataSet(
                f"'{self.path}' has {self._types[column]} in its column '{column}', which is not read."
            )
        rows, values = self.file.rows_and_values(column, first, count)
        if size > 1 and values != rows * size:
            raise DamagedDataSet(
                f"'{self.path}' has {values:,} numbers in {rows:,} rows of its column '{column}'; expected {size:,} in "
                "each row."
            )

    @contextmanager
    def _refusing(self) -> Iterator[None]:
        try:
            yield
        except ParquetRefused as error:
            raise DamagedDataSet(f"'{self.path}' {error}.") from error
        except NotRegular as error:
            raise DamagedDataSet(f"'{self.path}' cannot be read: {error.strerror}.") from error
        except (pl.exceptions.PolarsError, pl.exceptions.PanicException, OSError) as error:
            raise DamagedDataSet(f"'{self.path}' cannot be read ({str(error).splitlines()[0]}).") from error


def _has_fixed_lists(kind: object) -> bool:
    if isinstance(kind, pl.Struct):
        return any(_has_fixed_lists(part.dtype) for part in kind.fields)
    return isinstance(kind, pl.Array) or (isinstance(kind, pl.List) and _has_fixed_lists(kind.inner))


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


@contextmanager
def _quietly() -> Iterator[None]:
    """What polars writes about a panic stays away from the terminal: its error says it, in one line.

    Polars writes to the descriptor itself, from threads of its own. Anything else that was written meanwhile follows.
    """
    with suppress(OSError, ValueError):
        sys.stderr.flush()
    with _STDERR, tempfile.TemporaryFile() as caught:
        try:
            kept = os.dup(2)
        except OSError:  # there is no stderr
            yield
            return
        try:
            os.dup2(caught.fileno(), 2)
            yield
        except pl.exceptions.PanicException:
            caught.truncate(0)
            raise
        finally:
            os.dup2(kept, 2)
            os.close(kept)
            caught.seek(0)
            with suppress(OSError):
                os.write(2, caught.read())
