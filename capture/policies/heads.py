"""Splitting the width of the residual stream into attention heads, and joining them."""

from __future__ import annotations

import torch
from torch import Tensor


def split_heads(x: Tensor, head_dim: int) -> Tensor:
    """Split (batch, token, head · dim) into (batch, head, token, dim)."""
    return torch.unflatten(x, -1, (-1, head_dim)).transpose(1, 2)


def join_heads(x: Tensor) -> Tensor:
    """Join (batch, head, token, dim) into (batch, token, head · dim)."""
    return x.transpose(1, 2).flatten(2)
