"""Attention calls through `torch.nn.functional.multi_head_attention_forward`, as `nn.MultiheadAttention` makes them.

This function projects, attends and projects back in one. What is inside is computed beside it, when it is asked for:
the same function with an output projection that changes nothing gives the kernel's output per head, and once more with
`need_weights` for the wanted queries the rows.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from inspect import signature
from typing import Any

import torch
from torch import Tensor

from vla_attention.capture.torch_policies.attention_calls import (
    MASKED_BELOW,
    AttentionCall,
    Positions,
    at_positions,
    position_numbers,
)
from vla_attention.capture.torch_policies.call_changes import (
    ChangeRefused,
    check_keys_left,
    fitted_change,
    mask_as_logits,
)
from vla_attention.capture.torch_policies.watched_block import WatchedBlock

_FORWARD = torch.nn.functional.multi_head_attention_forward
FUNCTIONS: tuple[Callable[..., Any], ...] = (_FORWARD,)
_SIGNATURE = signature(_FORWARD)


def watch_call(
    block: WatchedBlock, function: Callable[..., Any], args: tuple[Any, ...], kwargs: Mapping[str, Any]
) -> Any:
    """Run one call, changed if the watcher says so, and tell the watcher about it."""
    bound = _SIGNATURE.bind(*args, **kwargs)
    bound.apply_defaults()
    given = dict(bound.arguments)
    block.refuse_nested(given["query"], given["key"])
    query, key, heads = given["query"], given["static_k"], given["num_heads"]
    batch = query.shape[1] if query.ndim == 3 else 1
    keys = given["key"].shape[0] if key is None else key.shape[1]
    keys += (given["bias_k"] is not None) + bool(given["add_zero_attn"])
    shape = block.new_shape(block.where(), "multihead", (batch, heads, heads, query.shape[0], keys), query.dtype)
    change = block.change(shape)
    if change is None:
        result = function(*args, **kwargs)
        run = given
    else:
        if given["bias_k"] is not None or given["add_zero_attn"]:
            raise ChangeRefused(
                f"The attention call {shape} cannot be changed: nn.MultiheadAttention adds keys of its own "
                "(add_bias_kv or add_zero_attn), which a mask cannot reach. Leave this call out."
            )
        change = fitted_change(change, shape, query.device)
        before = _mask_logits(given, batch, heads, query.shape[0], keys)
        check_keys_left(before, before + change, shape)
        full = (before + change).expand(batch, heads, query.shape[0], keys)
        run = {**given, "attn_mask": full.reshape(-1, query.shape[0], keys).to(query.dtype)}
        run.update(key_padding_mask=None, is_causal=False)
        result = function(**run)
    if not block.passes(shape):
        block.saw(AttentionCall(shape, MultiheadTensors(given, run, batch, result[0].detach())))
    return result


@dataclass(frozen=True)
class MultiheadTensors:
    """The tensors of one call.

    Attributes:
        given: its arguments by name, without a change.
        run: those that it ran with.
        batch: number of batch rows.
        result: what the policy's kernel gave, after the output projection: (query, batch, width) or (query, width).
    """

    given: Mapping[str, Any]
    run: Mapping[str, Any]
    batch: int
    result: Tensor

    def value(self) -> Tensor:
        """Return the values (batch, head, key, dim), projected as the call does."""
        return self._values

    def output(self) -> Tensor:
        """Return what the call's kernel computes, (batch, head, query, dim), before the output projection."""
        return self._outputs

    @cached_property
    def _values(self) -> Tensor:
        given, heads = self.given, self.given["num_heads"]
        if given["static_v"] is not None:
            static: Tensor = given["static_v"].detach()
            value = static.reshape(self.batch, heads, *static.shape[1:])
        else:
            width = given["embed_dim_to_check"]
            weight = (
                given["v_proj_weight"] if given["use_separate_proj_weight"] else given["in_proj_weight"][2 * width :]
            )
            bias = None if given["in_proj_bias"] is None else given["in_proj_bias"][2 * width :]
            value = self._split(torch.nn.functional.linear(given["value"], weight, bias).detach())
        if given["bias_v"] is not None:
            value = torch.cat([value, self._split(given["bias_v"].detach()).expand(self.batch, -1, -1, -1)], dim=2)
        if given["add_zero_attn"]:
            value = torch.cat([value, value.new_zeros((*value.shape[:2], 1, value.shape[3]))], dim=2)
        return value

    @cached_property
    def _outputs(self) -> Tensor:
        width, query = self.given["embed_dim_to_check"], self.given["query"]
        unchanged = torch.eye(width, dtype=query.dtype, device=query.device)
        with torch.no_grad():
            output, _ = _FORWARD(**{**self.run, **_NO_DROPOUT, "out_proj_weight": unchanged, "out_proj_bias": None})
        return self._split(output)

    def projected(self, mixed: Tensor, queries: Positions, batch: Positions) -> tuple[Tensor, Tensor]:
        """Return rows times values after the output projection, and what the policy's kernel gave, float32.

        mixed: (batch, head, query, dim). What is inside of the kernel is computed a second time; its result is not.
        """
        bias = self.given["out_proj_bias"]
        joined = mixed.transpose(1, 2).flatten(2)
        bias = None if bias is None else bias.float()
        projected = torch.nn.functional.linear(joined, self.given["out_proj_weight"].float(), bias)
        result = self.result if self.result.ndim == 3 else self.result[:, None]
        return projected, at_positions(at_positions(result, 0, queries), 1, batch).transpose(0, 1).float()

    def rows(self, queries: Positions, batch: Positions) -> Tensor:
        """Return float32 probabilities (batch, head, query, key) of these queries."""
        run, query = self.run, self.given["query"]
        mask = run["attn_mask"]
        if mask is not None:
            mask = at_positions(mask, mask.ndim - 2, queries)
        wanted = {"query": at_positions(query, 0, queries), "attn_mask": mask, "is_causal": False}
        weights = {"need_weights": True, "average_attn_weights": False}
        _, rows = _FORWARD(**_in_float32({**run, **_NO_DROPOUT, **wanted, **weights}))
        assert rows is not None
        rows = rows if query.ndim == 3 else rows[None]
        # Where every key is masked, nn.MultiheadAttention gives no numbers.
        return at_positions(torch.nan_to_num(rows.float()), 0, batch)

    def allowed(self, queries: Positions) -> Tensor:
        """Return (batch, query, key) bool."""
        given, heads, count = self.given, self.given["num_heads"], self.given["query"].shape[0]
        keys = given["key"].shape[0] if given["static_k"] is None else given["static_k"].shape[1]
        seen = (_mask_logits(given, self.batch, heads, count, keys) > MASKED_BELOW).any(1)
        extra = (given["bias_k"] is not None) + bool(given["add_zero_attn"])
        seen = torch.nn.functional.pad(seen.expand(self.batch, count, keys), (0, extra), value=True)
        return seen[:, position_numbers(queries, count, seen.device)]

    def _split(self, tensor: Tensor) -> Tensor:
        """Return (position, batch, head · dim) or (position, head · dim) as (batch, head, position, dim)."""
        tensor = tensor if tensor.ndim == 3 else tensor[:, None]
        heads = self.given["num_heads"]
        return tensor.reshape(*tensor.shape[:2], heads, -1).permute(1, 2, 0, 3)


_NO_DROPOUT: Mapping[str, Any] = {"training": False, "dropout_p": 0.0}


def _mask_logits(given: Mapping[str, Any], batch: int, heads: int, queries: int, keys: int) -> Tensor:
    """Return both masks as float32 logits (batch or 1, head or 1, query, key). In bool masks, True takes a key away."""
    logits = torch.zeros((1, 1, queries, keys), device=given["query"].device)
    mask, padding = given["attn_mask"], given["key_padding_mask"]
    if mask is not None:
        mask = mask_as_logits(~mask if mask.dtype is torch.bool else mask, torch.float32)
        logits = logits + (mask.reshape(batch, -1, queries, keys) if mask.ndim == 3 else mask[None, None])
    if padding is not None:
        padding = mask_as_logits(~padding if padding.dtype is torch.bool else padding, torch.float32)
        logits = logits + padding.reshape(-1, 1, 1, keys)
    return logits


def _in_float32(arguments: Mapping[str, Any]) -> dict[str, Any]:
    """Return the arguments with tensors of low precision as float32, so that rows sum to 1."""
    return {
        name: given.float() if isinstance(given, Tensor) and given.dtype in (torch.bfloat16, torch.float16) else given
        for name, given in arguments.items()
    }
