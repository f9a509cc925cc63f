"""Hostile tables: Parquet files that say much of themselves."""

from __future__ import annotations

import base64
import contextlib
import random
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import polars as pl

from tests.thorough.hostile_data_sets.made import FRAMES, TABLE, Case, hostile
from tests.thorough.hostile_data_sets.parquet_writer import (
    FLOAT,
    GZIP,
    I32,
    I64,
    INT64,
    LIST,
    PLAIN,
    STRUCT,
    Stored,
    constant,
    counting,
    dictionary,
    page,
    run,
    struct_of,
    varint,
    write_parquet,
    zeros,
)
from tests.thorough.hostile_runs import Make

PATH = TABLE["v2.1"]


def table(rows: int, *columns: Stored) -> Make:
    """The table of the only episode, with these columns in the place of those of the same name."""

    def change(robot: Path) -> None:
        usual = [counting("frame_index", rows)] if rows == FRAMES else [constant("frame_index", rows)]
        usual += [zeros(name, FRAMES, 6) for name in ("observation.state", "action")]
        usual += [constant(name, rows) for name in ("episode_index", "task_index")]
        seconds = page((np.arange(FRAMES) / 10).astype("<f4").tobytes(), FRAMES, encoding=PLAIN)
        usual.append(Stored("timestamp", FLOAT, seconds, FRAMES, has_dictionary=False))
        named = {column.name: column for column in (*usual, *columns)}
        write_parquet(robot / PATH, list(named.values()), rows)

    return hostile(change)


def action(pages: bytes, values: int = FRAMES, **more: object) -> Make:
    """A table whose actions have these pages."""
    column = Stored("action", **{"kind": FLOAT, "has_dictionary": False, **more}, pages=pages, values=values)  # type: ignore[arg-type]
    return table(FRAMES, column)


def footer(content: bytes) -> Make:
    return hostile(lambda robot: write_parquet(robot / PATH, [], 0, footer=content))


def patched(change: Callable[[bytearray], object], version: str = "v2.1") -> Make:
    """A real table with some of its bytes changed."""

    def make(robot: Path) -> None:
        content = bytearray((robot / TABLE[version]).read_bytes())
        change(content)
        (robot / TABLE[version]).write_bytes(content)

    return hostile(make, version=version)


def fixed_lists(robot: Path) -> None:
    """Lists of a fixed size, of which one is missing; the schema says that the size is a billion."""
    path = robot / PATH
    rows = pl.read_parquet(path)
    lists = rows["action"].to_list()
    lists[1] = None
    rows = rows.with_columns(pl.Series("action", lists, dtype=pl.Array(pl.Float32, 6)))
    rows.drop("observation.images.front").write_parquet(path)
    content = path.read_bytes()
    key = content.index(b"ARROW:schema") + len(b"ARROW:schema") + 1
    length, shift = 0, 0
    while True:
        byte = content[key]
        key, length, shift = key + 1, length | (byte & 127) << shift, shift + 7
        if byte < 128:
            break
    schema = base64.b64decode(content[key : key + length])
    for place in range(0, len(schema) - 3, 4):
        if schema[place : place + 4] == struct.pack("<i", 6):
            changed = schema[:place] + struct.pack("<i", 10**9) + schema[place + 4 :]
            path.write_bytes(content[:key] + base64.b64encode(changed) + content[key + length :])
            with contextlib.suppress(pl.exceptions.PolarsError):
                if pl.read_parquet_schema(path)["action"] == pl.Array(pl.Float32, 10**9):
                    return
    raise LookupError("there is no such size in the schema")


def wide_schema(columns: int) -> bytes:
    leaf = struct_of((1, I32, INT64), (3, I32, 0), (4, 8, b"b"))
    root = struct_of((4, 8, b"a"), (5, I32, columns))
    return struct_of((1, I32, 1), (2, LIST, (STRUCT, [root, *[leaf] * columns])), (3, I64, 0), (4, LIST, (STRUCT, [])))


def scattered(content: bytearray) -> None:
    generator = random.Random(5)
    for _ in range(200):
        content[generator.randrange(4, len(content) - 8)] = generator.randrange(256)


ZEROS = zlib.compress(bytes(300_000_000), 9, 31)  # gzip
FLOATS = np.zeros(FRAMES * 6, dtype="<f4").tobytes()
#: What ends the process that reads the file.
LIMITS = "cannot be read with 4 GB of memory"

TABLES: dict[str, Case] = {
    "a list of 720 million numbers in 300 bytes": Case(
        table(FRAMES, zeros("action", FRAMES, 6, last=720_000_000)), LIMITS
    ),
    "a billion rows in a kilobyte": Case(table(10**9), LIMITS),
    "300 million rows in a kilobyte": Case(table(300_000_000), r"has 300000000 rows .* frames 0 to 3|" + LIMITS),
    "300 MB of zeros, packed": Case(
        action(page(bytes(300_000_000), FRAMES, encoding=PLAIN, stored=ZEROS), codec=GZIP),
        "has 1 numbers in each frame, and .* says 6",
    ),
    "a page of more values than its column": Case(action(page(b"\x01" + run(0, 10**9), 10**9)), "cannot be read"),
    "a page behind the end": Case(action(page(FLOATS, FRAMES, encoding=PLAIN, packed=10**6)), "cannot be read"),
    "a dictionary of a billion": Case(
        action(
            dictionary(b"", 10**9) + page(b"\x01" + run(0, FRAMES), FRAMES), has_dictionary=True, dictionary_bytes=20
        ),
        LIMITS,
    ),
    "lists of a fixed size of a billion": Case(hostile(fixed_lists), LIMITS),
    "a footer of 100 MB": Case(footer(bytes([0x19]) * 100_000_000), "cannot be read"),
    "a footer of lists in lists": Case(footer(bytes([0x19, 0x19]) * 1_000_000), "cannot be read"),
    "a list of 2^60 groups": Case(
        footer(struct_of((2, LIST, (STRUCT, [])))[:-1] + bytes([0x29, 0xFC]) + varint(2**60)), "cannot be read"
    ),
    "a million columns": Case(footer(wide_schema(1_000_000)), "cannot be read"),
    "half a table": Case(
        patched(lambda content: content.__delitem__(slice(len(content) // 2, None))), "cannot be read"
    ),
    "changed bytes": Case(patched(scattered), "cannot be read|cannot be decoded|has no column"),
}
