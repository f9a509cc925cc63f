"""Time, bytes and memory of an analysis, beside only decoding the same chunks, zarr-python, and xarray with dask.

Usage: OMP_NUM_THREADS=2 python benchmarks/analysis_speed.py [--store PATH] [--episodes 50] [--parts scan ...]

Writes a store of the shape of pi0.5 in LIBERO with the real writer, unless it exists: ten tasks, 18 layers, 8 heads,
first and last denoise step, 978 keys, rows averaged over the queries, made-up rows with sinks and heavy tails. What it
measures goes to benchmarks/rows/analysis_speed.json; nothing is asserted. The parts:

    scan       in one process, in turn, with OMP_NUM_THREADS threads: decoding every chunk of the rows (read, crc32c,
               Blosc) and nothing else; masses of words; the whole question from opening the store to tables with
               intervals; the same masses by a loop with zarr-python, and by xarray with dask (`pip install dask`)
    bytes      what the process reads for all layers and for three of eighteen, as Linux counts it
    processes  whole `vla-attention analyze` processes without the cache: wall seconds and peak memory
    memory     peak memory of whole processes by number of episodes (--sizes 50 500, each a multiple of the first),
               of which the further ones are the first again and again (repeated_store.py)
    masses     the same of processes that compute masses and nothing else
"""

from __future__ import annotations

import argparse
import math
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from measurement import ROOT, Table, in_turn, measured, ratios, run_process, write_rows
from repeated_store import repeat_store

sys.path.insert(0, str(ROOT))

import numpy as np

from vla_attention.analyze.core.levels import levels_of
from vla_attention.analyze.measures.question import ask
from vla_attention.analyze.measures.question_settings import AnalysisSettings
from vla_attention.schemas.stores.reader import StoredEpisode, open_store

WORDS = ("--group", "soup=word:soup", "--group", "v=role:image", "--ratio", "v/soup")
SETTINGS = AnalysisSettings(groups=("soup=word:soup", "v=role:image"), ratio="v/soup")
#: The command of each row of the part `processes`, after `vla-attention analyze STORE`.
COMMANDS = {
    "default: tables, results file, pictures": (),
    "default, --no-plots": ("--no-plots",),
    "spans (--grouping cameras --no-plots)": ("--grouping", "cameras", "--no-plots"),
    "words (--group soup=word:soup ... --no-plots)": (*WORDS, "--no-plots"),
    "objects (--grouping objects --no-plots)": ("--grouping", "objects", "--no-plots"),
}
#: Those of the part `memory`: the command, the arguments after the store.
MEMORY_COMMANDS = {
    **{kind: ((), given) for kind, given in COMMANDS.items() if given},
    "words STORE": (("words",), ("--no-plots",)),
    "objects STORE": (("objects",), ("--no-plots",)),
}


def make_store(path: Path, episodes: int, replans: int, heads: int) -> None:
    """Write the store; fifty episodes of eight heads take a minute or two."""
    from tests.kit.stores import StoreSpec, write_store
    from tests.kit.tokens import libero_tokens

    spec = StoreSpec(
        suite="libero_10",
        tasks=tuple(range(10)),
        episodes=episodes // 10,
        layers=tuple(range(18)),
        num_layers=18,
        heads=tuple(range(heads)),
        frames=False,
        contributions=True,
        num_action_queries=10,
        tokens=libero_tokens(replans),
    )
    write_store(path, spec=spec)


def made(path: Path, episodes: int, replans: int, heads: int = 8) -> Path:
    """The store, written by a process of its own: a child's peak memory counts from what its parent holds."""
    if not path.exists():
        numbers = [str(number) for number in (episodes, replans, heads)]
        subprocess.run([sys.executable, __file__, "--make", str(path), *numbers], check=True)
    return path


def decode_only(store: Path, threads: int) -> Callable[[], None]:
    """Read and decode every chunk of the rows, into memory that is used again; the positions are read beforehand."""
    from vla_attention.schemas.stores.digest import crc32c

    def positions(episode: StoredEpisode) -> tuple[Path, list[tuple[int, int]], int]:
        about = episode.array("joint/rows").metadata
        path = episode.folder / "joint/rows" / about.file
        index = np.frombuffer(path.read_bytes()[-16 * about.shard_chunks - 4 : -4], "<u8").reshape(-1, 2)
        return path, [(at, size - 4) for at, size in index.tolist()], math.prod(about.chunk_shape)

    def decode(of_episode: tuple[Path, list[tuple[int, int]], int]) -> None:
        from numcodecs import blosc

        path, places, numbers = of_episode
        memory = np.empty(numbers, np.float32)
        with path.open("rb", buffering=0) as file:
            for at, size in places:
                frame = os.pread(file.fileno(), size, at)
                crc32c(frame)
                blosc.decompress(frame, memory)

    known = [positions(episode) for episode in open_store(store).episodes]

    def run() -> None:
        with ThreadPoolExecutor(threads) as executor:
            list(executor.map(decode, known))

    return run


