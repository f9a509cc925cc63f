"""Attention calls through torch's kernels, `scaled_dot_product_attention` and `flex_attention`.

Of `flex_attention`, the mode sees the operator below it, which gets the score function and the block mask's tensors.
Run eager, it applies the mask function to every key, whatever the blocks say.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch._higher_order_ops.flex_attention import flex_attention as flex_operator
from torch.nn.attention import SDPBackend, sdpa_kernel

from vla_attention.capture.torch_policies.attention_calls import (
    AttentionCall,
    Positions,
    at_positions,
    position_numbers,
)
from vla_attention.capture.torch_policies.call_tensors import (
    LogitTensors,
    batch_and_heads,
    changed_mask,
    check_keys_left,
    fitted_change,
    normalised,
    query_key_logits,
)
from vla_attention.capture.torch_policies.watched_block import WatchedBlock

SDPA_FUNCTIONS: tuple[Callable[..., Any], ...] = (
    torch.nn.functional.scaled_dot_product_attention,
    torch.ops.aten.scaled_dot_product_attention,
    torch.ops.aten.scaled_dot_product_attention.default,
)

#: Where a call is changed: flash attention, which a policy may have asked for, takes no mask.
_ANY_KERNEL = [
    SDPBackend.FLASH_ATTENTION, SDPBackend.EFFICIENT_ATTENTION, SDPBackend.CUDNN_ATTENTION, SDPBackend.MATH,
]  # fmt: skip


@dataclass(frozen=True)
class _SdpaArguments:
    query: Tensor
    key: Tensor
    value: Tensor
    attn_mask: Tensor | None = None
    dropout_p: float = 0.0
    is_causal: bool = False
    scale: float | None = None
    enable_gqa: bool = False


def watch_sdpa(
    block: WatchedBlock, function: Callable[..., Any], args: tuple[Any, ...], kwargs: Mapping[str, Any]
) -> Any:
    """Run one call, changed if the watcher says so, and tell the watcher about it."""
    given = _SdpaArguments(*args, **kwargs)
    query, key = given.query, given.key
    block.refuse_nested(query, key)
    dtype = query.dtype
    if torch.is_autocast_enabled(query.device.type):
        dtype = torch.get_autocast_dtype(query.device.type)
    where = block.where()
    lead, kernel_queries, dim = _lead(given), query.shape[-2], query.shape[-1]
    keys = key.shape[-2]
    batch, kernel_heads = batch_and_heads(lead, where.module)
    kv_heads = key.shape[-3] if given.enable_gqa and len(lead) >= 2 else kernel_heads
    group = _packed_heads(where.module, query, key)
    heads, queries = kernel_heads * group, kernel_queries // group
    shape = block.new_shape(where, "sdpa", (batch, heads, kv_heads, queries, keys), dtype)
    mask = None
    if given.attn_mask is not None:
        mask = _folded_mask(given.attn_mask.detach(), lead, batch, kernel_heads)
        if group > 1 and mask.shape[1:3] != (1, 1):
            mask = mask.expand(-1, kernel_heads, kernel_queries, -1).reshape(-1, heads, queries, mask.shape[-1])
    change = block.change(shape)
    if change is None:
        output = function(*args, **kwargs)
    else:
        change = fitted_change(change, shape, query.device)
        before, after = changed_mask(mask, given.is_causal, change, queries, keys)
        check_keys_left(before, after, shape)
        # As the kernel wants it: as many axes as its queries have.
        logits = after.expand(batch, heads, -1, -1).reshape(*lead, kernel_queries, keys).to(dtype)
        options = {"scale": given.scale, "enable_gqa": given.enable_gqa}
        with sdpa_kernel(_ANY_KERNEL):
            output = function(query, key, given.value, logits, given.dropout_p, **options)
    if block.passes(shape):
        return output
    tensors = LogitTensors(
        query=query.detach().to(dtype).expand(*lead, -1, -1).reshape(batch, heads, queries, dim),
        key=_folded(key.to(dtype), lead, batch, kv_heads),
        values=_folded(given.value.to(dtype), lead, batch, kv_heads),
        outputs=output.detach().reshape(batch, heads, queries, given.value.shape[-1]),
        mask=mask,
        causal=given.is_causal,
        scale=dim**-0.5 if given.scale is None else given.scale,
        change=change,
    )
    block.saw(AttentionCall(shape, tensors))
    return output


def _lead(given: _SdpaArguments) -> list[int]:
    """Return the axes before query and dim of the output: the kernel broadcasts them, as for learned queries."""
    leads = [tensor.shape[:-2] for tensor in (given.query, given.key, given.value)]
    if given.attn_mask is not None and given.attn_mask.ndim == given.query.ndim:
        leads.append(given.attn_mask.shape[:-2])
    if given.enable_gqa:
        heads = given.query.shape[-3]
        leads = [torch.Size((*lead[:-1], heads if lead[-1] > 1 else 1)) for lead in leads]
    first = leads[0]
    return list(first if all(lead == first for lead in leads) else np.broadcast_shapes(*leads))


def _folded(tensor: Tensor, lead: list[int], batch: int, kv_heads: int) -> Tensor:
    """Return keys or values (..., key, dim) as (batch, kv_head, key, dim)."""
    tensor = tensor.detach()
    shared = [*lead[:-1], kv_heads] if len(lead) >= 2 else lead
    return tensor.expand(*shared, *tensor.shape[-2:]).reshape(batch, kv_heads, *tensor.shape[-2:])


def _folded_mask(mask: Tensor, lead: list[int], batch: int, heads: int) -> Tensor:
    """Return a mask that can be broadcast to (..., query, key) as (batch or 1, head or 1, query or 1, key)."""
    if mask.ndim <= 2:
        return mask.reshape(*((1,) * (4 - mask.ndim)), *mask.shape)
    if mask.ndim == 4 and len(lead) == 2:
        return mask
    return mask.expand(*lead, *mask.shape[-2:]).reshape(batch, heads, *mask.shape[-2:])


def _packed_heads(module: nn.Module | None, query: Tensor, key: Tensor) -> int:
    """Return how many heads are packed into the query axis, 1 for none.

    transformers (since 5) hands the one query of a decoding step as (batch, kv_head, heads of a group, dim).
    """
    group, config = getattr(module, "num_key_value_groups", 1), getattr(module, "config", None)
    heads = getattr(config, "num_attention_heads", None)
    if not isinstance(group, int) or group <= 1 or query.ndim != 4 or query.shape[1] != key.shape[1]:
        return 1
    return group if query.shape[2] == group and query.shape[1] * group == heads else 1


FLEX_FUNCTIONS: tuple[Callable[..., Any], ...] = (flex_operator,)


@dataclass(frozen=True)
class FlexTensors:
    """The tensors of one call; see `LogitTensors`.

    Attributes:
        query: (batch, head, query, dim).
        key, values: (batch or 1, kv_head, key, dim).
        outputs: (batch, head, query, dim).
        scale: factor of the logits.
        score: score function (score, batch, head, query, key) -> score; further arguments: `score_buffers`.
        mask: mask function (batch, head, query, key) -> bool; further arguments: `mask_buffers`.
        change: logits that a watcher added.
    """

    query: Tensor
    key: Tensor
    values: Tensor
    outputs: Tensor
    scale: float
    score: Callable[..., Tensor]
    mask: Callable[..., Tensor]
    score_buffers: tuple[Any, ...]
    mask_buffers: tuple[Any, ...]
    change: Tensor | None = None

    def rows(self, queries: Positions, batch: Positions) -> Tensor:
        """Return float32 probabilities (batch, head, query, key) of these queries."""
        return normalised(self.logits(queries, batch))

    def logits(self, queries: Positions, batch: Positions) -> Tensor:
        """Return masked logits of these queries, -inf where masked."""
        numbers = position_numbers(queries, self.query.shape[2], self.query.device)
        batches = position_numbers(batch, self.query.shape[0], self.query.device)
        query = at_positions(at_positions(self.query, 0, batch), 2, queries)
        logits = query_key_logits(query, at_positions(self.key, 0, batch), self.scale)
        places = self._places(batches, numbers)
        logits = _over_places(self.score, True)(logits, *places, *self.score_buffers)
        if self.change is not None:
            change = at_positions(self.change, 0, batch) if self.change.shape[0] > 1 else self.change
            logits = logits + (at_positions(change, 2, queries) if change.shape[2] > 1 else change)
        return logits.masked_fill(~_over_places(self.mask, False)(*places, *self.mask_buffers), float("-inf"))

    def allowed(self, queries: Positions) -> Tensor:
        """Return (batch, head, query, key) bool."""
        numbers = position_numbers(queries, self.query.shape[2], self.query.device)
        batches = torch.arange(self.query.shape[0], device=self.query.device)
        places = self._places(batches, numbers)
        full = (len(batches), self.query.shape[1], len(numbers), self.key.shape[2])
        return _over_places(self.mask, False)(*places, *self.mask_buffers).expand(full)

    def _places(self, batches: Tensor, queries: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        device = self.query.device
        heads, keys = torch.arange(self.query.shape[1], device=device), torch.arange(self.key.shape[2], device=device)
        return batches, heads, queries, keys


def watch_flex(
    block: WatchedBlock, function: Callable[..., Any], args: tuple[Any, ...], kwargs: Mapping[str, Any]
) -> Any:
    """Run one call, changed if the watcher says so, and tell the watcher about it."""
    names = ("query", "key", "value", "score_mod", "block_mask", "scale", "kernel_options")
    given = {"score_mod_other_buffers": (), "mask_mod_other_buffers": ()} | dict(
        zip((*names, "score_mod_other_buffers", "mask_mod_other_buffers"), args, strict=False)
    )
    given.update(kwargs)
    query, key, value = (given[name] for name in names[:3])
    block.refuse_nested(query, key)
    batch, heads, queries, _ = query.shape
    shape = block.new_shape(
        block.where(), "flex", (batch, heads, key.shape[1], queries, key.shape[2]), query.dtype
    )  # fmt: skip
    score: Callable[..., Tensor] = given["score_mod"] or (lambda score, *_: score)
    tensors = FlexTensors(
        query=query.detach(),
        key=key.detach().expand(batch, -1, -1, -1),
        values=value.detach().expand(batch, -1, -1, -1),
        outputs=query.new_empty(0),
        scale=given["scale"],
        score=score,
        mask=given["block_mask"][-1],
        score_buffers=tuple(given["score_mod_other_buffers"]),
        mask_buffers=tuple(given["mask_mod_other_buffers"]),
    )
    change = block.change(shape)
    if change is not None:
        change = fitted_change(change, shape, query.device)
        changed = replace(tensors, change=change)
        check_keys_left(tensors.logits(slice(None), slice(None)), changed.logits(slice(None), slice(None)), shape)
        tensors = changed
        full = change.expand(batch, heads, queries, key.shape[2])

        def changed_score(scores: Tensor, b: Tensor, h: Tensor, q: Tensor, k: Tensor, *buffers: Any) -> Tensor:
            return score(scores, b, h, q, k, *buffers) + full[b, h, q, k]

        result = function(**{**given, "score_mod": changed_score})
    else:
        result = function(*args, **kwargs)
    if not block.passes(shape):
        block.saw(AttentionCall(shape, replace(tensors, outputs=result[0].detach())))
    return result


def _over_places(function: Callable[..., Tensor], with_score: bool) -> Callable[..., Tensor]:
    """Apply a score or mask function of single places to all of (batch, head, query, key) at once."""

    def broadcast(*arguments: Any) -> Tensor:
        first, rest = (arguments[:1], arguments[1:]) if with_score else ((), arguments)
        places, buffers = rest[:4], rest[4:]
        mapped = function
        score_dims: tuple[int | None, ...] = (0,) if with_score else ()
        for axis in (3, 2, 1, 0):
            dims: tuple[int | None, ...] = tuple(0 if number == axis else None for number in range(4))
            mapped = torch.vmap(mapped, in_dims=(*score_dims, *dims, *(None for _ in buffers)))
        return mapped(*first, *places, *buffers)

    return broadcast
