"""The machine that a run has: memory, torch with its device, and what an episode's provenance says of it."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.threads import of_own_group, text_of

if TYPE_CHECKING:
    import torch

import platform
import subprocess
from importlib import metadata


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


def load_torch(name: str, threads: int) -> str:
    """Load torch with a number of threads; return the device of `--device`, which exists (`auto`: a GPU if there is
    one).

    Call `schemas.threads.use_threads` before: how threads wait is read from the environment when torch is loaded.
    """
    import torch

    torch.set_num_threads(threads)  # from OMP_NUM_THREADS alone, MKL takes at most what it finds right
    if name == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    try:
        device = torch.device(name)
    except RuntimeError:
        raise BadArgument(f"Cannot use --device '{name}'; expected auto, cpu, cuda or cuda:N.") from None
    if device.type == "cuda" and (not torch.cuda.is_available() or (device.index or 0) >= torch.cuda.device_count()):
        count = torch.cuda.device_count() if torch.cuda.is_available() else 0
        raise BadArgument(f"Cannot use --device '{name}': this machine has {count} CUDA devices; use cpu.")
    if device.type not in ("cpu", "cuda"):
        raise BadArgument(f"Cannot use --device '{name}'; expected auto, cpu, cuda or cuda:N.")
    return name


def memory_left_on(device: torch.device) -> float:
    """Return the bytes that are left on a device: of a GPU what is free or kept by torch, else of the processor's."""
    import torch

    if device.type != "cuda":
        return memory_left()
    kept_free = torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
    return float(torch.cuda.mem_get_info(device)[0] + kept_free)


#: Packages whose versions can change numbers or pictures.
_LIBRARIES = ("torch", "numpy", "mujoco", "robosuite", "hf-libero", "zarr", "numcodecs", "sentencepiece")

#: The fact that says of how many policy calls a batch had at most, where that was more than one.
POLICY_BATCH = "policy_batch"


def describe_machine(device: str) -> dict[str, str]:
    """Return versions of code and libraries, processor, GPU and threads; nothing that identifies a person or a host."""
    import torch

    facts = {"code": code_version(), "python": platform.python_version(), "processor": platform.machine()}
    facts |= _library_versions()
    facts["device"] = torch.cuda.get_device_name(device) if device.startswith("cuda") else device
    # Sums over other numbers of threads may differ in their last bits.
    facts["threads"] = str(torch.get_num_threads())
    return facts


@cache
def _library_versions() -> dict[str, str]:
    facts = {}
    for name in _LIBRARIES:
        try:
            facts[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            facts[name] = "absent"
    return facts


@cache
def code_version() -> str:
    """Return the installed version, with the commit if the code runs from a git checkout; asked once a process."""
    version = metadata.version("vla-attention")
    folder = Path(__file__).resolve().parents[1]
    if not (folder / ".git").exists():
        return version
    try:
        described = subprocess.run(
            ["git", "describe", "--always", "--dirty"],  # noqa: S607 - wherever the machine has it
            cwd=folder,
            capture_output=True,
            text=True,
            timeout=10,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return version
    return f"{version} ({described.stdout.strip()})"
