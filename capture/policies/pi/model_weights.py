"""The tensors of a pi model, and building the model from them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

import torch
from torch import Tensor

from vla_attention.capture.policies.pi.config import PiConfig
from vla_attention.capture.policies.pi.model import PiModel
from vla_attention.capture.policies.strict_loading import Shapes, check_shapes, fill, make_empty, shapes_of


def expected_tensors(config: PiConfig, dtype: torch.dtype = torch.float32) -> dict[str, Tensor]:
    """Return name -> tensor without memory (meta) of `PiModel(config, dtype)`: shapes, and the precision of each."""
    return make_empty(lambda: PiModel(config, dtype)).state_dict()


def expected_shapes(config: PiConfig) -> Shapes:
    """Return name -> shape of every tensor of `PiModel(config)`, without allocating any."""
    return shapes_of(expected_tensors(config))


def build_model(
    config: PiConfig,
    names: Iterable[str],
    read: Callable[[str], Tensor],
    *,
    dtype: torch.dtype = torch.float32,
    device: str | torch.device = "cpu",
) -> PiModel:
    """Build the model and fill it tensor by tensor, so that a full-size checkpoint is never in memory twice.

    `read(name)` returns one tensor by its name in the model; each is cast to the precision of that tensor in the model.
    """
    model = make_empty(lambda: PiModel(config, dtype))
    empty = model.state_dict()
    return fill(model, {name: read(name).to(device=device, dtype=empty[name].dtype) for name in names})


def model_from_state(
    config: PiConfig,
    state: Mapping[str, Tensor],
    *,
    dtype: torch.dtype = torch.float32,
    device: str | torch.device = "cpu",
) -> PiModel:
    """Build the model from tensors in memory; differences of names or shapes raise `CheckpointMismatch`."""
    check_shapes(shapes_of(state), expected_shapes(config))
    return build_model(config, state, state.__getitem__, dtype=dtype, device=device)
