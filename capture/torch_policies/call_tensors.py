"""Logits, masks and axes of attention calls, and changes of logits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from vla_attention.capture.interventions.factors import check_keys_left
from vla_attention.capture.torch_policies.attention_calls import MASK_DISTANCE, MASKED_BELOW, CallShape
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


def causal_mask(queries: Tensor, keys: int) -> Tensor:
    """Return (query, key) bool, True where `is_causal` lets a query see a key: aligned to the top left.

    queries: positions of the queries, (query,) int64.
    """
    return torch.arange(keys, device=queries.device)[None, :] <= queries[:, None]


def visible(logits: Tensor) -> Tensor | None:
    """Return the keys that a mask lets a query see, (batch, head, query, key) bool; None where these are all.

    logits: (batch, head, query, key) with the mask, or the mask alone.
    """
    logits = logits.float()
    highest = logits.amax(-1, keepdim=True)
    if bool(logits.amin() > highest.amax() - MASK_DISTANCE):
        return None
    near = (logits > highest - MASK_DISTANCE) & (highest > MASKED_BELOW)
    return (logits > highest + MASKED_BELOW) & (highest > MASKED_BELOW) & near.any(dim=1, keepdim=True)


@dataclass(frozen=True)
class SeenKeys:
    """Which keys the queries of a call see by its mask.

    Attributes:
        keys: (batch, head or 1, query, key) bool.
        added: what the mask adds to logits, in axes that can be broadcast to theirs; None for nothing.
        every_query: whether it is known that each of them sees a key.
    """

    keys: Tensor
    added: Tensor | None
    every_query: bool


class Masks:
    """The masks of one watched block: most of its calls have the same one."""

    def __init__(self) -> None:
        self._known: dict[tuple[Any, ...], tuple[Tensor | None, SeenKeys]] = {}

    def seen(
        self, mask: Tensor | None, causal: bool, queries: slice, sizes: tuple[int, int, int], device: torch.device
    ) -> SeenKeys:
        """Return what queries of a call see.

        Args:
            mask: (batch or 1, head or 1, query or 1, key) of these queries, bool (True: seen) or added to logits.
            causal: whether `is_causal` hides keys too.
            queries: which ones of the call.
            sizes: batch, queries and keys of the call.
            device: of the call.
        """
        shape = None if mask is None else (mask.shape, mask.dtype)
        key = (shape, causal, queries.start, queries.stop, queries.step, sizes, device)
        if device.type != "cpu":  # comparing would wait for it
            return _seen(mask, causal, queries, sizes, device)
        before, known = self._known.get(key, (None, None))
        if known is None or (mask is not None and before is not None and not torch.equal(mask, before)):
            mask = None if mask is None else mask.clone()  # the policy may write over its own
            known = _seen(mask, causal, queries, sizes, device)
            self._known[key] = mask, known
        return known


def _seen(
    mask: Tensor | None, causal: bool, queries: slice, sizes: tuple[int, int, int], device: torch.device
) -> SeenKeys:
    batch, count, keys = sizes
    numbers = torch.arange(count, device=device)[queries]
    seen = torch.ones((batch, 1, len(numbers), keys), dtype=torch.bool, device=device)
    below = causal_mask(numbers, keys) if causal else None
    hidden, added = None if below is None else ~below, None
    if mask is not None and mask.dtype is torch.bool:
        hidden = ~mask if hidden is None else ~mask | hidden
    elif mask is not None:
        added, unmasked = mask, visible(mask)
        seen = seen if unmasked is None else seen & unmasked
    if hidden is not None:
        seen = seen & ~hidden
        masked = torch.zeros(hidden.shape, device=device).masked_fill_(hidden, float("-inf"))
        added = masked if added is None else added + masked
    alone = added is None or (device.type == "cpu" and not bool((added.amax(-1) == float("-inf")).any()))
    return SeenKeys(seen, added, alone)


def check_change(before: Tensor, after: Tensor, shape: CallShape) -> None:
    """Raise `QueryWithoutKeys` if a query that had a key has none after a change; logits (batch, head, query, key)."""
    highest = before.amax(-1, keepdim=True)
    seen = highest > MASKED_BELOW if (mask := visible(before)) is None else mask
    left = seen & (after > highest + MASKED_BELOW)
    check_keys_left(seen.any(-1) & ~left.any(-1), f"the attention call {shape}")


#: Where modules keep their number of heads; asked where a kernel gets (batch · head, query, dim).
_HEAD_NAMES = ("num_heads", "n_heads", "num_attention_heads", "heads", "n_head", "num_head", "nheads", "nhead")


def query_key_logits(query: Tensor, key: Tensor, scale: float) -> Tensor:
    """Return scale · query · keyᵀ in float32 (float64 of float64), (batch, head, query, key); heads may share keys."""
    dtype = torch.promote_types(query.dtype, torch.float32)
    batch, heads, count, dim = query.shape
    stacked = (query.to(dtype) * scale).reshape(batch, key.shape[1], heads // key.shape[1] * count, dim)
    return torch.matmul(stacked, key.to(dtype).transpose(-1, -2)).reshape(batch, heads, count, key.shape[2])


def normalised(logits: Tensor) -> Tensor:
    """Return softmax(logits) over the last axis in float32; a query that sees no key (-inf throughout) gets zeros."""
    rows = torch.softmax(logits, dim=-1)
    return rows.masked_fill_(logits.amax(-1, keepdim=True) == float("-inf"), 0.0).float()


def part(tensor: Tensor, queries: slice, batch: slice) -> Tensor:
    """Return the wanted queries and batch rows of (batch or 1, head or 1, query or 1, key)."""
    return tensor[batch if tensor.shape[0] > 1 else slice(None), :, queries if tensor.shape[2] > 1 else slice(None)]


def batch_and_heads(lead: Sequence[int], module: nn.Module | None) -> tuple[int, int]:
    """Return (batch, heads) of the axes before query and dim (or before query and key).

    Of one axis alone, the number of heads is taken from the module's attributes; without any it is the heads'.
    """
    sizes = list(lead)
    if len(sizes) >= 2:
        return int(torch.Size(sizes[:-1]).numel()), sizes[-1]
    if not sizes:
        return 1, 1
    heads = _heads_of(module)
    return (sizes[0] // heads, heads) if heads and sizes[0] % heads == 0 else (1, sizes[0])


def _heads_of(module: nn.Module | None) -> int | None:
    for holder in (module, getattr(module, "config", None)):
        for name in _HEAD_NAMES:
            heads = getattr(holder, name, None)
            if isinstance(heads, int) and not isinstance(heads, bool) and heads > 0:
                return heads
    return None
