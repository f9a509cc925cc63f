"""Strict loading: a checkpoint has exactly the tensors of the model, or the error lists every difference."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

import torch
from torch import Tensor

from vla_attention.capture.policies.pi.config import PiConfig
from vla_attention.capture.policies.pi.model import PiModel
from vla_attention.schemas.errors import UserError

Shapes = dict[str, tuple[int, ...]]


class CheckpointMismatch(UserError, ValueError):
    """The checkpoint's tensors are not those of the model: names or shapes differ."""


def expected_tensors(config: PiConfig, dtype: torch.dtype = torch.float32) -> dict[str, Tensor]:
    """Return name -> tensor without memory (meta) of `PiModel(config, dtype)`: shapes, and the precision of each."""
    with torch.device("meta"):
        return PiModel(config, dtype).state_dict()


def expected_shapes(config: PiConfig) -> Shapes:
    """Return name -> shape of every tensor of `PiModel(config)`, without allocating any."""
    return {name: tuple(tensor.shape) for name, tensor in expected_tensors(config).items()}


def check_shapes(found: Shapes, expected: Shapes) -> None:
    """Raise `CheckpointMismatch` that lists every missing, extra and misshapen tensor, if there is any."""
    missing = sorted(expected.keys() - found.keys())
    extra = sorted(found.keys() - expected.keys())
    misshapen = [
        f"{name} is {found[name]} instead of {expected[name]}"
        for name in sorted(expected.keys() & found.keys())
        if found[name] != expected[name]
    ]
    parts = [
        f"{len(items)} {what}: {', '.join(items)}"
        for what, items in (("missing", missing), ("extra", extra), ("of the wrong shape", misshapen))
        if items
    ]
    if parts:
        raise CheckpointMismatch(f"The checkpoint's tensors are not those of the model; {'; '.join(parts)}.")


def build_model(
    config: PiConfig,
    names: Iterable[str],
    read: Callable[[str], Tensor],
    *,
    dtype: torch.dtype = torch.float32,
    device: str | torch.device = "cpu",
) -> PiModel:
    """Build the model and fill it tensor by tensor, so that a full-size checkpoint is never in memory twice.

    `read(name)` returns one tensor by its name in the model; each is cast to the precision the model keeps it in.
    """
    with torch.device("meta"):
        model = PiModel(config, dtype)
    empty = model.state_dict()
    filled = {name: read(name).to(device=device, dtype=empty[name].dtype) for name in names}
    model.load_state_dict(filled, strict=True, assign=True)
    return model.requires_grad_(False)


def model_from_state(
    config: PiConfig,
    state: Mapping[str, Tensor],
    *,
    dtype: torch.dtype = torch.float32,
    device: str | torch.device = "cpu",
) -> PiModel:
    """Build the model from tensors in memory; differences of names or shapes raise `CheckpointMismatch`."""
    check_shapes({name: tuple(tensor.shape) for name, tensor in state.items()}, expected_shapes(config))
    return build_model(config, state, state.__getitem__, dtype=dtype, device=device)
