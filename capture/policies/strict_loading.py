"""Strict loading: a checkpoint has exactly the tensors of the model, or the error lists the differences."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TypeVar

import torch
from torch import Tensor, nn

from vla_attention.capture.policies.checkpoints import CheckpointMismatch
from vla_attention.schemas.errors import listing

#: Names of one kind of difference that an error lists.
_LISTED = 40
Shapes = dict[str, tuple[int, ...]]
Model = TypeVar("Model", bound=nn.Module)


def make_empty(make: Callable[[], Model]) -> Model:
    """Return a model whose tensors have shapes and precisions, but no memory (torch's meta device)."""
    with torch.device("meta"):
        return make()


def shapes_of(tensors: Mapping[str, Tensor]) -> Shapes:
    """Return name -> shape."""
    return {name: tuple(tensor.shape) for name, tensor in tensors.items()}


def check_shapes(found: Shapes, expected: Shapes, what: str = "the model") -> None:
    """Raise `CheckpointMismatch` that lists missing, extra and misshapen tensors, if there are any.

    what: the model or the part of it that needs the expected tensors.
    """
    misshapen = [
        f"{name} is {found[name]} instead of {expected[name]}"
        for name in sorted(expected.keys() & found.keys())
        if found[name] != expected[name]
    ]
    faults = (
        ("missing", sorted(expected.keys() - found.keys())),
        ("extra", sorted(found.keys() - expected.keys())),
        ("of the wrong shape", misshapen),
    )
    parts = [f"{len(names)} {fault}: {listing(names, _LISTED)}" for fault, names in faults if names]
    if parts:
        raise CheckpointMismatch(f"The checkpoint's tensors are not those of {what}; {'; '.join(parts)}.")


def fill(model: Model, tensors: Mapping[str, Tensor]) -> Model:
    """Replace the tensors of an empty model by the given ones, without a copy, and switch gradients off."""
    model.load_state_dict(dict(tensors), strict=True, assign=True)
    return model.requires_grad_(False)
