"""Attention calls through `torch.nn.functional.scaled_dot_product_attention`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.attention import SDPBackend, sdpa_kernel

from vla_attention.capture.torch_policies.attention_calls import AttentionCall
from vla_attention.capture.torch_policies.call_changes import check_keys_left, fitted_change
from vla_attention.capture.torch_policies.call_tensors import LogitTensors, batch_and_heads, changed_mask
from vla_attention.capture.torch_policies.watched_block import WatchedBlock

FUNCTIONS: tuple[Callable[..., Any], ...] = (
    torch.nn.functional.scaled_dot_product_attention,
    torch.ops.aten.scaled_dot_product_attention,
    torch.ops.aten.scaled_dot_product_attention.default,
)

#: Where a call is changed: flash attention, which a policy may have asked for, takes no mask.
_ANY_KERNEL = [
    SDPBackend.FLASH_ATTENTION, SDPBackend.EFFICIENT_ATTENTION, SDPBackend.CUDNN_ATTENTION, SDPBackend.MATH,
]  # fmt: skip


@dataclass(frozen=True)
class _Arguments:
    query: Tensor
    key: Tensor
    value: Tensor
    attn_mask: Tensor | None = None
    dropout_p: float = 0.0
    is_causal: bool = False
    scale: float | None = None
    enable_gqa: bool = False


def watch_call(
    block: WatchedBlock, function: Callable[..., Any], args: tuple[Any, ...], kwargs: Mapping[str, Any]
) -> Any:
    """Run one call, changed if the watcher says so, and tell the watcher about it."""
    given = _Arguments(*args, **kwargs)
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


def _lead(given: _Arguments) -> list[int]:
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
