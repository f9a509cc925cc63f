"""Hostile tables: Parquet files that say much of themselves."""

from __future__ import annotations

import random
from collections.abc import Callable
from pathlib import Path

import numpy as np

from tests.thorough.hostile_data_sets.made import FRAMES, TABLE, Case, hostile
from tests.thorough.hostile_data_sets.parquet_writer import (
    FLOAT,
    PLAIN,
    Stored,
    constant,
    counting,
    page,
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


def patched(change: Callable[[bytearray], object], version: str = "v2.1") -> Make:
    """A real table with some of its bytes changed."""

    def make(robot: Path) -> None:
        content = bytearray((robot / TABLE[version]).read_bytes())
        change(content)
        (robot / TABLE[version]).write_bytes(content)

    return hostile(make, version=version)


def scattered(content: bytearray) -> None:
    generator = random.Random(5)
    for _ in range(200):
        content[generator.randrange(4, len(content) - 8)] = generator.randrange(256)


#: What ends the process that reads the file.
LIMITS = "cannot be read with 4 GB of memory"

TABLES: dict[str, Case] = {
    "a list of 720 million numbers in 300 bytes": Case(
        table(FRAMES, zeros("action", FRAMES, 6, last=720_000_000)), LIMITS
    ),
    "a billion rows in a kilobyte": Case(table(10**9), LIMITS),
    "300 million rows in a kilobyte": Case(table(300_000_000), r"has 300000000 rows .* frames 0 to 3|" + LIMITS),
    "half a table": Case(
        patched(lambda content: content.__delitem__(slice(len(content) // 2, None))), "cannot be read"
    ),
    "changed bytes": Case(patched(scattered), "cannot be read|cannot be decoded|has no column"),
}
