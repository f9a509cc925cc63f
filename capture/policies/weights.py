"""Weights of a model: their digest, and seeded random ones for policies without a checkpoint."""

from __future__ import annotations

import hashlib
import zlib

import numpy as np
import torch
from torch import nn


def weights_digest(model: nn.Module) -> str:
    """Return the SHA-256 (hex) over names, dtypes, shapes and bytes of all weights, in order of their names."""
    digest = hashlib.sha256()
    for name, tensor in sorted(model.state_dict().items()):
        digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}\n".encode())
        # Viewed as bytes, because numpy has no bfloat16.
        digest.update(tensor.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy())
    return digest.hexdigest()


def random_tensor(seed: int, name: str, shape: tuple[int, ...]) -> np.ndarray:
    """Return standard normal numbers (float32) for one tensor of a model, from a random stream of its own.

    The stream is counter-based and depends on the seed and the tensor's name only. torch's normal numbers differ in the
    last bits between processors, and then so would the digest of the same weights.
    """
    stream = np.random.Philox(np.random.SeedSequence([seed, zlib.crc32(name.encode())]))
    return np.random.Generator(stream).standard_normal(shape, dtype=np.float32)
