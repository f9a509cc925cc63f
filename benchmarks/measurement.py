"""What the benchmarks share: turns, medians, and the files of rows that benchmarks/README.md is made from.

A benchmark measures with `take_turns` (functions in this process) or `in_turn` (numbers that the caller measures, such
as those of `run_process`), and writes tables with `write_rows`:

    from measurement import Table, measured, ratios, take_turns, write_rows
    seconds = take_turns({"plain": call, "recorded": recorded_call}, rounds=9, clock=time.process_time)
    rows = [
        {"call": kind, "ms": measured(values, factor=1000), "times": measured(ratios(values, seconds["plain"]))}
        for kind, values in seconds.items()
    ]
    write_rows("capture_overhead", {"small": Table({"call": "call", "ms": "ms", "times": "times plain"}, rows)})

`benchmarks/rows/capture_overhead.json` then holds the table with the command, date, machine and versions, and
`python benchmarks/make_page.py` writes it between the two lines of benchmarks/README.md that name it:

    <!-- table capture_overhead/small -->
    <!-- end of capture_overhead/small -->

Numbers of threads are read when a library is loaded: import this module first and call `fix_threads` before numpy and
torch are imported, or start the command with OMP_NUM_THREADS=1.
"""

from __future__ import annotations

import json
import os
import platform
import shlex
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
#: The folder of the files of rows.
ROWS = ROOT / "benchmarks" / "rows"
#: The variables that say how many threads a numerical library uses.
THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS")
#: The libraries whose versions stand beside a table, where they are installed.
LIBRARIES = ("torch", "numpy", "zarr", "numcodecs", "polars", "tensorstore", "xarray", "dask", "distributed", "mujoco")


@dataclass(frozen=True)
class Measured:
    """A number that was measured several times."""

    median: float
    lowest: float
    highest: float
    times: int


@dataclass(frozen=True)
class Table:
    """Rows of a table; columns: key of a row -> heading. A value is text, a number, None or a `Measured`.

    note: a sentence that stands below the table, for what holds for this run only.
    """

    columns: Mapping[str, str]
    rows: Sequence[Mapping[str, Any]]
    note: str = ""


@dataclass(frozen=True)
class ProcessCost:
    """What a process and those that it waited for took."""

    seconds: float
    processor_seconds: float
    #: The largest resident memory of one of the processes.
    peak_mb: float


def fix_threads(count: int = 1) -> None:
    """Set the number of threads of every library that is imported after this, and of the processes that are started."""
    for name in THREAD_VARIABLES:
        os.environ[name] = str(count)
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(count)


def in_turn(measurers: Mapping[str, Callable[[], float]], rounds: int, warm_up: int = 1) -> dict[str, list[float]]:
    """Return what each measurer gave, one number per round.

    All take their turn within a round, so that they see the same machine; every second round is in the opposite order,
    so that a drift within the rounds favours none. Rounds of the warm-up are not counted.
    """
    found: dict[str, list[float]] = {name: [] for name in measurers}
    for number in range(-warm_up, rounds):
        names = list(measurers) if number % 2 == 0 else list(reversed(measurers))
        for name in names:
            value = measurers[name]()
            if number >= 0:
                found[name].append(value)
    return found


