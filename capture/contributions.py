"""Contributions: what each part of the keys adds to the residual stream, as a Gram matrix.

Attention weights alone overrate keys whose values are small (Kobayashi et al. 2020). The contribution of a set of keys to a
query is the vector c = gate · W_o · concat_h(sum over its keys of p_h · v_h). Norms of parts cannot be added up later, because
contributions are vectors that may cancel; their inner products can: for any union of parts chosen by w in {0, 1}^part,
|sum of w_i c_i|² = wᵀ G w. The last part is the block's whole attention update, so that cancellation and what the
recording leaves out can be checked: over all other parts, 1ᵀ G 1 is the update's own squared norm.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

#: The name of the last part.
UPDATE = "update"

#: Maps mixed values (query, head · dim) to the residual stream (query, width): output projection, and gate if there is one.
Projection = Callable[[Tensor], Tensor]


def part_contributions(rows: Tensor, values: Tensor, members: Tensor, project: Projection) -> Tensor:
    """Return the contribution of each part of the keys to each query, (query, part, width) float32.

    Args:
        rows: (head, query, key) float32 probabilities, all heads.
        values: (kv_head, key, dim); head h reads the key/value head h // (heads / kv_heads).
        members: (key, part) bool, which keys a part has; parts are disjoint.
        project: applied to (query, head · dim) float32.
    """
    heads, queries, _ = rows.shape
    shared = heads // values.shape[0]
    values = values.float()
    parts = []
    for part in range(members.shape[1]):
        keys = members[:, part].nonzero().squeeze(-1)
        # (kv_head, shared · query, key) x (kv_head, key, dim): values are never repeated over the heads that share them.
        chosen = rows.index_select(2, keys).reshape(values.shape[0], shared * queries, -1)
        mixed = torch.matmul(chosen, values.index_select(1, keys)).view(heads, queries, -1)
        parts.append(project(mixed.transpose(0, 1).flatten(1)).float())
    return torch.stack(parts, dim=1)


def gram_matrix(contributions: Tensor, update: Tensor) -> Tensor:
    """Return the mean over queries of the inner products of all parts and the update, (part + 1, part + 1) float32.

    contributions: (query, part, width); update: (query, width), what the block really added to the residual stream.
    """
    vectors = torch.cat([contributions, update.float()[:, None]], dim=1)
    return torch.matmul(vectors, vectors.transpose(1, 2)).mean(dim=0)
