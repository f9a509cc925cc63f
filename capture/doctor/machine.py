"""What the machine has: processor and threads, GPU, precision, memory, drawing without a display, simulators."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

from vla_attention.capture.environments.base import Suite
from vla_attention.capture.environments.drawing import check_drawing
from vla_attention.capture.environments.libero_installation import find_assets, package_folder
from vla_attention.capture.environments.robosuite_installation import DEFAULT_GL, find_robosuite
from vla_attention.capture.environments.suites import list_tasks
from vla_attention.capture.machine.memory import memory_limits
from vla_attention.schemas.command_line import format_bytes
from vla_attention.schemas.errors import UserError
from vla_attention.schemas.threads import Threads

#: `ok`: as it should be. `note`: works, but could be better, or is not needed. `missing`: the run needs it.
Status = Literal["ok", "note", "missing"]
_SHOWN: dict[Status, str] = {"ok": "ok", "note": "note", "missing": "MISSING"}


@dataclass(frozen=True)
class Finding:
    """One line: what was looked at, how it stands, and what to do where something is missing or could be better."""

    what: str
    status: Status
    text: str
    to_do: str = ""

    def describe(self) -> str:
        """Return the line for the terminal."""
        text = f"{self.text} {self.to_do}".strip()
        return f"{_SHOWN[self.status]:<8} {self.what:<11} {text}"


def something_missing(findings: Iterable[Finding]) -> bool:
    """Whether the run cannot be made as it is described."""
    return any(finding.status == "missing" for finding in findings)


#: Instructions with which a processor multiplies bfloat16 itself.
_BFLOAT16_FLAGS = ("amx_bf16", "avx512_bf16", "bf16")


def find_processor(threads: Threads) -> Finding:
    """Return the number of cores and threads."""
    try:
        cores = len(os.sched_getaffinity(0))
    except AttributeError:  # macOS and Windows bind no process to processors
        cores = os.cpu_count() or 1
    text = f"{cores} processors for this process, {threads.number} threads for the policy ({threads.source})."
    if threads.number > cores:
        return Finding(
            "processor", "note", text, f"More threads than processors wait for each other: --threads {cores}."
        )
    return Finding("processor", "ok", text)


def find_memory(root: Path = Path("/")) -> Finding:
    """Return the memory that this process may still take. root: as in `memory_limits`."""
    least = min(memory_limits(root), key=lambda limit: limit.bytes, default=None)
    if least is None:
        return Finding("memory", "note", "This system does not say how much is available.")
    return Finding("memory", "ok", f"{format_bytes(least.bytes)} available, by what {least.by} leaves.")


def find_gpu(device: str, torch: Any, driver: Path = Path("/proc/driver/nvidia/version")) -> Finding:
    """Return the GPU that the run would use; it is missing where `device` (the value of `--device`) asks for one.

    torch: the module. driver: a file that NVIDIA's driver makes.
    """
    asked = device.startswith("cuda")
    if not torch.cuda.is_available():
        if torch.version.cuda is None:
            why = f"torch {torch.__version__} is built without CUDA"
            to_do = "For a GPU install a build with CUDA, see pytorch.org."
        elif driver.exists():
            why = f"torch {torch.__version__} finds none, though there is a driver"
            visible = os.environ.get("CUDA_VISIBLE_DEVICES", "not set")
            to_do = f"Look at CUDA_VISIBLE_DEVICES ('{visible}') and at the driver's version."
        else:
            why, to_do = "there is no NVIDIA driver", "In a batch job ask for one, for instance sbatch --gres=gpu:1."
        text = f"None: {why}."
        if asked:
            return Finding("GPU", "missing", f"{text} --device {device} needs one.", f"{to_do} Or use --device cpu.")
        return Finding("GPU", "note", f"{text} The policy runs on the processor.", to_do)
    properties = torch.cuda.get_device_properties(device if asked else "cuda")
    free, total = torch.cuda.mem_get_info(device if asked else "cuda")
    text = (
        f"{properties.name}, {format_bytes(free)} of {format_bytes(total)} free, compute capability "
        f"{properties.major}.{properties.minor}, torch {torch.__version__} with CUDA {torch.version.cuda}."
    )
    if device == "cpu":
        return Finding("GPU", "note", f"{text} --device cpu leaves it unused.")
    return Finding("GPU", "ok", text)


def find_precision(dtype: str, device: str, torch: Any, cpuinfo: Path = Path("/proc/cpuinfo")) -> Finding:
    """Return the precision that the policy computes in, and whether this device is made for it.

    dtype: `float32` or `bfloat16`, empty where the policy does not say. device: without `auto`.
    """
    text = f"{dtype or 'float32'} on {device}."
    if dtype != "bfloat16":
        return Finding("precision", "ok", text)
    if device.startswith("cuda"):
        if torch.cuda.is_bf16_supported(including_emulation=False):
            return Finding("precision", "ok", text)
        return Finding("precision", "note", f"{text} This GPU has no bfloat16 of its own.", "--dtype float32 is exact.")
    if any(flag in _processor_flags(cpuinfo) for flag in _BFLOAT16_FLAGS):
        return Finding("precision", "ok", text)
    return Finding(
        "precision",
        "note",
        f"{text} This processor has no instructions for it ({', '.join(_BFLOAT16_FLAGS)}).",
        "It saves memory, and --dtype float32 is as fast or faster.",
    )


def _processor_flags(cpuinfo: Path) -> set[str]:
    try:
        lines = cpuinfo.read_text(encoding="ascii", errors="replace").splitlines()
    except OSError:
        return set()
    return {flag for line in lines if line.startswith(("flags", "Features")) for flag in line.split(":")[1].split()}


def find_drawing(
    suite: Suite, libero_assets: Path | None, draw: Callable[[Suite, Path | None], str] = check_drawing
) -> Finding:
    """Draw a picture without a display, in a process of its own."""
    try:
        renderer = draw(suite, libero_assets)
    except UserError as error:
        return Finding("drawing", "missing", str(error))
    text = f"MUJOCO_GL={os.environ.get('MUJOCO_GL', DEFAULT_GL)} draws with {renderer}."
    if "llvmpipe" in renderer.casefold() or "softpipe" in renderer.casefold():
        return Finding(
            "drawing", "note", f"{text} That is the processor.", "On a node with a GPU, its EGL driver is faster."
        )
    return Finding("drawing", "ok", text)


def checked(what: str, check: Callable[[], str]) -> Finding:
    """Return a check that gives a text when all is well, and raises a `UserError` that says what to do otherwise."""
    try:
        return Finding(what, "ok", check())
    except UserError as error:
        return Finding(what, "missing", str(error))


def find_simulator(suite: Suite, libero_assets: Path | None) -> list[Finding]:
    """Return the lines about robosuite, LIBERO and its assets; the last two are notes where the suite needs neither."""
    findings = [checked("robosuite", _robosuite)]
    if suite.kind == "libero":
        return [
            *findings,
            checked("LIBERO", lambda: f"{len(list_tasks(suite))} tasks of {suite.name} in {package_folder()}."),
            checked("assets", lambda: f"{find_assets(libero_assets)}."),
        ]
    return [*findings, _not_needed("LIBERO", suite, libero_assets)]


def _robosuite() -> str:
    find_robosuite()
    return f"robosuite {version('robosuite')}, MuJoCo {version('mujoco')}."


def _not_needed(what: str, suite: Suite, libero_assets: Path | None) -> Finding:
    try:
        text = f"installed in {package_folder()}, assets in {find_assets(libero_assets)}"
    except UserError as error:
        return Finding(what, "note", f"Not needed for the suite {suite.name}. Before its own suites: {error}")
    return Finding(what, "ok", f"Not needed for the suite {suite.name}; {text}.")
