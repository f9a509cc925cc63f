"""Another grouping of an open store, and analyses from the cache: of fifty episodes, and of five hundred.

Usage: python benchmarks/regrouping.py --fifty PATH --five-hundred PATH [--rounds 5]

`--fifty` is a store as `benchmarks/analysis_speed.py --store PATH` writes it (pi0.5 in LIBERO's shape, 1 GB);
`--five-hundred` is written from it, by hard links, unless it exists. Every round measures each of them in turn:

open store      seconds in this process for all tables with intervals of a grouping of spans (masses come from atoms):
                of a grouping that nobody asked for before (cold), and of one that is in the cache (warm). Tokens of the
                episodes were read by a question before, as in a notebook.
commands        seconds of whole processes: the default analysis with pictures, first without anything in the cache,
                then again; the same without pictures; and a grouping of words, which needs the rows.

Writes benchmarks/rows/regrouping.json. Two threads, in which the program works on episodes.
"""

from __future__ import annotations

import argparse
import os
import shutil
import sys
import tempfile
import time
from pathlib import Path

from measurement import Table, fix_threads, measured, run_process, write_rows
from repeated_store import repeat_store

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))
#: Groupings of spans of one cost; a store is asked about the first before anything is measured.
GROUPINGS = ("cameras", "instruction", "default")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--fifty", type=Path, required=True)
    parser.add_argument("--five-hundred", type=Path, required=True)
    parser.add_argument("--rounds", type=int, default=5)
    arguments = parser.parse_args()
    fix_threads(2)
    if not arguments.five_hundred.exists():
        repeat_store(arguments.fifty, arguments.five_hundred, 10)
    with tempfile.TemporaryDirectory(prefix="regrouping_") as scratch:
        cache = Path(scratch, "cache")
        os.environ["VLA_CACHE"] = str(cache)
        tables = {
            "open_store": open_store_table({50: arguments.fifty, 500: arguments.five_hundred}, arguments.rounds, cache),
            "commands": command_table(arguments.fifty, arguments.rounds, cache, Path(scratch, "out")),
        }
    write_rows("regrouping", tables)


def open_store_table(stores: dict[int, Path], rounds: int, cache: Path) -> Table:
    import vla_attention as va

    seconds: dict[tuple[int, str], list[float]] = {}
    runs = {}
    for number, path in stores.items():
        runs[number] = va.open(path)
        runs[number].analyze(grouping=GROUPINGS[0])["tasks"]
    for turn in range(rounds):
        for number, run in runs.items():
            grouping = GROUPINGS[1 + turn % 2]
            shutil.rmtree(cache, ignore_errors=True)
            for kind in ("cold", "warm"):
                run._analyses.clear()  # what is kept in memory answers at once
                began = time.perf_counter()
                run.analyze(grouping=grouping)["tasks"]
                seconds.setdefault((number, kind), []).append(time.perf_counter() - began)
    names = {"cold": "nobody asked before", "warm": "in the cache"}
    rows = [
        {"episodes": number, "asked": names[kind], "seconds": measured(values)}
        for (number, kind), values in seconds.items()
    ]
    return Table({"episodes": "episodes", "asked": "another grouping of spans", "seconds": "seconds"}, rows)


def command_table(store: Path, rounds: int, cache: Path, out: Path) -> Table:
    command = [sys.executable, "-m", "vla_attention.analyze", str(store), "--output", str(out)]
    seconds: dict[str, list[float]] = {}

    def one(name: str, words: list[str]) -> None:
        seconds.setdefault(name, []).append(run_process([*command, *words]).seconds)

    for _ in range(rounds):
        shutil.rmtree(cache, ignore_errors=True)
        one("with pictures, nothing in the cache", [])
        one("with pictures, all in the cache", [])
        one("with pictures as PNG and PDF, all in the cache", ["--pdf"])
        one("without pictures, all in the cache", ["--no-plots"])
        shutil.rmtree(cache, ignore_errors=True)
        one("without pictures, nothing in the cache", ["--no-plots"])
        shutil.rmtree(cache, ignore_errors=True)
        words = ["--no-plots", "--group", "soup=word:soup", "--group", "v=role:image", "--ratio", "v/soup"]
        one("a group of words, nothing in the cache", words)
        one("a group of words, all in the cache", words)
    rows = [{"what": name, "seconds": measured(values)} for name, values in seconds.items()]
    return Table({"what": "`vla-attention analyze STORE`, fifty episodes", "seconds": "seconds"}, rows)


if __name__ == "__main__":
    main()
