"""Attention calls through `torch.nn.functional.multi_head_attention_forward`, as `nn.MultiheadAttention` makes them.

This function projects, attends and projects back in one. What it calls inside is seen too: the fused kernel, or, where
the weights are asked for, a softmax and its product with the values. Nothing is projected a second time.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
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
from vla_attention.capture.torch_policies.call_tensors import (
    ChangeRefused,
    LogitTensors,
    check_keys_left,
    fitted_change,
    mask_as_logits,
    normalised,
)
from vla_attention.capture.torch_policies.unseen_attention import UnseenAttention
from vla_attention.capture.torch_policies.watched_block import WatchedBlock

_FORWARD = torch.nn.functional.multi_head_attention_forward
FUNCTIONS: tuple[Callable[..., Any], ...] = (_FORWARD,)
_SIGNATURE = signature(_FORWARD)


def watch_call(
    block: WatchedBlock,
    run: Callable[..., tuple[Any, Sequence[InnerCall]]],
    args: tuple[Any, ...],
    kwargs: Mapping[str, Any],
) -> Any:
    """Run one call, changed if the watcher says so, and tell the watcher about it.

    run: the function; it returns its result, and what it called inside.
    """
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
        result, called = run(*args, **kwargs)
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
        changed = {"attn_mask": full.reshape(-1, query.shape[0], keys).to(query.dtype)}
        result, called = run(**{**given, **changed, "key_padding_mask": None, "is_causal": False})
    if not block.passes(shape):
        block.saw(AttentionCall(shape, MultiheadTensors(given, _kernel(called, heads))))
    return result


@dataclass(frozen=True)
class InnerCall:
    """What `multi_head_attention_forward` called: the function, its arguments by position, its result."""

    function: Any
    args: tuple[Any, ...]
    result: Tensor


@dataclass(frozen=True)
class MultiheadTensors:
    """The tensors of one call.

    Attributes:
        given: its arguments by name, without a change.
        kernel: what it computed inside, between its projections.
    """

    given: Mapping[str, Any]
    kernel: LogitTensors | _Weights

    @property
    def values(self) -> Tensor:
        """The values (batch, head, key, dim), as the call has projected them."""
        return self.kernel.values

    @property
    def outputs(self) -> Tensor:
        """What the call's kernel computed, (batch, head, query, dim), before the output projection."""
        return self.kernel.outputs

    def rows(self, queries: Positions, batch: Positions) -> Tensor:
        """Return float32 probabilities (batch, head, query, key) of these queries."""
        return self.kernel.rows(queries, batch)

    def allowed(self, queries: Positions) -> Tensor:
        """Return (batch, head or 1, query, key) bool."""
        given, (batch, heads, count, _) = self.given, self.kernel.outputs.shape
        keys = given["key"].shape[0] if given["static_k"] is None else given["static_k"].shape[1]
        seen = _mask_logits(given, batch, heads, count, keys) > MASKED_BELOW
        extra = (given["bias_k"] is not None) + bool(given["add_zero_attn"])
        seen = torch.nn.functional.pad(seen.expand(batch, -1, count, keys), (0, extra), value=True)
        return seen[:, :, position_numbers(queries, count, seen.device)]


@dataclass(frozen=True)
class _Weights:
    """A softmax and its product with the values.

    Attributes:
        logits, probabilities: (batch, head, query, key), with masks and a change.
        values: (batch, head, key, dim).
        outputs: (batch, head, query, dim).
    """

    logits: Tensor
    probabilities: Tensor
    values: Tensor
    outputs: Tensor

    def rows(self, queries: Positions, batch: Positions) -> Tensor:
        """Return float32 probabilities (batch, head, query, key) of these queries."""
        # Rounded to the compute precision, probabilities would not sum to 1.
        exact = torch.finfo(self.probabilities.dtype).bits >= 32
        rows = at_positions(at_positions(self.probabilities if exact else self.logits, 0, batch), 2, queries)
        # Where every key is masked, nn.MultiheadAttention gives no numbers.
        return torch.nan_to_num(rows.float()) if exact else normalised(rows.float())


def _kernel(called: Sequence[InnerCall], heads: int) -> LogitTensors | _Weights:
    """Return what was computed between the projections, of what the function called.

    Raises:
        UnseenAttention: this version of torch computes it otherwise than those that are known.
    """

    def apart(tensor: Tensor) -> Tensor:
        return tensor.detach().reshape(-1, heads, *tensor.shape[1:])

    # Where every function of torch is looked at, it calls itself once more.
    called = [call for call in called if call.function not in FUNCTIONS]
    names = [call.function.__name__ for call in called]
    if names[-1:] == ["scaled_dot_product_attention"]:
        query, key, values, mask, _, causal = called[-1].args
        query, key, values = query.detach(), key.detach(), values.detach()
        scale = query.shape[-1] ** -0.5
        return LogitTensors(query, key, values, called[-1].result.detach(), mask, causal, scale, change=None)
    if names[-2:] == ["softmax", "bmm"]:
        softmax, product = called[-2:]
        return _Weights(apart(softmax.args[0]), apart(softmax.result), apart(product.args[1]), apart(product.result))
    raise UnseenAttention(
        f"nn.MultiheadAttention of torch {torch.__version__} computes attention otherwise than in the versions that "
        "can be recorded (2.7 to 2.13). Report it with this version."
    )


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
