"""How much memory this process may still take: of the machine, its control group, and its SLURM job."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from vla_attention.schemas.control_groups import of_own_group, text_of


@dataclass(frozen=True)
class MemoryLimit:
    """Bytes that something leaves to this process; by: what limits them, for a sentence."""

    bytes: float
    by: str


def memory_left() -> float:
    """Return the bytes of memory that are left, infinite where nothing says."""
    return min((limit.bytes for limit in memory_limits()), default=float("inf"))


def memory_limits(root: Path = Path("/")) -> list[MemoryLimit]:
    """Return every limit that is known here, with what it leaves.

    root: where `proc` and `sys` are.
    """
    return [*_of_machine(root), *_of_control_group(root), *_of_slurm(root)]


def _of_machine(root: Path) -> Iterator[MemoryLimit]:
    available = re.search(r"^MemAvailable:\s+(\d+) kB", text_of(root / "proc/meminfo"), re.MULTILINE)
    if available:
        yield MemoryLimit(1024.0 * int(available[1]), "the machine")


def _of_control_group(root: Path) -> Iterator[MemoryLimit]:
    """Yield what the control group of this process leaves; a container mostly is one.

    Pages of files that were not used for a while count as taken there, but are given back.
    """
    most, taken = (of_own_group(f"memory.{name}", root).strip() for name in ("max", "current"))
    given_back = re.search(r"^inactive_file (\d+)", of_own_group("memory.stat", root), re.MULTILINE)
    if most.isdecimal() and taken.isdecimal():
        left = int(most) - int(taken) + (int(given_back[1]) if given_back else 0)
        yield MemoryLimit(max(0.0, float(left)), "its control group")


def _of_slurm(root: Path) -> Iterator[MemoryLimit]:
    """Yield what the job's request leaves beside this process; a cluster need not enforce it with control groups."""
    resident = re.search(r"^VmRSS:\s+(\d+) kB", text_of(root / "proc/self/status"), re.MULTILINE)
    # Megabytes; 0 is the whole node.
    of_node, of_core, cores = (
        int(value) if value.isdecimal() else 0
        for value in (os.environ.get(f"SLURM_{name}", "") for name in ("MEM_PER_NODE", "MEM_PER_CPU", "CPUS_ON_NODE"))
    )
    megabytes = of_node or of_core * cores
    if megabytes and resident:
        yield MemoryLimit(max(0.0, 1024.0 * (1024 * megabytes - int(resident[1]))), "the SLURM job")
