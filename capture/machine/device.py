"""torch, with the device and the number of threads that a model runs on."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vla_attention.capture.machine.memory import memory_left
from vla_attention.schemas.errors import BadArgument

if TYPE_CHECKING:
    import torch


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
