"""A result as files: each table, each picture, and `result.json` with the findings and what the columns mean."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path

import polars as pl

from vla_attention.analyze.core.result import Result
from vla_attention.analyze.render.output_files import replacing, write_text, writing

#: Rows that a Parquet file holds together. The writer keeps as many in memory, some 400 bytes each, and 75 kB of
#: each such group until the file ends.
_ROWS_TOGETHER = 60_000


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
