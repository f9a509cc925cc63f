"""Changes of attention calls: logits that a watcher adds before the softmax, and masks as logits.

A change is broadcastable to (batch, head, query, key). -inf takes a key away; log f multiplies the weight of a key
before normalising by f, as in capture/interventions/attention_edits.py.
"""

from __future__ import annotations

import torch
from torch import Tensor

from vla_attention.capture.interventions.attention_edits import QueryWithoutKeys
from vla_attention.capture.torch_policies.attention_calls import MASKED_BELOW, CallShape
from vla_attention.schemas.errors import BadArgument


class ChangeRefused(BadArgument):
    """An attention call that cannot be changed, or a change that does not fit it."""


def fitted_change(change: Tensor, shape: CallShape, device: torch.device) -> Tensor:
    """Return a watcher's change as float32 (batch or 1, head or 1, query or 1, key or 1) on the call's device.

    Raises:
        ChangeRefused: its shape does not fit the call.
    """
    full = (shape.batch, shape.heads, shape.queries, shape.keys)
    fitted = change.detach().to(device=device, dtype=torch.float32)
    if fitted.ndim > 4 or any(
        size not in (1, expected) for size, expected in zip(reversed(fitted.shape), reversed(full), strict=False)
    ):
        raise ChangeRefused(
            f"A change of shape {tuple(change.shape)} does not fit the attention call {shape}: its logits have the "
            f"shape {full} (batch, head, query, key). Give a tensor that can be broadcast to it."
        )
    return fitted.reshape((1,) * (4 - fitted.ndim) + tuple(fitted.shape))


def mask_as_logits(mask: Tensor, dtype: torch.dtype) -> Tensor:
    """Return a mask as logits to add: bool masks (True: keep) as 0 and -inf, additive masks as they are."""
    if mask.dtype is torch.bool:
        return torch.zeros(mask.shape, dtype=dtype, device=mask.device).masked_fill_(~mask, float("-inf"))
    return mask.to(dtype)


def causal_mask(queries: Tensor, keys: int) -> Tensor:
    """Return (query, key) bool, True where `is_causal` lets a query see a key: aligned to the top left.

    queries: positions of the queries, (query,) int64.
    """
    return torch.arange(keys, device=queries.device)[None, :] <= queries[:, None]


def check_keys_left(before: Tensor, after: Tensor, shape: CallShape) -> None:
    """Raise `QueryWithoutKeys` if a query that had a key has none after a change; logits (batch, head, query, key)."""
    lost = (before.amax(-1) > MASKED_BELOW) & (after.amax(-1) <= MASKED_BELOW)
    if bool(lost.any()):
        batch, head, query = (int(i) for i in lost.nonzero()[0])
        raise QueryWithoutKeys(
            f"An intervention leaves a query without any key in the attention call {shape}, batch row {batch}, head "
            f"{head}, query {query}. Take a smaller group, a weight below 1, or fewer heads or layers."
        )
