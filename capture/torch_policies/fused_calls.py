"""Attention calls through torch's kernels, `scaled_dot_product_attention` and `flex_attention`.

Of `flex_attention`, the mode sees the operator below it, which gets the score function and the block mask's tensors.
Run eager, it applies the mask function to every key, whatever the blocks say.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from msgspec import Struct, structs
from torch import Tensor, nn
from torch._higher_order_ops.flex_attention import flex_attention as flex_operator
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.nn.attention.bias import CausalBias

from vla_attention.capture.torch_policies.attention_calls import AttentionCall
from vla_attention.capture.torch_policies.call_tensors import (
    SeenKeys,
    batch_and_heads,
    check_change,
    fitted_change,
    normalised,
    part,
    query_key_logits,
    visible,
)

if TYPE_CHECKING:
    from vla_attention.capture.torch_policies.watch import AttentionMode

SDPA_FUNCTIONS: tuple[Callable[..., Any], ...] = (
    torch.nn.functional.scaled_dot_product_attention,
    torch.ops.aten.scaled_dot_product_attention,
    torch.ops.aten.scaled_dot_product_attention.default,
)
FLEX_FUNCTIONS: tuple[Callable[..., Any], ...] = (flex_operator,)

#: Where a call is changed: flash attention, which a policy may have asked for, takes no mask.
_ANY_KERNEL = [
    SDPBackend.FLASH_ATTENTION, SDPBackend.EFFICIENT_ATTENTION, SDPBackend.CUDNN_ATTENTION, SDPBackend.MATH,
]  # fmt: skip


class _SdpaArguments(Struct, frozen=True):
    query: Tensor
    key: Tensor
    value: Tensor
    attn_mask: Tensor | None = None
    dropout_p: float = 0.0
    is_causal: bool = False
    scale: float | None = None
    enable_gqa: bool = False


def watch_sdpa(
    mode: AttentionMode, function: Callable[..., Any], args: tuple[Any, ...], kwargs: Mapping[str, Any]
) -> Any:
    """Run one call, changed if the watcher says so, and tell the watcher about it."""
    given = _SdpaArguments(*args, **kwargs)
    query, key = given.query, given.key
    mode.refuse_without_numbers(query, key)
    if isinstance(given.attn_mask, CausalBias):  # it has no numbers of its own
        given = structs.replace(given, attn_mask=given.attn_mask._materialize(query.device))
    device = query.device.type
    dtype = torch.get_autocast_dtype(device) if torch.is_autocast_enabled(device) else query.dtype
    path, module = mode.where()
    lead = _lead(given)
    batch, kernel_heads = batch_and_heads(lead, module)
    kv_heads = key.shape[-3] if given.enable_gqa and len(lead) >= 2 else kernel_heads
    group = _packed_heads(module, query, key)
    sizes = (batch, kernel_heads * group, kv_heads, query.shape[-2] // group, key.shape[-2])
    shape = mode.new_shape(path, "sdpa", sizes, dtype)
    batch, heads, queries, keys = shape.batch, shape.heads, shape.queries, shape.keys
    kernel_queries, dim = query.shape[-2], query.shape[-1]

    @cache
    def folded_mask() -> Tensor | None:
        if given.attn_mask is None:
            return None
        mask = _folded_mask(given.attn_mask.detach(), lead, batch, kernel_heads)
        if group > 1 and mask.shape[1:3] != (1, 1):
            mask = mask.expand(-1, kernel_heads, kernel_queries, -1).reshape(-1, heads, queries, mask.shape[-1])
        return mask

    def seen_of(wanted: slice, rows: slice) -> SeenKeys:
        mask, size = folded_mask(), len(range(*rows.indices(batch)))
        given_mask = None if mask is None else part(mask, wanted, rows)
        return mode.masks.seen(given_mask, given.is_causal, wanted, (size, queries, keys), query.device)

    change = mode.change(shape)
    if change is None:
        output = function(*args, **kwargs)
    else:
        change = fitted_change(change, shape, query.device)
        before, added = torch.zeros((1, 1, queries, keys), device=query.device), seen_of(slice(None), slice(None)).added
        before = before if added is None else before + added.float()
        after = before + change
        check_change(before, after, shape)
        # As the kernel wants it: as many axes as its queries have.
        logits = after.expand(batch, heads, -1, -1).reshape(*lead, kernel_queries, keys).to(dtype)
        options = {"scale": given.scale, "enable_gqa": given.enable_gqa}
        with sdpa_kernel(_ANY_KERNEL):
            output = function(query, key, given.value, logits, given.dropout_p, **options)
    if mode.passes(shape):
        return output
    folded_query = query.detach().to(dtype).expand(*lead, -1, -1).reshape(batch, heads, queries, dim)
    folded_key, values = (
        _folded(tensor.to(dtype), lead, batch, shape.kv_heads) for tensor in (key, given.value)
    )  # fmt: skip
    scale = dim**-0.5 if given.scale is None else given.scale

    def rows_of(wanted: slice, rows: slice) -> Tensor:
        logits, seen = query_key_logits(folded_query[rows, :, wanted], folded_key[rows], scale), seen_of(wanted, rows)
        if seen.added is not None:
            logits.add_(seen.added)
        if change is not None:
            return normalised(logits.add_(part(change, wanted, rows)))
        return torch.softmax(logits, dim=-1).float() if seen.every_query else normalised(logits)

    folded = output.detach().reshape(batch, heads, queries, given.value.shape[-1])
    allowed_of = lambda wanted: seen_of(wanted, slice(None)).keys  # noqa: E731
    mode.saw(AttentionCall(shape, values, folded, rows_of, allowed_of, lambda mixed: mixed.reshape(output.shape)))
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


def watch_flex(
    mode: AttentionMode, function: Callable[..., Any], args: tuple[Any, ...], kwargs: Mapping[str, Any]
) -> Any:
    """Run one call, changed if the watcher says so, and tell the watcher about it."""
    names = ("query", "key", "value", "score_mod", "block_mask", "scale", "kernel_options")
    buffers = ("score_mod_other_buffers", "mask_mod_other_buffers")
    given: dict[str, Any] = {
        **dict.fromkeys(buffers, ()),
        **dict(zip((*names, *buffers), args, strict=False)),
        **kwargs,
    }
    query, key, value = (given[name] for name in names[:3])
    mode.refuse_without_numbers(query, key)
    batch, heads, queries, _ = query.shape
    keys = key.shape[2]
    shape = mode.new_shape(mode.where()[0], "flex", (batch, heads, key.shape[1], queries, keys), query.dtype)
    score: Callable[..., Tensor] = given["score_mod"] or (lambda score, *_: score)
    kept_query, kept_key, kept_value = (tensor.detach().expand(batch, -1, -1, -1) for tensor in (query, key, value))

    def places(wanted: slice, rows: slice) -> list[Tensor]:
        """The numbers of (batch, head, query, key)."""
        chosen = zip((batch, heads, queries, keys), (rows, slice(None), wanted, slice(None)), strict=True)
        return [torch.arange(size, device=query.device)[some] for size, some in chosen]

    def in_blocks(wanted: slice, rows: slice) -> Tensor:
        numbers = places(wanted, rows)
        seen = _over_places(given["block_mask"][-1], ())(*numbers, *given[buffers[1]])
        return seen.expand([len(axis) for axis in numbers])

    def allowed_of(wanted: slice) -> Tensor:
        seen = in_blocks(wanted, slice(None))
        # A score function may mask, too: by what it makes of zeros.
        zeros, numbers = seen.new_zeros(seen.shape, dtype=torch.float32), places(wanted, slice(None))
        unmasked = visible(_over_places(score, (0,))(zeros, *numbers, *given[buffers[0]]))
        return seen if unmasked is None else seen & unmasked

    def logits_of(wanted: slice, rows: slice) -> Tensor:
        logits = query_key_logits(kept_query[rows, :, wanted], kept_key[rows], given["scale"])
        logits = _over_places(score, (0,))(logits, *places(wanted, rows), *given[buffers[0]])
        return logits.masked_fill(~in_blocks(wanted, rows), float("-inf"))

    change = mode.change(shape)
    if change is None:
        result = function(*args, **kwargs)
    else:
        change = fitted_change(change, shape, query.device)
        before = logits_of(slice(None), slice(None))
        check_change(before, before + change, shape)
        full = change.expand(batch, heads, queries, keys)

        def changed_score(scores: Tensor, b: Tensor, h: Tensor, q: Tensor, k: Tensor, *others: Any) -> Tensor:
            return score(scores, b, h, q, k, *others) + full[b, h, q, k]

        result = function(**{**given, "score_mod": changed_score})
    if not mode.passes(shape):

        def rows_of(wanted: slice, rows: slice) -> Tensor:
            logits = logits_of(wanted, rows)
            return normalised(logits if change is None else logits + part(change, wanted, rows))

        mode.saw(AttentionCall(shape, kept_value, result[0].detach(), rows_of, allowed_of, lambda mixed: mixed))
    return result


def _over_places(function: Callable[..., Tensor], score_axes: tuple[int, ...]) -> Callable[..., Tensor]:
    """Apply a score or mask function of single places to all of (batch, head, query, key) at once."""

    def broadcast(*arguments: Any) -> Tensor:
        mapped, others = function, (None,) * (len(arguments) - len(score_axes) - 4)
        for axis in (3, 2, 1, 0):
            mapped = torch.vmap(mapped, (*score_axes, *(0 if place == axis else None for place in range(4)), *others))
        return mapped(*arguments)

    return broadcast
