"""Weights of a model: their digest, and seeded random ones for policies without a checkpoint."""

from __future__ import annotations

import hashlib
import zlib

import numpy as np
import torch
from torch import Tensor, nn

from vla_attention.schemas.errors import UserError, listing


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
