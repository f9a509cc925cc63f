"""Attention calls through `torch.nn.attention.flex_attention`.

The mode sees the operator below it, which gets the score function and the block mask's tensors. Run eager, it applies
the mask function to every key, whatever the blocks say.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor
from torch._higher_order_ops.flex_attention import flex_attention as flex_operator

from vla_attention.capture.torch_policies.attention_calls import (
    AttentionCall,
    Positions,
    at_positions,
    position_numbers,
)
from vla_attention.capture.torch_policies.call_changes import check_keys_left, fitted_change
from vla_attention.capture.torch_policies.call_tensors import normalised, query_key_logits
from vla_attention.capture.torch_policies.watched_block import WatchedBlock

FUNCTIONS: tuple[Callable[..., Any], ...] = (flex_operator,)


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

    def value(self) -> Tensor:
        """Return the values (batch, kv_head, key, dim)."""
        return self.values

    def output(self) -> Tensor:
        """Return what the kernel computed, (batch, head, query, dim)."""
        return self.outputs

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


def watch_call(
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
    score = given["score_mod"] or _same_score
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


def _same_score(score: Tensor, *places: Any) -> Tensor:
    return score


def _over_places(function: Callable[..., Tensor], with_score: bool) -> Callable[..., Tensor]:
    """Apply a score or mask function of single places to all of (batch, head, query, key) at once."""

    def broadcast(*arguments: Any) -> Tensor:
        first, rest = (arguments[:1], arguments[1:]) if with_score else ((), arguments)
        places, buffers = rest[:4], rest[4:]
        mapped = function
        own: tuple[int | None, ...] = (0,) if with_score else ()
        for axis in (3, 2, 1, 0):
            dims: tuple[int | None, ...] = tuple(0 if number == axis else None for number in range(4))
            mapped = torch.vmap(mapped, in_dims=(*own, *dims, *(None for _ in buffers)))
        return mapped(*first, *places, *buffers)

    return broadcast
