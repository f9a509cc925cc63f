"""Provenance of an episode: versions of code and libraries, the hardware, and the number of threads."""

from __future__ import annotations

import platform
import subprocess
from importlib import metadata
from pathlib import Path

#: Packages whose versions can change numbers or pictures.
_LIBRARIES = ("torch", "numpy", "mujoco", "robosuite", "hf-libero", "zarr", "numcodecs", "sentencepiece")

#: The fact that says of how many policy calls a batch had at most, where that was more than one.
POLICY_BATCH = "policy_batch"


def describe_machine(device: str) -> dict[str, str]:
    """Return versions of code and libraries, processor, GPU and threads; nothing that identifies a person or a host."""
    import torch

    facts = {"code": code_version(), "python": platform.python_version(), "processor": platform.machine()}
    for name in _LIBRARIES:
        try:
            facts[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            facts[name] = "absent"
    facts["device"] = torch.cuda.get_device_name(device) if device.startswith("cuda") else device
    # Sums over other numbers of threads may differ in their last bits.
    facts["threads"] = str(torch.get_num_threads())
    return facts


def code_version() -> str:
    """Return the installed version, with the commit if the code runs from a git checkout."""
    version = metadata.version("vla-attention")
    folder = Path(__file__).resolve().parents[2]
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
