"""Hostile meta files: `info.json`, tasks and episodes, as lines and as tables."""

from __future__ import annotations

import json
from pathlib import Path

from tests.thorough.hostile_checkpoints.hostile_files import pipe, sparse
from tests.thorough.hostile_data_sets.made import Case, hostile, info, written
from tests.thorough.hostile_data_sets.parquet_writer import constant, counting, texts, write_parquet

LINES, TASKS = "meta/episodes.jsonl", "meta/tasks.jsonl"
TASK_TABLE, EPISODE_TABLE = "meta/tasks.parquet", "meta/episodes/chunk-000/file-000.parquet"
LINE = {"episode_index": 0, "tasks": ["open it"], "length": 4}


def lines(count: int, **changes: object) -> bytes:
    return (json.dumps({**LINE, **changes}) + "\n").encode() * count


def tasks_table(rows: int, text: bytes) -> object:
    def change(robot: Path) -> None:
        write_parquet(robot / TASK_TABLE, [constant("task_index", rows), texts("task", text, rows)], rows)

    return change


def episodes_table(rows: int, task: bytes, **values: int) -> object:
    """A table of so many times the same episode."""

    def change(robot: Path) -> None:
        numbers = {"episode_index": 0, "length": 4, "data/chunk_index": 0, "data/file_index": 0, **values}
        columns = [constant(name, rows, value) for name, value in numbers.items()]
        write_parquet(robot / EPISODE_TABLE, [*columns, texts("tasks", task, rows, repeated=True)], rows)

    return change


INFO: dict[str, Case] = {
    "a large info.json": Case(
        written("meta/info.json", b'{"a": "' + b"x" * 9_000_000 + b'"}'), r"info\.json.*expected at most 8,000,000"
    ),
    "a pipe for info.json": Case(hostile(lambda robot: pipe(robot / "meta/info.json")), r"has no meta/info\.json"),
    "lists in lists": Case(written("meta/info.json", b"[" * 100_000), "nested too deep"),
    "a number of 5,000 digits": Case(
        written("meta/info.json", b'{"fps": ' + b"9" * 5000 + b"}"), "not valid JSON|digits"
    ),
    "a feature of 10^12 numbers": Case(
        info(lambda it: it["features"]["action"].update(shape=[10**6, 10**6])),
        "are the actions is not known",
    ),
    "a template of a megabyte": Case(
        info(lambda it: it.update(data_path="{episode_index:099d}" * 50_000)), "The operating system refused"
    ),
}

LINES_CASES: dict[str, Case] = {
    "episodes without end": Case(
        hostile(lambda robot: sparse(robot / LINES, 2**43, lines(10))),
        "cannot be read with 4 GB of memory",
    ),
    "a line of 100 MB": Case(
        hostile(lambda robot: (robot / LINES).write_bytes(b'{"a": "' + b"x" * 100_000_000)),
        "is not one JSON object per line",
    ),
    "a million lists": Case(written(LINES, b"[" + b"[]," * 1_100_000 + b"[]]"), "is not one JSON object per line"),
    "an episode of a trillion frames": Case(
        written(LINES, lines(1, length=10**12)), r"has 4 rows .* frames 0 to 999999999999"
    ),
    "half a character": Case(
        written(LINES, b'{"episode_index": 0, "length": 4, "tasks": ["\\ud800"]}'), "not one JSON object per line"
    ),
    "a pipe for episodes": Case(hostile(lambda robot: pipe(robot / LINES)), r"no '.*episodes\.jsonl'"),
    "tasks without end": Case(
        hostile(lambda robot: sparse(robot / TASKS, 2**43)), "cannot be read with 4 GB of memory"
    ),
}

TABLE_CASES: dict[str, Case] = {
    "a task a million times": Case(
        hostile(tasks_table(1_000_000, b"x" * 100_000), version="v3.0"),
        "meta' cannot be read with 4 GB of memory",
    ),
    "a billion episodes": Case(
        hostile(episodes_table(1_000_000_000, b"a"), version="v3.0"), "meta' cannot be read with 4 GB of memory"
    ),
    "an episode of 2^62 frames": Case(hostile(episodes_table(1, b"a", length=2**62), version="v3.0"), "has 4 rows"),
    "a file of number -1": Case(
        hostile(episodes_table(1, b"a", **{"data/file_index": -1}), version="v3.0"), "lacks 1 of the files"
    ),
    "tasks that are no texts": Case(
        hostile(
            lambda robot: write_parquet(robot / TASK_TABLE, [counting("task_index", 2), counting("task", 2)], 2),
            version="v3.0",
        ),
        "should have the columns task and task_index",
    ),
}

META = {**INFO, **LINES_CASES, **TABLE_CASES}
