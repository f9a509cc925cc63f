"""Files that commands write: each appears whole or not at all; where one cannot be written, one sentence says so."""

from __future__ import annotations

import itertools
import math
import operator
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from vla_attention.schemas.errors import BadArgument, UserError

if TYPE_CHECKING:
    import polars as pl


#: How libraries in other languages (polars) write the number of an error of the operating system.
_NUMBER_OF_OS_ERROR = re.compile(r"\bos error ([0-9]{1,4})\b")
#: So many bytes more are written to a file to see whether the disk takes them.
_TRIED_BYTES = 1 << 16


def _refuse_in_store(path: Path, doing: str) -> None:
    from vla_attention.schemas.stores.store_place import refuse_in_store

    refuse_in_store(path, doing)


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`; on success it replaces `path`, on an error it is removed.

    The folder is made if it is missing. The temporary name starts with a dot and holds the process id, so that two
    processes never write to the same file.

    Raises:
        BadArgument: it is in a store.
        OSError: the file cannot be written; also where a library has made an error of its own out of it.
    """
    _refuse_in_store(path, "write")
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        yield temporary
        os.replace(temporary, path)
    except BaseException as error:
        refused = _refusal_in(error, temporary)
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
        if refused is None:
            raise
        raise OSError(refused.errno, refused.strerror, str(path)) from error


def _refusal_in(error: BaseException, file: Path) -> OSError | None:
    """What the operating system refused while a file was written, also where a library's error does not say so."""
    if isinstance(error, OSError) and error.errno is not None and error.filename is None:
        return error
    if isinstance(error, (UserError, KeyboardInterrupt)) or not isinstance(error, Exception):
        return None
    number = _NUMBER_OF_OS_ERROR.search(str(error))
    if number is not None:
        return OSError(int(number[1]), os.strerror(int(number[1])))
    if isinstance(error, OSError) or not file.exists():
        return None
    try:  # polars says "transport error" where the end of a Parquet file is refused
        with file.open("ab") as more:
            more.write(bytes(_TRIED_BYTES))
    except OSError as refused:
        return refused
    return None


@contextmanager
def writing(what: str, path: Path, instead: str = "another --output") -> Iterator[None]:
    """Turn an `OSError` in the block into one sentence: `what` cannot be written to `path`; give `instead`.

    Raises:
        BadArgument: `path` is in a store, or the block raised an `OSError` that is no `UserError`.
    """
    _refuse_in_store(path, f"write {what} to")
    try:
        yield
    except OSError as error:
        if isinstance(error, UserError):
            raise
        raise BadArgument(f"Cannot write {what} to {path}: {error.strerror or error}; give {instead}.") from None


def write_text(path: Path, text: str) -> None:
    """Write a UTF-8 text file atomically."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_parquet(
    folder: Path, about: Mapping[str, str] | None = None, /, **tables: pl.DataFrame | Iterable[pl.DataFrame]
) -> list[Path]:
    """Write each table as `NAME.parquet` into a folder, which is made if it is missing; returns the paths.

    `about` is written into the metadata of each file (`polars.read_parquet_metadata`). A table may be given in parts of
    the same columns: each is written before the next one is asked for, so that one of them is in memory at a time.

    Raises:
        BadArgument: the folder cannot be made or written to.
    """
    metadata = dict(about or {})
    return _write(
        folder,
        "parquet",
        tables,
        lambda table, path: table.write_parquet(path, metadata=metadata),
        lambda parts, path: _write_parquet_parts(parts, path, metadata),
    )


def write_csv(folder: Path, **tables: pl.DataFrame | Iterable[pl.DataFrame]) -> list[Path]:
    """As `write_parquet`, but `NAME.csv`: UTF-8, a header, nothing for null, `inf` for infinite."""
    return _write(folder, "csv", tables, lambda table, path: table.write_csv(path), _write_csv_parts)


def _write_csv_parts(parts: Iterable[pl.DataFrame], path: Path) -> None:
    with path.open("wb") as file:
        for number, part in enumerate(parts):
            part.write_csv(file, include_header=number == 0)


#: Fewest rows that a Parquet file holds together. The writer keeps as many in memory, some 400 bytes each, and 75 kB of
#: each such group until the file ends: for a table of N rows the sum is least with the square root of 190 N.
_ROWS_TOGETHER = 30_000


def _write_parquet_parts(table: Iterable[pl.DataFrame], path: Path, metadata: Mapping[str, str]) -> None:
    from polars.io.plugins import register_io_source

    parts = iter(table)
    first = next(parts)
    together = max(_ROWS_TOGETHER, math.isqrt(190 * first.height * operator.length_hint(table)))
    failed: list[BaseException] = []

    def source(
        columns: list[str] | None, predicate: pl.Expr | None, most: int | None, batch: int | None
    ) -> Iterator[pl.DataFrame]:
        try:
            for part in itertools.chain([first], parts):
                yield part if columns is None else part.select(columns)
        except BaseException as error:  # polars raises an error of its own, with this one's text
            failed.append(error)
            raise

    rows = register_io_source(source, schema=first.schema)
    try:
        # Given a path, a thread of polars makes the file, at times after an error of a part has been raised.
        with path.open("wb") as file:
            rows.sink_parquet(file, metadata=dict(metadata), row_group_size=together, engine="streaming")
    except Exception:
        if failed:
            raise failed[0] from None
        raise


def _write(
    folder: Path,
    ending: str,
    tables: Mapping[str, pl.DataFrame | Iterable[pl.DataFrame]],
    write: Callable[[pl.DataFrame, Path], object],
    write_parts: Callable[[Iterable[pl.DataFrame], Path], object],
) -> list[Path]:
    import polars as pl

    written = []
    with writing("results", folder):
        folder.mkdir(parents=True, exist_ok=True)
        if not os.access(folder, os.W_OK):
            raise PermissionError(13, "Permission denied")
        for name, table in tables.items():
            path = folder / f"{name}.{ending}"
            with replacing(path) as temporary:
                if isinstance(table, pl.DataFrame):
                    write(table, temporary)
                else:
                    write_parts(table, temporary)
            written.append(path)
    return written
