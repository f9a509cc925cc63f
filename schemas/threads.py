"""How many threads this process computes with, and that threads without work sleep.

torch takes a thread per processor that it sees, and an OpenMP thread that waits for the others keeps its core busy:
where other work has the cores, or several workers share a node, a policy call takes ten times as long or more
(benchmarks/threads.py). Here one number is chosen, and waiting threads sleep. OpenMP, MKL, OpenBLAS, polars and Mesa
read their environment variables once, when they are loaded, so `use_threads` comes before them.

Order of precedence: `--threads`, OMP_NUM_THREADS, then the smallest of the cores that this process may run on, the
CPU quota of its control group, and what SLURM gave to the task.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from vla_attention.schemas.errors import BadArgument

if TYPE_CHECKING:
    import argparse

_OPENMP = "OMP_NUM_THREADS"
_SLURM = "SLURM_CPUS_PER_TASK"
#: Set to the same number, unless the user has set them. LP_: Mesa's renderer, which draws on nodes without a GPU.
OTHER_LIBRARIES = ("MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "POLARS_MAX_THREADS", "LP_NUM_THREADS")
#: Let threads that wait sleep: the standard's variable, and those of the GNU (torch's own) and the Intel runtime.
_SLEEP = {"OMP_WAIT_POLICY": "PASSIVE", "GOMP_SPINCOUNT": "0", "KMP_BLOCKTIME": "0"}


@dataclass(frozen=True)
class Threads:
    """A number of threads, and what it was taken from."""

    number: int
    source: str

    def describe(self) -> str:
        """Return a line for the terminal."""
        how = "" if self.source == "--threads" else "; --threads N changes it"
        return f"Threads: {self.number} ({self.source}{how})."


def add_threads(parser: argparse._ActionsContainer, threads: str) -> None:
    """Add `--threads`, whose value `use_threads` takes. `threads`: whose they are, and how many without it."""
    parser.add_argument("--threads", type=int, metavar="N", help=threads)


def choose_threads(given: int | None, environment: Mapping[str, str], cores: int, quota: float | None) -> Threads:
    """Choose the number of threads.

    Args:
        given: the value of `--threads`; None without one.
        environment: environment variables.
        cores: number of cores that the process may run on.
        quota: processor seconds per second that its control group allows; None without a limit.

    Raises:
        BadArgument: `given` or OMP_NUM_THREADS is no number of threads.
    """
    if given is not None:
        if given < 1:
            raise BadArgument(f"Cannot use --threads {given}; expected at least 1.")
        return Threads(given, "--threads")
    by_user = environment.get(_OPENMP, "").strip()
    if by_user:
        first = by_user.split(",")[0].strip()  # the others are for nested parallel regions
        if not first.isdecimal() or int(first) < 1:
            raise BadArgument(f"{_OPENMP} is '{by_user}'; expected a number of threads, at least 1, or unset it.")
        return Threads(int(first), _OPENMP)
    limits = [Threads(cores, "the cores that this process may use")]
    if quota is not None:
        limits.append(Threads(max(1, int(quota)), "the CPU quota of its control group"))
    of_task = environment.get(_SLURM, "")
    if of_task.isdecimal() and int(of_task):
        limits.append(Threads(int(of_task), _SLURM))
    return min(limits, key=lambda limit: limit.number)


def use_threads(given: int | None = None) -> Threads:
    """Choose the number of threads of this process, and set the variables from which libraries take it.

    Call it before torch, numpy and polars are imported. Processes that this one starts inherit the number.

    Raises:
        BadArgument: as `choose_threads`.
    """
    threads = threads_of_this_process(given)
    number = str(threads.number)
    os.environ[_OPENMP] = number
    for name in OTHER_LIBRARIES:
        if given is not None or name not in os.environ:
            os.environ[name] = number
    if not any(name in os.environ for name in _SLEEP):
        os.environ.update(_SLEEP)
    return threads


def threads_of_this_process(given: int | None = None) -> Threads:
    """Return the number that `use_threads` would set; after it, the number that it has set."""
    return choose_threads(given, os.environ, _cores(), cpu_quota())


def available_cores() -> int:
    """Return the number of cores that this process may use, whatever OMP_NUM_THREADS says."""
    environment = {name: value for name, value in os.environ.items() if name != _OPENMP}
    return choose_threads(None, environment, _cores(), cpu_quota()).number


def _cores() -> int:
    """Return the number of physical cores that this process may run on: two processors of one core are no faster."""
    try:
        processors = os.sched_getaffinity(0)
    except AttributeError:  # macOS and Windows bind no process to processors
        return os.cpu_count() or 1
    topology = "/sys/devices/system/cpu/cpu{}/topology/thread_siblings_list"
    return len({text_of(Path(topology.format(number))) or str(number) for number in processors})


def cpu_quota(root: Path = Path("/")) -> float | None:
    """Return the processor seconds per second that the control group allows this process; None without a limit.

    Args:
        root: folder in place of /, for tests.
    """
    words = of_own_group("cpu.max", root).split()
    # `max` stands for no limit.
    if len(words) != 2 or not all(word.isdecimal() for word in words) or int(words[1]) == 0:
        return None
    return int(words[0]) / int(words[1])


def of_own_group(name: str, root: Path = Path("/")) -> str:
    """Return the text of a file of this process's control group (version 2), such as `cpu.max`; empty without one.

    root: folder in place of /, for tests.
    """
    own = re.search(r"^0::/(.*)$", text_of(root / "proc/self/cgroup"), re.MULTILINE)
    if own is None:
        return ""
    mount = root / "sys/fs/cgroup"
    # A container may see the path of its group on the host, and the group itself in the place of the whole tree.
    return text_of(mount / own[1] / name) or text_of(mount / name)


def text_of(path: Path) -> str:
    """Return the text of a file of the kernel; empty where there is none, or it is not for us."""
    try:
        return path.read_text(encoding="utf-8")
    except OSError:
        return ""
