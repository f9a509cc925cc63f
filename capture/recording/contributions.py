"""Contributions: what each part of the keys adds to the residual stream, as a Gram matrix.

Attention weights overrate keys with small values (Kobayashi et al. 2020). The contribution of a set of keys to a query
is the vector c = gate · W_o · concat_h(sum over its keys of p_h · v_h). Contributions are vectors that may cancel, so
the norms of parts cannot be added up later. Their inner products can: for any union of parts, given by w in {0,
1}^part, |sum of w_i c_i|² = wᵀ G w. The last part is the whole attention update of the block. It shows cancellation,
and what the recording leaves out: over all other parts, 1ᵀ G 1 is the squared norm of the update.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

#: Maps mixed values (any, head · dim) to the residual stream (any, width).
Projector = Callable[[Tensor], Tensor]


@dataclass(frozen=True)
class Projection:
    """Maps mixed values (any, head · dim) to the residual stream (any, width) float32.

    weight: (width, head · dim), the output projection. gate: (1, width), that of a gated block, or None.
    """

    weight: Tensor
    gate: Tensor | None

    def __call__(self, mixed: Tensor) -> Tensor:
        """Return gate · (weight · mixed)."""
        projected = F.linear(mixed, self.weight.float())
        return projected if self.gate is None else projected * self.gate.float()


def keys_of_parts(members: NDArray[np.bool_], device: torch.device) -> list[slice | Tensor]:
    """Return the keys of each part, as indices of a key axis; `members` is (key, part) bool.

    Most parts are consecutive keys. A slice selects those without a copy.
    """
    parts: list[slice | Tensor] = []
    for part in range(members.shape[1]):
        keys = np.flatnonzero(members[:, part])
        if keys.size and keys[-1] - keys[0] + 1 == keys.size:
            parts.append(slice(int(keys[0]), int(keys[-1]) + 1))
        else:
            parts.append(torch.from_numpy(keys).to(device))
    return parts


def part_values(rows: Tensor, values: Tensor, parts: Sequence[slice | Tensor]) -> Tensor:
    """Return the mixed values of each part of the keys, (..., query, part, head · dim) float32.

    Args:
        rows: (..., head, query, key) float32 probabilities, all heads.
        values: (..., kv_head, key, dim); head h uses the key/value head h // (heads / kv_heads).
        parts: the keys of each part, from `keys_of_parts`; parts are disjoint.
    """
    *calls, heads, queries, keys = rows.shape
    kv_heads, _, dim = values.shape[-3:]
    # Heads that share a key/value head become extra queries of that head, so the values need no copies.
    shared = rows.reshape(*calls, kv_heads, heads // kv_heads * queries, keys)
    values = values.float()
    mixed = torch.stack([torch.matmul(shared[..., part], values[..., part, :]) for part in parts], dim=-4)
    # (..., part, kv_head, shared head · query, dim) becomes (..., query, part, head, dim)
    return mixed.view(*calls, len(parts), heads, queries, dim).movedim(-2, -4).flatten(-2)


def part_contributions(rows: Tensor, values: Tensor, parts: Sequence[slice | Tensor], project: Projector) -> Tensor:
    """Return the contribution of each part of the keys to each query, (query, part, width) float32.

    rows: (head, query, key). values: (kv_head, key, dim). parts: as in `part_values`. project: applied to
    (query · part, head · dim) float32, so that one product projects all parts.
    """
    mixed = part_values(rows, values, parts)
    return project(mixed.flatten(0, 1)).float().view(*mixed.shape[:2], -1)


def gram_matrix(contributions: Tensor, update: Tensor) -> Tensor:
    """Return the mean over queries of the inner products of parts and update, (..., part + 1, part + 1) float32.

    contributions: (..., query, part, width); update: (..., query, width), the block's whole addition to the residual
    stream.
    """
    vectors = torch.cat([contributions, update.float()[..., None, :]], dim=-2)
    return torch.matmul(vectors, vectors.transpose(-1, -2)).mean(dim=-3)
