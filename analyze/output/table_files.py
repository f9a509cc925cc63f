"""Tables as files: each appears whole, and a folder that cannot be written to is said in one sentence."""

from __future__ import annotations

import os
from pathlib import Path

import polars as pl

from analyze.output.atomic_file import replacing
from schemas.errors import BadArgument


def write_parquet(folder: Path, **tables: pl.DataFrame) -> list[Path]:
    """Write each table as `NAME.parquet` into a folder, which is made if it is missing; returns the paths.

    Raises:
        BadArgument: the folder cannot be made or written to.
    """
    written = []
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not os.access(folder, os.W_OK):
            raise PermissionError(13, "Permission denied")
        for name, table in tables.items():
            path = folder / f"{name}.parquet"
            with replacing(path) as temporary:
                table.write_parquet(temporary)
            written.append(path)
    except OSError as error:
        raise BadArgument(
            f"Cannot write results to {folder}: {error.strerror or error}; give another --output."
        ) from None
    return written
