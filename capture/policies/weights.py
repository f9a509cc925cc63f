"""Weights of a model: their precision and digest, seeded random ones, and strict loading.

Strict: a checkpoint has exactly the tensors of the model, or the error lists the differences.
"""

from __future__ import annotations

import hashlib
import zlib
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

from vla_attention.capture.policies.checkpoints import CheckpointMismatch
from vla_attention.schemas.errors import UserError, listing

DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16}


def dtype_name(dtype: torch.dtype) -> str:
    """Return the name of a precision, for instance `float32`."""
    return str(dtype).removeprefix("torch.")


#: Names of the types of weights, as PyTorch, numpy and safetensors call them. Whole numbers and 8 bits need scales,
#: without which they would be other weights.
_FLOATS = {"float64", "float32", "float16", "bfloat16", "F64", "F32", "F16", "BF16"}


def check_floats(kinds: Mapping[str, str], where: object) -> None:
    """Raise `CheckpointMismatch` for weights that are no floating point numbers of at least 16 bits.

    kinds: name -> its type. where: the file or folder, for the error.
    """
    wrong = [f"{name} ({kind})" for name, kind in kinds.items() if kind.removeprefix("torch.") not in _FLOATS]
    if wrong:
        raise CheckpointMismatch(
            f"'{where}' has weights that are no floating point numbers of 16 bits or more: {listing(wrong)}; use the "
            "checkpoint before it was quantized."
        )


class WeightsNotFinite(UserError, ValueError):
    """Weights of a model hold NaN or infinity."""


def weights_digest(model: nn.Module) -> str:
    """Return the SHA-256 (hex) over names, dtypes, shapes and bytes of all weights, in order of their names.

    Every weight is read here, so this is also where they are checked.

    Raises:
        WeightsNotFinite: tensors hold NaN or infinity; the error names them.
    """
    digest, damaged = hashlib.sha256(), []
    for name, tensor in sorted(model.state_dict().items()):
        if not _is_finite(tensor):
            damaged.append(f"{name} ({int((~torch.isfinite(tensor)).sum())} of {tensor.numel()} numbers)")
        digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}\n".encode())
        # Viewed as bytes, because numpy has no bfloat16.
        digest.update(tensor.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy())
    if damaged:
        raise WeightsNotFinite(
            f"The checkpoint has NaN or infinite weights in {len(damaged)} tensors: {listing(damaged)}. Download or "
            "convert it again, or use one of an earlier training step."
        )
    return digest.hexdigest()


def _is_finite(tensor: Tensor) -> bool:
    if not tensor.is_floating_point() or not tensor.numel():
        return True
    # One pass without a mask as large as the tensor. The smallest and the largest number are NaN if any number is.
    low, high = torch.aminmax(tensor.detach())
    return bool(torch.isfinite(low) & torch.isfinite(high))


def random_tensor(seed: int, name: str, shape: tuple[int, ...]) -> np.ndarray:
    """Return standard normal numbers (float32) for one tensor of a model, from a random stream of its own.

    The stream is counter-based and depends on the seed and the tensor's name only. torch's normal numbers differ in the
    last bits between processors, and then so would the digest of the same weights.
    """
    stream = np.random.Philox(np.random.SeedSequence([seed, zlib.crc32(name.encode())]))
    return np.random.Generator(stream).standard_normal(shape, dtype=np.float32)


#: Names of one kind of difference that an error lists.
_LISTED = 40
Shapes = dict[str, tuple[int, ...]]
Model = TypeVar("Model", bound=nn.Module)


def make_empty(make: Callable[[], Model]) -> Model:
    """Return a model whose tensors have shapes and precisions, but no memory (torch's meta device)."""
    with torch.device("meta"), _NoRandomNumbers():
        return make()


class _NoRandomNumbers(TorchFunctionMode):
    """Modules draw no initial weights. For tensors without memory, torch would load its compiler to do so: seconds."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        if getattr(func, "__module__", "") == nn.init.__name__:
            return kwargs["tensor"] if "tensor" in kwargs else args[0]
        return func(*args, **kwargs)


def shapes_of(tensors: Mapping[str, Tensor]) -> Shapes:
    """Return name -> shape."""
    return {name: tuple(tensor.shape) for name, tensor in tensors.items()}


def check_shapes(found: Shapes, expected: Shapes, what: str = "the model", hint: str = "") -> None:
    """Raise `CheckpointMismatch` that lists missing, extra and misshapen tensors, if there are any.

    what: the model or the part of it that needs the expected tensors. hint: ends the error.
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
        raise CheckpointMismatch(f"The checkpoint's tensors are not those of {what}; {'; '.join(parts)}.{hint}")


def fill(model: Model, tensors: Mapping[str, Tensor]) -> Model:
    """Replace the tensors of an empty model by the given ones, without a copy, and switch gradients off."""
    model.load_state_dict(dict(tensors), strict=True, assign=True)
    return model.requires_grad_(False)
