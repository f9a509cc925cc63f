"""Files that commands write: each appears whole or not at all; where one cannot be written, one sentence says so.

A result is `result.json`, with the findings and what the columns mean, and a file for each table.
"""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict
from pathlib import Path

import polars as pl

from vla_attention.analyze.core.result import Result
from vla_attention.schemas.errors import BadArgument, UserError
from vla_attention.schemas.stores.store_place import refuse_in_store

#: How libraries in other languages (polars) write the number of an error of the operating system.
_NUMBER_OF_OS_ERROR = re.compile(r"\bos error ([0-9]{1,4})\b")
#: Rows that a Parquet file holds together. The writer keeps as many in memory, some 400 bytes each, and 75 kB of
#: each such group until the file ends.
_ROWS_TOGETHER = 60_000


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`; on success it replaces `path`, on an error it is removed.

    The folder is made if it is missing. The temporary name starts with a dot and holds the process id, so that two
    processes never write to the same file.

    Raises:
        BadArgument: it is in a store.
        OSError: the file cannot be written; also where a library has made an error of its own out of it.
    """
    refuse_in_store(path, "write")
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        yield temporary
        os.replace(temporary, path)
    except BaseException as error:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
        # What the operating system refused while the file was written, also where polars says it in its own error.
        refused = _NUMBER_OF_OS_ERROR.search(str(error)) if isinstance(error, Exception) else None
        number = int(refused[1]) if refused else error.errno if isinstance(error, OSError) else None
        if number is None or isinstance(error, UserError) or getattr(error, "filename", None) is not None:
            raise
        raise OSError(number, os.strerror(number), str(path)) from error


@contextmanager
def writing(what: str, path: Path, instead: str = "another --output") -> Iterator[None]:
    """Turn an `OSError` in the block into one sentence: `what` cannot be written to `path`; give `instead`.

    Raises:
        BadArgument: `path` is in a store, or the block raised an `OSError` that is no `UserError`.
    """
    refuse_in_store(path, f"write {what} to")
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


def write_result(result: Result, folder: Path, csv: bool = False) -> list[Path]:
    """Write tables (Parquet, or CSV) and `result.json`; returns the paths. Each file appears whole or not at all.

    Raises:
        BadArgument: the folder cannot be made or written to.
    """
    ending = "csv" if csv else "parquet"
    tables = [table for table in result.tables if table.file and not table.of]
    about = {"title": result.title, "about": " ".join(result.about)}
    with writing("results", folder):
        folder.mkdir(parents=True, exist_ok=True)
        for table in tables:
            with replacing(folder / f"{table.name}.{ending}") as temporary:
                if csv:
                    table.frame.lazy().sink_csv(temporary, engine="streaming")
                else:
                    write_parquet(table.frame, temporary, about)
        write_text(folder / "result.json", json.dumps(document(result, ending), indent=1, ensure_ascii=False) + "\n")
        for name, write in result.files.items():
            with replacing(folder / name) as temporary:
                write(temporary)
    names = ["result.json", *(f"{table.name}.{ending}" for table in tables), *result.files]
    return [folder / name for name in names]


def document(result: Result, ending: str = "parquet") -> dict[str, object]:
    """The result without its tables' rows, for JSON."""
    return {
        "title": result.title,
        "about": list(result.about),
        "findings": [{**asdict(one), "numbers": _jsonable(one.numbers)} for one in result.findings],
        "notes": list(result.notes),
        "tables": {
            table.name: {
                "file": f"{table.of or table.name}.{ending}",
                "title": table.title,
                "columns": {column.name: {"kind": column.kind, "meaning": column.meaning} for column in table.columns},
            }
            for table in result.tables
            if table.file
        },
        "figures": {figure.name: {"title": figure.title, "caption": figure.caption} for figure in result.figures},
    }


def _jsonable(numbers: Mapping[str, float | int | str | None]) -> dict[str, float | int | str | None]:
    """JSON has no NaN and no infinity: None, and the text "inf"."""
    return {
        name: (None if math.isnan(value) else str(value)) if isinstance(value, float) and not math.isfinite(value)
        else value
        for name, value in numbers.items()
    }  # fmt: skip


def write_parquet(frame: pl.DataFrame | pl.LazyFrame, path: Path, about: Mapping[str, str]) -> None:
    """Write a frame; of a lazy one a part is in memory at a time. `about` is written into the file's metadata."""
    if isinstance(frame, pl.DataFrame):
        frame.write_parquet(path, metadata=dict(about))
        return
    # Given a path, a thread of polars makes the file, at times after an error of a part has been raised.
    with path.open("wb") as file:
        frame.sink_parquet(file, metadata=dict(about), row_group_size=_ROWS_TOGETHER, engine="streaming")
