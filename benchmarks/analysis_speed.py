"""Time, bytes and memory of an analysis, beside only decoding its chunks, other readers, and an earlier form of rows.

Usage: OMP_NUM_THREADS=2 python benchmarks/analysis_speed.py [--store PATH] [--episodes 50] [--parts scan ...]

Writes a store of the shape of pi0.5 in LIBERO with the real writer, unless it exists: ten tasks, 18 layers, 8 heads,
first and last denoise step, 978 keys, rows averaged over the queries, made-up rows with sinks and heavy tails. What it
measures goes to benchmarks/rows/analysis_speed.json; nothing is asserted. The parts:

    scan       in one process, in turn, with OMP_NUM_THREADS threads: decoding every chunk of the rows (read, crc32c,
               Blosc) and nothing else, and a bare loop to the masses of words, both of the rows as they are stored and
               in the form of earlier stores (row_forms.py); the bare loop over the chunks that hold the text alone;
               masses of words as the package computes them; the whole question from opening the store to tables with
               intervals; masses of as many groups by a loop with zarr-python, by one with tensorstore, and by xarray
               with dask (the last two where they are installed). Ratios are to the bare loop over the earlier form
    chunks     what chunks of keys change in the layouts of several policies: bytes, reads and time for all keys and for
               those of the text, beside one chunk for all keys; made-up rows
    bits       bytes and time of a number by mantissa bits
    bytes      what the process reads for all layers and for three of eighteen, as Linux counts it
    processes  whole `vla-attention analyze` processes without the cache: wall seconds and peak memory
    memory     peak memory of whole processes by number of episodes (--sizes 50 500, each a multiple of the first),
               of which the further ones are the first again and again (repeated_store.py)
    masses     the same of processes that compute masses and nothing else
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any, TypeVar

from measurement import ROOT, ROWS, Table, in_turn, measured, ratios, run_process, write_rows
from repeated_store import repeat_store

sys.path.insert(0, str(ROOT))

import numpy as np
from row_forms import ChunkFile, Wanted, measure_bits, measure_chunks, old_chunks, stored_chunks, stored_layers

from vla_attention.analyze.core.levels import items_of, levels_of
from vla_attention.analyze.measures.question import ask
from vla_attention.analyze.measures.question_settings import AnalysisSettings
from vla_attention.analyze.stores.parallel import one_blas_thread
from vla_attention.schemas.stores.reader import open_store

Item = TypeVar("Item")
#: The row of the part `scan` that the others are compared with.
OLD_SCAN = "old form: scan of masses with checksums and row sums"
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


def of_episodes(function: Callable[[Item], object], items: Iterable[Item], threads: int) -> None:
    """Call a function with each, in so many threads; results are let go."""
    with one_blas_thread(), ThreadPoolExecutor(threads) as executor:
        for _ in executor.map(function, items):
            pass


def decode(file: ChunkFile) -> None:
    """Read and decode every chunk, into memory that is used again; where they are is known."""
    for _ in file.chunks():
        pass


@dataclass(frozen=True)
class BareLoops:
    """The least that the masses of a question take: groups are resolved and places of chunks read beforehand.

    Attributes:
        old, stored: the chunks of each episode, in the form of earlier stores and as they are.
        calls: of the rows of `measure_scan`: bare loops over both, and over the chunks that hold the text.
    """

    old: list[ChunkFile]
    stored: list[ChunkFile]
    calls: Mapping[str, Callable[[], None]]

    @classmethod
    def of(cls, store: Path, scratch: Path, threads: int) -> BareLoops:
        """Write the earlier form of a store's rows into an empty folder, and read what the loops need."""
        question = ask([open_store(store)], SETTINGS)
        arrays, wanted = [], []
        for item in question.selected:
            row_sum = item.episode.row_sum("joint").mean(axis=(-2, -1))  # (replan, layer, denoise)
            weights = items_of(item, question.grouping).with_totals(item)
            wanted.append(Wanted(weights, row_sum.reshape(len(row_sum), -1).T))
            arrays.append(item.episode.array("joint/rows"))
        text = question.selected[0].tokens.layout.span("prompt")
        keys = arrays[0].metadata.whole_chunks(text.start, text.stop)
        of_text = [one.of_keys(keys) for one in wanted]
        old = [old_chunks(item.episode, scratch / f"{i}.old") for i, item in enumerate(question.selected)]
        stored = [stored_chunks(item.episode) for item in question.selected]
        every = range(len(arrays))
        loops: dict[str, Callable[[int], object]] = {
            OLD_SCAN: lambda i: wanted[i].masses(old[i].chunks()),
            "the same loop over the rows as they are stored": lambda i: wanted[i].masses(stored_layers(arrays[i])),
            "masses of words from the chunk of the text keys alone, the same loop": lambda i: of_text[i].masses(
                stored_layers(arrays[i], keys)
            ),
        }
        return cls(old, stored, {name: partial(of_episodes, loop, every, threads) for name, loop in loops.items()})


