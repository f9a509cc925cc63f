"""What a run needs, looked at one by one: each check says that it is there, or the command that mends it."""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Literal

from vla_attention.capture.environments.base import Suite
from vla_attention.capture.environments.drawing import check_drawing
from vla_attention.capture.environments.libero_installation import find_assets, package_folder
from vla_attention.capture.environments.robosuite_installation import DEFAULT_GL, find_robosuite
from vla_attention.capture.environments.suites import list_tasks
from vla_attention.capture.machine import memory_limits
from vla_attention.capture.run.run_settings import RunSettings
from vla_attention.capture.store.store_root import read_existing_root
from vla_attention.schemas.command_line import format_bytes
from vla_attention.schemas.errors import UserError, plural
from vla_attention.schemas.stores.root import episode_folders
from vla_attention.schemas.stores.store_place import check_writable, room_at
from vla_attention.schemas.threads import Threads

#: `ok`: as it should be. `note`: works, but could be better. `missing`: the run needs it.
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


def checked(what: str, check: Callable[[], str]) -> Finding:
    """Return a check that gives a text when all is well, and raises a `UserError` that says what to do otherwise."""
    try:
        return Finding(what, "ok", check())
    except UserError as error:
        return Finding(what, "missing", str(error))


def find_memory(threads: Threads) -> Finding:
    """Return the memory that this process may still take, and the threads of the policy."""
    of_policy = f"{plural(threads.number, 'thread')} for the policy ({threads.source})."
    least = min(memory_limits(), key=lambda limit: limit.bytes, default=None)
    if least is None:
        return Finding("memory", "note", f"This system does not say how much is available. {of_policy}")
    return Finding("memory", "ok", f"{format_bytes(least.bytes)} available, by what {least.by} leaves; {of_policy}")


def find_gpu(device: str, torch: Any, driver: Path = Path("/proc/driver/nvidia/version")) -> Finding:
    """Return the GPU that the run would use; it is missing where `device` (the value of `--device`) asks for one.

    torch: the module. driver: a file that NVIDIA's driver makes.
    """
    asked = device.startswith("cuda")
    if torch.cuda.is_available():
        used = device if asked else "cuda"
        free, total = torch.cuda.mem_get_info(used)
        memory, build = f"{format_bytes(free)} of {format_bytes(total)} free", f"with CUDA {torch.version.cuda}"
        text = f"{torch.cuda.get_device_name(used)}, {memory}, torch {torch.__version__} {build}."
        return Finding("GPU", "ok", f"{text} --device cpu leaves it unused." if device == "cpu" else text)
    if torch.version.cuda is None:
        why = f"torch {torch.__version__} is built without CUDA"
        to_do = "On Linux `pip install --force-reinstall torch` brings a build with CUDA."
    elif driver.exists():
        why = f"torch {torch.__version__} finds none, though there is a driver"
        visible = os.environ.get("CUDA_VISIBLE_DEVICES", "not set")
        to_do = f"Look at CUDA_VISIBLE_DEVICES ('{visible}') and at the driver's version (nvidia-smi)."
    else:
        why, to_do = "there is no NVIDIA driver", "In a batch job ask for one, for instance sbatch --gres=gpu:1."
    if asked:
        return Finding("GPU", "missing", f"None: {why}. --device {device} needs one.", f"{to_do} Or use --device cpu.")
    return Finding("GPU", "note", f"None: {why}. The policy runs on the processor.", to_do)


def find_simulator(suite: Suite, libero_assets: Path | None) -> list[Finding]:
    """Return the lines about robosuite and, where the suite needs them, LIBERO and its assets."""

    def robosuite() -> str:
        find_robosuite()
        return f"robosuite {_version('robosuite')}, MuJoCo {_version('mujoco')}."

    def libero() -> str:
        tasks = f"{len(list_tasks(suite))} tasks of {suite.name}"
        return f"hf-libero {_version('hf-libero')}, {tasks} in {package_folder()}."

    findings = [checked("robosuite", robosuite)]
    if suite.kind == "libero":
        findings += [
            checked("LIBERO", libero),
            checked("assets", lambda: f"{find_assets(libero_assets)}."),
        ]
    return findings


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:  # a copy of its sources
        return "of an unknown version"


def find_drawing(
    suite: Suite, libero_assets: Path | None, draw: Callable[[Suite, Path | None], str] = check_drawing
) -> Finding:
    """Draw a picture without a display, in a process of its own."""

    def drawn() -> str:
        return f"MUJOCO_GL={os.environ.get('MUJOCO_GL', DEFAULT_GL)} draws with {draw(suite, libero_assets)}."

    finding = checked("drawing", drawn)
    if finding.status == "ok" and any(name in finding.text.casefold() for name in ("llvmpipe", "softpipe")):
        to_do = "That is the processor; on a node with a GPU, its EGL driver is faster."
        return Finding("drawing", "note", finding.text, to_do)
    return finding


def find_disk(settings: RunSettings) -> Finding:
    """Return whether the store can be written where the run would write it, and the room there."""
    held = 0

    def place() -> str:
        nonlocal held
        if settings.store.exists():
            read_existing_root(settings.store)
            held = len(episode_folders(settings.store))
        check_writable(settings.store.parent, "--output")
        return f"{room_at(settings.store).describe()} free for {settings.store}."

    finding = checked("disk", place)
    if finding.status == "ok" and held and settings.output.mode == "new":
        to_do = "A run there needs --resume, which adds what is missing, or --overwrite, which begins again."
        return Finding("disk", "note", f"{settings.store} holds {plural(held, 'episode')} already.", to_do)
    return finding


def find_checkpoint(arguments: argparse.Namespace) -> Finding:
    """Return whether the files of the checkpoint are there and are what they should be; no weights are read."""
    name, path = arguments.checkpoint, Path(arguments.checkpoint).expanduser()

    def files() -> str:
        arguments.family.read(arguments).check_files()
        if name in arguments.family.built_in:
            return f"{name} comes with the program."
        found = [path] if path.is_file() else [file for file in path.rglob("*") if file.is_file()]
        return f"{name}, {format_bytes(sum(file.stat().st_size for file in found))} of files."

    finding = checked("checkpoint", files)
    if finding.status == "ok" and name not in arguments.family.built_in and not path.exists():
        text = f"{name} is no folder here: a run takes it from the caches of the hub and of openpi, or downloads it."
        return Finding("checkpoint", "note", text)
    return finding
