"""Tables as files: each appears whole, and a folder that cannot be written to is said in one sentence."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from pathlib import Path

import polars as pl

from vla_attention.analyze.show.atomic_file import replacing
from vla_attention.schemas.errors import BadArgument


def write_parquet(folder: Path, **tables: pl.DataFrame) -> list[Path]:
    """Write each table as `NAME.parquet` into a folder, which is made if it is missing; returns the paths.

    Raises:
        BadArgument: the folder cannot be made or written to.
    """
    return _write(folder, "parquet", pl.DataFrame.write_parquet, tables)


def write_csv(folder: Path, **tables: pl.DataFrame) -> list[Path]:
    """Write each table as `NAME.csv`, otherwise like `write_parquet`: UTF-8, a header, nothing for null, `inf` for infinite."""
    return _write(folder, "csv", pl.DataFrame.write_csv, tables)


def _write(
    folder: Path, ending: str, write: Callable[[pl.DataFrame, Path], object], tables: Mapping[str, pl.DataFrame]
) -> list[Path]:
    written = []
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not os.access(folder, os.W_OK):
            raise PermissionError(13, "Permission denied")
        for name, table in tables.items():
            path = folder / f"{name}.{ending}"
            with replacing(path) as temporary:
                write(table, temporary)
            written.append(path)
    except OSError as error:
        raise BadArgument(
            f"Cannot write results to {folder}: {error.strerror or error}; give another --output."
        ) from None
    return written