def scan_of(store: Path) -> Callable[[], None]:
    """Masses of a grouping of words, from a store whose tokens are known."""
    question = ask([open_store(store)], SETTINGS)
    return lambda: (levels_of(question), None)[1]


def whole_question(store: Path) -> None:
    """From opening the store to all tables with intervals."""
    from vla_attention.analyze.commands.analyze import analyze

    analyze(ask([open_store(store)], SETTINGS))


def loop_over(open_rows: Callable[[Path], Any], store: Path, weights: np.ndarray[Any, Any]) -> None:
    """Masses of as many groups, a layer and denoise step at a time.

    open_rows: opens the array in a folder, of which (replan, head, query, key) are asked for.
    """
    for episode in sorted(Path(store, "episodes").glob("task*")):
        folder = episode / "joint/rows"
        rows = open_rows(folder)
        attributes = json.loads((folder / "zarr.json").read_bytes()).get("attributes", {})
        scaled = weights * np.float32(attributes.get("scale_factor", 1))
        for layer in range(rows.shape[1]):
            for denoise in range(rows.shape[2]):
                np.asarray(rows[:, layer, denoise]).astype(np.float32).mean(axis=(1, 2)) @ scaled


def zarr_loop(store: Path, weights: np.ndarray[Any, Any]) -> None:
    """The loop with zarr-python."""
    import zarr

    loop_over(lambda folder: zarr.open_array(folder, mode="r"), store, weights)


def tensorstore_loop(store: Path, weights: np.ndarray[Any, Any], threads: int) -> None:
    """The loop with tensorstore, which reads when numpy asks for an array."""
    import tensorstore

    limits = {"data_copy_concurrency": {"limit": threads}, "file_io_concurrency": {"limit": threads}}
    context = tensorstore.Context(limits)

    def open_rows(folder: Path) -> Any:
        place = {"driver": "zarr3", "kvstore": {"driver": "file", "path": f"{folder}/"}}
        return tensorstore.open(place, context=context, open=True, read=True).result()

    loop_over(open_rows, store, weights)


def xarray_dask(store: Path, weights: np.ndarray[Any, Any], threads: int) -> None:
    """The same with chunks as dask's tasks."""
    import dask
    import xarray

    named = xarray.DataArray(weights, dims=("key", "group"))
    with dask.config.set(scheduler="threads", num_workers=threads):
        for episode in sorted(Path(store, "episodes").glob("task*")):
            data = xarray.open_zarr(episode / "joint", consolidated=False, zarr_format=3, chunks={})
            data["rows"].mean(("head", "query")).dot(named, dim="key").compute()


