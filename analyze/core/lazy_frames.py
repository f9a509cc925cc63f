"""Tables with rows of every episode, made when they are asked for: those of thousands would fill the memory."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

import polars as pl
from polars.io.plugins import register_io_source

Measured = TypeVar("Measured")
#: Rows of so many are handed on at once: whatever polars is asked takes a millisecond, of an episode as of a dozen.
_ROWS_AT_ONCE = 20_000


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

    def source(
        columns: list[str] | None, predicate: pl.Expr | None, most: int | None, _batch: int | None
    ) -> Iterator[pl.DataFrame]:
        left = most
        for batch in _in_batches(make(one) for one in measured):
            part = then(batch)
            rows = part if predicate is None else part.filter(predicate)
            rows = rows if columns is None else rows.select(columns)
            yield rows if left is None else rows.head(left)
            if left is not None and (left := left - rows.height) <= 0:
                return

    return register_io_source(source, schema=schema, validate_schema=False)


def _in_batches(parts: Iterator[pl.DataFrame]) -> Iterator[pl.DataFrame]:
    batch: list[pl.DataFrame] = []
    for part in parts:
        batch.append(part)
        if sum(table.height for table in batch) >= _ROWS_AT_ONCE:
            yield pl.concat(batch)
            batch = []
    if batch:
        yield pl.concat(batch)
