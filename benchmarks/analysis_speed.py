"""Time and memory of an analysis of fifty episodes on a laptop, beside plain zarr-python and xarray with dask.

Usage: python benchmarks/analysis_speed.py [--store PATH] [--episodes 50] [--replans 52] [--only NAME ...]

Writes a store of the shape of pi0.5 in LIBERO with the real writer, unless it exists: ten tasks, 18 layers, 8 heads,
first and last denoise step, 978 keys, rows averaged over the queries, made-up rows with sinks and heavy tails. Each
measurement is a process of its own; its wall time from start to end and its peak resident memory are printed. Nothing
is asserted. The comparison with xarray needs dask (`pip install dask`).
"""

from __future__ import annotations

import argparse
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from importlib.util import find_spec
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))

PYTHON_LOOP = """
import sys, numpy as np, zarr
from pathlib import Path
weights = np.load(sys.argv[2])
out = []
for episode in sorted(Path(sys.argv[1], "episodes").glob("task*")):
    rows = zarr.open_array(episode / "joint/rows", mode="r")
    for layer in range(rows.shape[1]):
        for denoise in range(rows.shape[2]):
            out.append(rows[:, layer, denoise].mean(axis=(1, 2)) @ weights)
print(np.concatenate(out).shape)
"""
XARRAY_DASK = """
import sys, numpy as np, xarray as xr
from pathlib import Path
weights = xr.DataArray(np.load(sys.argv[2]), dims=("key", "group"))
out = []
for episode in sorted(Path(sys.argv[1], "episodes").glob("task*")):
    data = xr.open_zarr(episode / "joint", consolidated=False, zarr_format=3, chunks={})
    out.append(data["rows"].mean(("head", "query")).dot(weights, dim="key").compute())
print(sum(part.size for part in out))
"""


def make_store(path: Path, episodes: int, replans: int) -> None:
    """Write the store; fifty episodes take a minute or two."""
    from vla_attention.testing.stores import StoreSpec, write_store
    from vla_attention.testing.tokens import libero_tokens

    spec = StoreSpec(
        suite="libero_10",
        tasks=tuple(range(10)),
        episodes=episodes // 10,
        layers=tuple(range(18)),
        num_layers=18,
        heads=tuple(range(8)),
        frames=False,
        contributions=True,
        num_action_queries=10,
        tokens=libero_tokens(replans),
    )
    began = time.perf_counter()
    write_store(path, spec=spec)
    print(f"wrote {path} in {time.perf_counter() - began:.0f} s")


def measured(command: list[str]) -> tuple[float, float]:
    """Wall seconds and peak resident megabytes of a process."""
    began = time.perf_counter()
    # What is measured is an analysis without the cache of an earlier one.
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, cwd=ROOT, env={**os.environ, "VLA_CACHE": "off"})
    _, status, usage = os.wait4(process.pid, 0)
    if status:
        raise SystemExit(f"failed: {' '.join(command)}")
    return time.perf_counter() - began, usage.ru_maxrss / 1024


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--store", type=Path, help="written if it does not exist (default: a temporary one)")
    parser.add_argument("--episodes", type=int, default=50)
    parser.add_argument("--replans", type=int, default=52)
    parser.add_argument("--only", nargs="+", metavar="NAME", help="measure only these")
    parser.add_argument("--repeats", type=int, default=3, help="runs of each; the fastest is printed (default: 3)")
    arguments = parser.parse_args()
    scratch = Path(tempfile.mkdtemp(prefix="analysis_speed_"))
    store = arguments.store or scratch / "fifty.zarr"
    if not store.exists():
        # In a process of its own: a child's peak memory counts from what its parent holds when it starts it.
        subprocess.run(
            [sys.executable, __file__, "--make", str(store), str(arguments.episodes), str(arguments.replans)],
            check=True,
        )
    size = sum(file.stat().st_size for file in store.rglob("*") if file.is_file())
    print(f"{store}: {size / 1e9:.2f} GB in {sum(1 for _ in store.rglob('*'))} files; {os.cpu_count()} cores")
    weights = np.random.default_rng(0).random((978, 4)).astype(np.float32)
    np.save(scratch / "weights.npy", weights)
    ours = [sys.executable, "-m", "vla_attention.analyze"]
    rest = [str(store), "--output", str(scratch / "out")]
    cases = {
        "default": [*ours, *rest],
        "default-no-plots": [*ours, *rest, "--no-plots"],
        "span": [*ours, *rest, "--no-plots", "--grouping", "cameras"],
        "span-tables": ["env", "OPENBLAS_NUM_THREADS=1", sys.executable, __file__, "--span-tables", str(store)],
        "words": [
            *ours,
            *rest,
            "--no-plots",
            "--group",
            "soup=word:soup",
            "--group",
            "v=role:image",
            "--ratio",
            "v/soup",
        ],
        "objects": [*ours, *rest, "--no-plots", "--grouping", "objects"],
        "plain-zarr": [sys.executable, "-c", PYTHON_LOOP, str(store), str(scratch / "weights.npy")],
        "xarray-dask": [sys.executable, "-c", XARRAY_DASK, str(store), str(scratch / "weights.npy")],
    }
    unknown = set(arguments.only or []) - set(cases)
    if unknown:
        raise SystemExit(f"unknown: {', '.join(sorted(unknown))}; existing: {', '.join(cases)}")
    print(f"{'what':<20}{'seconds':>10}{'peak MB':>10}")
    for name, command in cases.items():
        if name == "xarray-dask" and find_spec("dask") is None:
            print(f"{name:<20} not measured: dask is not installed")
            continue
        if arguments.only is None or name in arguments.only:
            runs = [measured(command) for _ in range(arguments.repeats)]
            print(f"{name:<20}{min(run[0] for run in runs):>10.2f}{max(run[1] for run in runs):>10.0f}", flush=True)
    shutil.rmtree(scratch)


def span_tables(store: Path) -> None:
    """Time all tables with intervals of a grouping of spans in this process: of a new store, then of an open one.

    One BLAS thread, as in `vla-analyze`, which measures episodes in threads of its own.
    """
    from vla_attention.analyze.measures.question import ask
    from vla_attention.analyze.measures.question_settings import AnalysisSettings
    from vla_attention.analyze.ratios.analysis import analyse
    from vla_attention.schemas.stores.reader import open_store

    began = time.perf_counter()
    opened = [open_store(store)]
    analyse(ask(opened, AnalysisSettings(grouping="cameras")))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"first: {time.perf_counter() - began:.2f} s, {peak:.0f} MB", file=sys.stderr)
    began = time.perf_counter()
    analyse(ask(opened, AnalysisSettings(grouping="instruction")))
    print(f"second: {time.perf_counter() - began:.2f} s", file=sys.stderr)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--make"]:
        make_store(Path(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4]))
        raise SystemExit
    if sys.argv[1:2] == ["--span-tables"]:
        span_tables(Path(sys.argv[2]))
    else:
        main()