def measure_scan(store: Path, scratch: Path, rounds: int, threads: int) -> Table:
    """The part `scan`."""
    weights = np.random.default_rng(0).random((978, 3)).astype(np.float32)
    bare = BareLoops.of(store, scratch, threads)
    calls: dict[str, Callable[[], object]] = {
        "old form: decoding alone": lambda: of_episodes(decode, bare.old, threads),
        OLD_SCAN: bare.calls[OLD_SCAN],
        "decoding alone": lambda: of_episodes(decode, bare.stored, threads),
        **bare.calls,
        "masses of words (scan)": scan_of(store),
        "the whole question: open, resolve, scan, tables with intervals": lambda: whole_question(store),
        "a loop with zarr-python: masses alone": lambda: zarr_loop(store, weights),
    }
    if find_spec("tensorstore") is not None:
        calls["a loop with tensorstore: masses alone"] = lambda: tensorstore_loop(store, weights, threads)
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
    count = len(bare.stored)
    rows = [
        {
            "what": name,
            "seconds": measured(wall[name]),
            "seconds_times": measured(ratios(wall[name], wall[OLD_SCAN])),
            "processor": measured(processor[name], factor=1000 / count),
            "processor_times": measured(ratios(processor[name], processor[OLD_SCAN])),
        }
        for name in calls
    ]
    columns = {
        "what": "what",
        "seconds": "seconds",
        "seconds_times": "times the old form's scan",
        "processor": "processor's ms an episode",
        "processor_times": "times the old form's scan's",
    }
    sizes = [sum(file.path.stat().st_size for file in files) / count / 1e6 for files in (bare.stored, bare.old)]
    note = (
        f"{count} episodes, {threads} {'thread' if threads == 1 else 'threads'}; ratios are of the same round. Rows of "
        f"an episode take {sizes[0]:.1f} MB, in the old form {sizes[1]:.1f} MB."
    )
    return Table(columns, rows, note)


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
    parser.add_argument("--rows", type=Path, metavar="FOLDER", help="of the file of rows (default: benchmarks/rows)")
    parser.add_argument("--parts", nargs="+", default=["scan", "chunks", "bits", "bytes", "processes"])
    arguments = parser.parse_args()
    os.environ["VLA_CACHE"] = "off"  # an analysis that was made before is not measured
    threads = int(os.environ.get("OMP_NUM_THREADS", "2"))
    scratch = Path(tempfile.mkdtemp(prefix="analysis_speed_"))
    tables: dict[str, Table] = {}
    if {"scan", "bytes", "processes"} & set(arguments.parts):
        store = made(arguments.store or scratch / "store.zarr", arguments.episodes, arguments.replans)
        name = f"_{arguments.episodes}"
        if "scan" in arguments.parts:
            old = Path(tempfile.mkdtemp(dir=scratch))
            tables[f"scan{name}"] = measure_scan(store, old, arguments.rounds, threads)
            shutil.rmtree(old)
        if "bytes" in arguments.parts:
            tables["bytes"] = measure_bytes(store)
        if "processes" in arguments.parts:
            tables["processes"] = measure_processes([store], 3, {kind: ((), given) for kind, given in COMMANDS.items()})
    if "chunks" in arguments.parts:
        tables["chunks"] = measure_chunks(Path(tempfile.mkdtemp(dir=scratch)), arguments.rounds)
    if "bits" in arguments.parts:
        tables["bits"] = measure_bits(Path(tempfile.mkdtemp(dir=scratch)), arguments.rounds)
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
    print(write_rows("analysis_speed", tables, command=command, folder=arguments.rows or ROWS))
    for table_name, table in tables.items():
        print(table_name, *table.rows, table.note, sep="\n  ")


if __name__ == "__main__":
    if sys.argv[1:2] == ["--make"]:
        make_store(Path(sys.argv[2]), *(int(number) for number in sys.argv[3:]))
    elif sys.argv[1:2] == ["--masses"]:
        only_masses(Path(sys.argv[2]), sys.argv[3])
    else:
        main()
