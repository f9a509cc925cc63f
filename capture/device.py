"""The device that a model runs on."""

from __future__ import annotations

from vla_attention.schemas.errors import BadArgument


def choose_device(name: str) -> str:
    """Return the torch device of `--device`, which exists; `auto` takes a GPU if there is one."""
    import torch

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