def take_turns(
    calls: Mapping[str, Callable[[], object]],
    rounds: int,
    *,
    repeats: int = 1,
    warm_up: int = 1,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[str, list[float]]:
    """Return the seconds of each call, one number per round: the mean of `repeats` calls.

    clock: `time.process_time` counts the processor's time, which other work on the machine changes little.
    """

    def measurer(call: Callable[[], object]) -> Callable[[], float]:
        def seconds() -> float:
            began = clock()
            for _ in range(repeats):
                call()
            return (clock() - began) / repeats

        return seconds

    return in_turn({name: measurer(call) for name, call in calls.items()}, rounds, warm_up)


def ratios(values: Sequence[float], base: Sequence[float]) -> list[float]:
    """Return the ratio of every round."""
    return [value / reference for value, reference in zip(values, base, strict=True)]


def measured(values: Sequence[float], factor: float = 1.0) -> Measured:
    """Return the median, lowest and highest of the values, times the factor (of a unit)."""
    scaled = [value * factor for value in values]
    return Measured(statistics.median(scaled), min(scaled), max(scaled), len(scaled))


#: Linux counts what a process held before it became the command into the command's peak, and that is the memory of the
#: process that started it. So a small one starts it: 10 MB instead of a benchmark's hundreds.
_START = """
import json, os, sys, time
report = int(sys.argv[1])
os.set_inheritable(report, False)
began = time.perf_counter()
process = os.posix_spawnp(sys.argv[2], sys.argv[2:], os.environ)
_, status, usage = os.wait4(process, 0)
took = [time.perf_counter() - began, usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024]
os.write(report, json.dumps([os.waitstatus_to_exitcode(status), *took]).encode())
"""


def run_process(command: Sequence[str], **options: Any) -> ProcessCost:
    """Run a command to its end and return what it took; options are those of `subprocess.run`.

    Raises `RuntimeError` with what it wrote when it fails.
    """
    with tempfile.TemporaryFile() as output, tempfile.TemporaryFile() as report:
        start = [sys.executable, "-ISc", _START, str(report.fileno()), *command]
        options = {"stdout": output, "stderr": output, **options}
        subprocess.run(start, check=True, pass_fds=(report.fileno(),), **options)
        report.seek(0)
        code, *took = json.loads(report.read())
        if code:
            output.seek(0)
            raise RuntimeError(f"{shlex.join(command)} ended with {code}:\n{output.read().decode()}")
    return ProcessCost(*took)


def machine() -> dict[str, Any]:
    """Return what a reader needs to know about the machine: processor, cores, memory, GPU, threads and load."""
    facts: dict[str, Any] = {
        "processor": _processor(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "memory_gb": round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30, 1),
        "system": f"{platform.system()} {platform.machine()}",
        "threads": {name: os.environ[name] for name in THREAD_VARIABLES if name in os.environ},
        "load": round(os.getloadavg()[0], 2),
    }
    torch = sys.modules.get("torch")
    if torch is not None:
        facts["threads"]["torch"] = torch.get_num_threads()
        if torch.cuda.is_available():
            facts["gpu"] = torch.cuda.get_device_name()
    return facts


def versions() -> dict[str, str]:
    """Return the versions of Python and of the libraries that are installed."""
    found = {"python": platform.python_version()}
    for name in LIBRARIES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def shown_command() -> str:
    """Return the command line of this process as a reader would type it at the top of the checkout."""
    script = Path(sys.argv[0]).resolve()
    name = str(script.relative_to(ROOT)) if script.is_relative_to(ROOT) else script.name
    threads = os.environ.get("OMP_NUM_THREADS")
    return (f"OMP_NUM_THREADS={threads} " if threads else "") + shlex.join(["python", name, *sys.argv[1:]])


def peak_memory() -> float:
    """Return the largest resident memory of this process so far, in bytes; getrusage would count the parent's too."""
    (line,) = [line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM:")]
    return 1024.0 * int(line.split()[1])


def write_rows(name: str, tables: Mapping[str, Table], *, command: str | None = None, folder: Path = ROWS) -> Path:
    """Write tables into NAME.json and return its path; other tables that the file holds stay as they are.

    command: the command line that made them; by default the one of this process.
    """
    path = folder / f"{name}.json"
    kept = read_rows(path) if path.exists() else {}
    for table, content in tables.items():
        kept[table] = {
            "command": shown_command() if command is None else command,
            "date": datetime.now(UTC).date().isoformat(),
            "machine": machine(),
            "versions": versions(),
            "note": content.note,
            "columns": dict(content.columns),
            "rows": [{key: _plain(value) for key, value in row.items()} for row in content.rows],
        }
    folder.mkdir(parents=True, exist_ok=True)
    text = json.dumps({"tables": kept}, indent=1, ensure_ascii=False, allow_nan=False)
    partial = path.with_suffix(".partial")
    partial.write_text(text + "\n", encoding="utf-8")
    os.replace(partial, path)
    return path


def read_rows(path: Path) -> dict[str, Any]:
    """Return the tables of a file of rows."""
    tables: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))["tables"]
    return tables


def _plain(value: Any) -> Any:
    return asdict(value) if isinstance(value, Measured) else value


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor()
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.machine())