def scan_of(store: Path) -> Callable[[], None]:
    """Masses of a grouping of words, from a store whose tokens are known."""
    question = ask([open_store(store)], SETTINGS)
    return lambda: (levels_of(question), None)[1]


def whole_question(store: Path) -> None:
    """From opening the store to all tables with intervals."""
    from vla_attention.analyze.commands.analyze import analyze

    analyze(ask([open_store(store)], SETTINGS))


def zarr_loop(store: Path, weights: np.ndarray[Any, Any]) -> None:
    """Masses of as many groups, a layer and denoise step at a time."""
    import zarr

    for episode in sorted(Path(store, "episodes").glob("task*")):
        rows: Any = zarr.open_array(episode / "joint/rows", mode="r")
        for layer in range(rows.shape[1]):
            for denoise in range(rows.shape[2]):
                rows[:, layer, denoise].mean(axis=(1, 2)) @ weights


def xarray_dask(store: Path, weights: np.ndarray[Any, Any], threads: int) -> None:
    """The same with chunks as dask's tasks."""
    import dask
    import xarray

    named = xarray.DataArray(weights, dims=("key", "group"))
    with dask.config.set(scheduler="threads", num_workers=threads):
        for episode in sorted(Path(store, "episodes").glob("task*")):
            data = xarray.open_zarr(episode / "joint", consolidated=False, zarr_format=3, chunks={})
            data["rows"].mean(("head", "query")).dot(named, dim="key").compute()


def measure_scan(store: Path, rounds: int, threads: int) -> Table:
    """The part `scan`."""
    weights = np.random.default_rng(0).random((978, 3)).astype(np.float32)
    decode, scan = "decoding alone", "masses of words (scan)"
    calls: dict[str, Callable[[], object]] = {
        decode: decode_only(store, threads),
        scan: scan_of(store),
        "the whole question: open, resolve, scan, tables with intervals": lambda: whole_question(store),
        "a loop with zarr-python: masses alone": lambda: zarr_loop(store, weights),
    }
    if find_spec("dask") is not None:
        calls["xarray and dask: masses alone"] = lambda: xarray_dask(store, weights, threads)
    wall: dict[str, list[float]] = {name: [] for name in calls}

    def measurer(name: str) -> float:
        began, began_processor = time.perf_counter(), time.process_time()
        calls[name]()
        wall[name].append(time.perf_counter() - began)
        return time.process_time() - began_processor

    processor = in_turn({name: partial(measurer, name) for name in calls}, rounds)
    # The first of each is the warm-up's.
    wall = {name: values[1:] for name, values in wall.items()}
    rows = [
        {
            "what": name,
            "seconds": measured(wall[name]),
            "times": measured(ratios(wall[name], wall[decode])),
            "processor": measured(processor[name]),
            "processor_times": measured(ratios(processor[name], processor[decode])),
            "of_scan": measured(ratios(wall[name], wall[scan])),
        }
        for name in calls
    ]
    columns = {
        "what": "what",
        "seconds": "seconds",
        "times": "times decoding",
        "processor": "processor's seconds",
        "processor_times": "times decoding's",
        "of_scan": "seconds, times the scan",
    }
    count = len(open_store(store).episodes)
    return Table(columns, rows, f"{count} episodes, {threads} threads; ratios are of the same round.")


def measure_bytes(store: Path) -> Table:
    """The part `bytes`."""

    def bytes_read(layers: tuple[int, ...] | None) -> int:
        def so_far() -> int:
            found = re.search(r"rchar: (\d+)", Path("/proc/self/io").read_text())
            assert found is not None
            return int(found[1])

        before = so_far()
        settings = AnalysisSettings(groups=SETTINGS.groups, ratio=SETTINGS.ratio, layers=layers)
        levels_of(ask([open_store(store)], settings))
        return so_far() - before

    bytes_read((0,))  # modules that are imported on first use
    every, three = bytes_read(None), bytes_read((3, 4, 17))
    rows = [
        {"what": "all 18 layers", "megabytes": every / 1e6, "part": 1.0},
        {"what": "three layers", "megabytes": three / 1e6, "part": three / every},
    ]
    return Table({"what": "masses of words", "megabytes": "MB read", "part": "part"}, rows)


