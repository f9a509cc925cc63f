"""Stores of thousands of episodes: how long listing takes, what it holds in memory, and what one episode costs.

Usage: OMP_NUM_THREADS=1 python benchmarks/scale.py [--folder FOLDER] [--episodes 500 2000] [--rounds 3]

The episodes are small (39 keys) and whole: arrays, attributes and seals are those that a capture writes. One is written
by the product's writer for each task, and copied with another number in its attributes and a seal of its own. The
commands run in processes of their own; their time is with Python's start and the imports.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
import tempfile
from pathlib import Path

from measurement import Measured, ProcessCost, Table, fix_threads, measured, run_process, write_rows

fix_threads(1)

TASKS = 10


def make_store(path: Path, episodes: int) -> Path:
    """A store with so many episodes of ten tasks, unless it is there."""
    from vla_attention.schemas.stores.root import episode_folders
    from vla_attention.schemas.stores.store_format import episode_name
    from vla_attention.testing import reseal, write_store

    if path.exists() and len(episode_folders(path)) == episodes:
        return path
    write_store(path, mode="overwrite", tasks=tuple(range(TASKS)), episodes=1, contributions=True)
    for task in range(TASKS):
        first = path / "episodes" / episode_name(task, 0)
        for number in range(1, episodes // TASKS):
            folder = path / "episodes" / episode_name(task, number)
            # The chunks are the same bytes; only what names the episode is written anew.
            shutil.copytree(first, folder, copy_function=os.link)
            document = json.loads((first / "zarr.json").read_bytes())
            document["attributes"] |= {"episode_index": number, "initial_state_index": number}
            (folder / "zarr.json").unlink()
            (folder / "zarr.json").write_text(json.dumps(document), encoding="utf-8")
            reseal(folder)
    return path


#: What is listed, by its name in the table; {} is the store.
LISTINGS = {
    "`vla-analyze STORE --list`": "vla_attention.analyze {} --list",
    "`vla-capture status STORE`": "vla_attention.capture status {}",
}
_OPEN = "import sys, vla_attention as va; print(va.open(sys.argv[1]).episodes.height)"


def command_of(listing: str, store: Path) -> list[str]:
    """The command line of a listing."""
    return [sys.executable, "-m", *(word.format(store) for word in LISTINGS[listing].split())]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, help="where stores are made, and kept (default: a temporary one)")
    parser.add_argument("--episodes", type=int, nargs="+", default=[500, 2000])
    parser.add_argument("--rounds", type=int, default=3)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = arguments.folder or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        stores = {count: make_store(folder / f"of_{count}.zarr", count) for count in arguments.episodes}
        rows = listing_rows(stores, arguments.rounds)
    write_rows("scale", {"listing": rows})


def listing_rows(stores: dict[int, Path], rounds: int) -> Table:
    commands = {(name, count): command_of(name, store) for name in LISTINGS for count, store in stores.items()}
    for count, store in stores.items():
        commands["`va.open(STORE).episodes`", count] = [sys.executable, "-c", _OPEN, str(store)]
    costs: dict[tuple[str, int], list[ProcessCost]] = {key: [] for key in commands}
    for number in range(rounds + 1):
        for key, command in commands.items():
            cost = run_process(command)
            if number:  # the first round warms the caches of the system
                costs[key].append(cost)
    rows = []
    for (name, count), found in costs.items():
        seconds, processor = (
            measured([cost.seconds for cost in found]),
            measured([cost.processor_seconds for cost in found]),
        )
        peak: Measured = measured([cost.peak_mb for cost in found])
        rows.append({"what": name, "episodes": count, "seconds": seconds, "processor": processor, "peak": peak})
        print(name, count, seconds, processor, peak, flush=True)
    columns = {
        "what": "listed by",
        "episodes": "episodes",
        "seconds": "seconds",
        "processor": "processor seconds",
        "peak": "peak memory, MB",
    }
    return Table(columns, rows)


if __name__ == "__main__":
    main()