def measure_processes(
    stores: Sequence[Path], rounds: int, commands: Mapping[str, tuple[Sequence[str], Sequence[str]]]
) -> Table:
    """The parts `processes` and `memory`."""
    rows = []
    for kind, (before, after) in commands.items():
        row: dict[str, Any] = {"what": kind}
        for store in stores:
            with tempfile.TemporaryDirectory() as output:
                given = [*before, str(store), *after, "--output", output]
                command = [sys.executable, "-m", "vla_attention.analyze", *given]
                costs = [run_process(command, cwd=ROOT) for _ in range(rounds)]
            of = f" of {store.stem}" if len(stores) > 1 else ""
            row |= {f"seconds{of}": measured([cost.seconds for cost in costs])}
            row |= {f"peak{of}": max(cost.peak_mb for cost in costs)}
        rows.append(row)
    columns = {"what": "vla-attention analyze STORE ..."}
    for name in rows[0]:
        if name != "what":
            columns[name] = name.replace("peak", "peak MB").replace(" of ", ", ")
    return Table(columns, rows)


def measure_masses(stores: Sequence[Path]) -> Table:
    """The part `masses`."""
    rows: list[dict[str, Any]] = []
    for kind in ("words", "objects"):
        row: dict[str, Any] = {"what": f"masses of a grouping of {kind}"}
        for store in stores:
            row[store.stem] = run_process([sys.executable, __file__, "--masses", str(store), kind]).peak_mb
        rows.append(row)
    return Table({name: name if name == "what" else f"peak MB, {name}" for name in rows[0]}, rows)


def only_masses(store: Path, kind: str) -> None:
    """Compute the masses of all episodes."""
    settings = SETTINGS if kind == "words" else AnalysisSettings(grouping="objects")
    levels_of(ask([open_store(store)], settings))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--store", type=Path, help="written if it does not exist (default: a temporary one)")
    parser.add_argument("--episodes", type=int, default=50)
    parser.add_argument("--replans", type=int, default=52)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--sizes", type=int, nargs="+", default=[50, 500], help="episodes of memory and masses")
    parser.add_argument("--only", default="", metavar="TEXT", help="of memory, the commands whose name has this text")
    parser.add_argument("--parts", nargs="+", default=["scan", "bytes", "processes"])
    arguments = parser.parse_args()
    os.environ["VLA_CACHE"] = "off"  # an analysis that was made before is not measured
    threads = int(os.environ.get("OMP_NUM_THREADS", "2"))
    scratch = Path(tempfile.mkdtemp(prefix="analysis_speed_"))
    tables: dict[str, Table] = {}
    if {"scan", "bytes", "processes"} & set(arguments.parts):
        store = made(arguments.store or scratch / "store.zarr", arguments.episodes, arguments.replans)
        name = f"_{arguments.episodes}"
        if "scan" in arguments.parts:
            tables[f"scan{name}"] = measure_scan(store, arguments.rounds, threads)
        if "bytes" in arguments.parts:
            tables["bytes"] = measure_bytes(store)
        if "processes" in arguments.parts:
            tables["processes"] = measure_processes([store], 3, {kind: ((), given) for kind, given in COMMANDS.items()})
    if {"memory", "masses"} & set(arguments.parts):
        first, *further = arguments.sizes
        stores = [made(scratch / f"{first} episodes.zarr", first, arguments.replans)]
        stores += [repeat_store(stores[0], scratch / f"{count} episodes.zarr", count // first) for count in further]
    if "masses" in arguments.parts:
        tables["masses"] = measure_masses(stores)
    if "memory" in arguments.parts:
        chosen = {kind: given for kind, given in MEMORY_COMMANDS.items() if arguments.only in kind}
        tables["memory"] = measure_processes(stores, 1, chosen)
    shutil.rmtree(scratch)
    # Where the store was kept is of no interest.
    given = ["--episodes", str(arguments.episodes), "--parts", *arguments.parts, "--rounds", str(arguments.rounds)]
    if {"memory", "masses"} & set(arguments.parts):
        given += ["--sizes", *map(str, arguments.sizes)]
    if arguments.only:
        given += ["--only", f"'{arguments.only}'"]
    command = " ".join([f"OMP_NUM_THREADS={threads} python benchmarks/analysis_speed.py", *given])
    print(write_rows("analysis_speed", tables, command=command))
    for table_name, table in tables.items():
        print(table_name, *table.rows, table.note, sep="\n  ")


if __name__ == "__main__":
    if sys.argv[1:2] == ["--make"]:
        make_store(Path(sys.argv[2]), *(int(number) for number in sys.argv[3:]))
    elif sys.argv[1:2] == ["--masses"]:
        only_masses(Path(sys.argv[2]), sys.argv[3])
    else:
        main()
