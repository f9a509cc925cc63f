"""The attention function of all policies. It can pass its rows to a recorder, or to one for each call of a batch.

A row is the post-softmax probability of one query over all keys of its site. Rows leave `attend` in float32, before the
cast to the compute precision: probabilities rounded to bfloat16 sum to 1 only within 0.2 %.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from vla_attention.capture.recording.contributions import Projection

#: The reference's replacement for the logits of masked keys: so low that their probability is exactly 0.
MASKED_LOGIT = -2.3819763e38

#: Takes the logits (batch, head, query, key) of a call, float32 with masked keys at `MASKED_LOGIT`, and returns them
#: changed.
LogitChange = Callable[[Tensor], Tensor]
#: Takes the rows (batch, head, query, key) of a call.
RowSink = Callable[[Tensor], None]
#: Takes what each piece of the keys adds to the mixed values of a call, (batch, head, query, dim) by piece.
PieceSink = Callable[[Sequence[Tensor]], None]
#: Takes the values (batch, kv_head, key, dim) of a call, its projection to the residual stream, and its update of the
#: residual stream (batch, query, width).
UpdateSink = Callable[[Tensor, Projection, Tensor], None]


def attend_unseen(query: Tensor, key: Tensor, value: Tensor, mask: Tensor | None, scale: float) -> Tensor:
    """Return what `attend` does, up to rounding, through torch's fused attention: for calls that nobody records.

    The probabilities never exist as a whole. A call whose rows may be recorded must not come here, even when they are
    not recorded: recording would then change the actions in their last digits. Arguments and result are those of
    `attend`; every query needs an allowed key.
    """
    batch, heads, queries, dim = query.shape
    kv_heads = key.shape[1]
    if heads % kv_heads:
        raise ValueError(f"{heads} query heads cannot share {kv_heads} key heads evenly")
    stacked = query.reshape(batch, kv_heads, heads // kv_heads * queries, dim)
    if mask is not None:
        mask = mask[:, None] if mask.shape[1] == 1 else mask[:, None].repeat(1, 1, heads // kv_heads, 1)
    mixed = F.scaled_dot_product_attention(stacked, key, value, attn_mask=mask, scale=scale)
    return mixed.view(batch, heads, queries, value.shape[-1])


def attend(
    query: Tensor,
    key: Tensor,
    value: Tensor,
    mask: Tensor | None,
    scale: float,
    *,
    change: LogitChange | None = None,
    rows_to: RowSink | None = None,
    pieces: Sequence[slice] | None = None,
    pieces_to: PieceSink | None = None,
) -> Tensor:
    """Return softmax(scale · query · keyᵀ, masked) · value, and pass the probabilities to `rows_to`.

    Scaled dot-product attention (Vaswani et al. 2017, eq. 1) with grouped queries: head h uses the key/value head
    h // (heads / kv_heads). Logits and softmax are float32 for every input dtype. The probabilities are cast to the
    dtype of `value` for the value product only. The arithmetic does not depend on `rows_to` and `pieces_to`.

    Args:
        query: (batch, head, query, dim).
        key: (batch, kv_head, key, dim).
        value: (batch, kv_head, key, dim).
        mask: (batch, query or 1, key) bool, True for allowed keys, or None. A masked key gets exactly 0. A query
            without any allowed key gets a uniform row, as in the reference.
        scale: factor of the logits.
        change: an intervention on the logits, after the mask; None leaves them as they are.
        rows_to: called once with the float32 probabilities (batch, head, query, key).
        pieces: runs of keys, which do not overlap and hold all allowed keys. The value product is then made piece by
            piece and leaves out the keys between them; None makes it at once over all keys.
        pieces_to: called once with the value products of the pieces, if there are any.

    Returns:
        (batch, head, query, dim) in the dtype of `value`.

    Raises:
        ValueError: the query heads do not divide evenly among the key heads.
    """
    batch, heads, queries, dim = query.shape
    kv_heads, keys = key.shape[1], key.shape[2]
    if heads % kv_heads:
        raise ValueError(f"{heads} query heads cannot share {kv_heads} key heads evenly")
    # Heads that share a key head become extra queries of that head: one product, and no copies of the keys.
    stacked = (query.float() * scale).reshape(batch, kv_heads, heads // kv_heads * queries, dim)
    logits = torch.matmul(stacked, key.float().transpose(-1, -2)).view(batch, heads, queries, keys)
    if mask is not None:
        logits.masked_fill_(~mask[:, None], MASKED_LOGIT)
    if change is not None:
        logits = change(logits)
    rows = torch.softmax(logits, dim=-1)
    if rows_to is not None:
        rows_to(rows)
    shared = rows.to(value.dtype).view(batch, kv_heads, -1, keys)
    shape = (batch, heads, queries, value.shape[-1])
    if pieces is None:
        return torch.matmul(shared, value).view(shape)
    parts = [torch.matmul(shared[..., piece], value[:, :, piece]).view(shape) for piece in pieces]
    if pieces_to is not None:
        pieces_to(parts)
    mixed = parts[0]
    for part in parts[1:]:
        mixed = mixed + part
    return mixed


class RowCollector(Protocol):
    """Receives rows. A model asks it for a receiver at every block and denoise step.

    listens_to_modules: whether it hears of modules by hooks, which those of a compiled graph do not call.
    """

    listens_to_modules: bool = False

    def begin_call(self, allowed: Tensor, lasting: slice, pieces: Sequence[slice] | None) -> None:
        """Learn about the keys before the first denoise step; a model that does not know them does not call it.

        allowed: (key,) bool, keys that some action query may read. lasting: the keys whose values are the same at all
        denoise steps. pieces: the pieces of the value products that `piece_sink` gets.
        """
        return

    def begin_block(self, layer: int, denoise_step: int) -> None:
        """Learn that the model begins this block; models call it before everything else of the block."""
        return

    def sink(self, layer: int, denoise_step: int, action_queries: slice) -> RowSink | None:
        """Return the function that takes the rows of this call, or None if they are not wanted.

        action_queries: positions of the action queries on the query axis of the rows.
        """
        ...

    def piece_sink(self, layer: int, denoise_step: int, action_queries: slice) -> PieceSink | None:
        """Return the function that takes the value products of this call after its rows, or None."""
        return None

    def update_sink(self, layer: int, denoise_step: int, action_queries: slice) -> UpdateSink | None:
        """Return the function that takes the update of this call after its rows, or None if it is not wanted."""
        return None


@dataclass(frozen=True)
class CallKeys:
    """Whose queries an attention call of a site has, and which keys.

    Attributes:
        action_queries: positions of the action queries on the query axis.
        own_keys: positions on the key axis of the tokens that the queries belong to, in their order; None if these
            tokens are no keys of the call.
        numbers: the site's keys that the call's keys are, (key,) int64; None: all of them, in their order.
        in_prefix: whether the call comes before the first denoise step.
    """

    action_queries: slice
    own_keys: slice | None
    numbers: NDArray[np.int64] | None = None
    in_prefix: bool = False

    @classmethod
    def of_prefix(cls, tokens: NDArray[np.int64]) -> CallKeys:
        """The call whose queries and keys are these keys of the site, (token,)."""
        return cls(slice(0, 0), slice(0, len(tokens)), tokens, in_prefix=True)


class AttentionEditor(Protocol):
    """Changes the attention of one site during one replan. A model asks it for a change at every block."""

    def change(self, layer: int, denoise_step: int | None, call: CallKeys) -> LogitChange | None:
        """Return the change of a call, or None if nothing changes there; denoise_step: None in the prefix."""
        ...

    def finish(self) -> None:
        """Raise `QueryWithoutKeys` if the changes left a query without any key; called once, after the model."""


class FactorEditor(AttentionEditor, Protocol):
    """An editor that multiplies weights before normalising, the same at all layers, heads and denoise steps."""

    @property
    def changes_prefix(self) -> bool:
        """Whether anything changes in the calls before the first denoise step."""

    def factors(self, queries: int, call: CallKeys) -> NDArray[np.float64] | None:
        """Return the factors (query, key) in a call with `numbers` and so many queries; None where nothing changes."""


def log_factors(factors: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return what is added to logits for these factors of the weights before normalising; 0 for factors 0 and 1."""
    return np.log(np.where(factors > 0, factors, 1.0)).astype(np.float32)


@dataclass(frozen=True)
class BatchCollector(RowCollector):
    """Gives every member of a batch the rows and updates of its own call, as a batch of 1.

    each: one collector per member, in the order of the batch. The projection is the same for all: its gate depends on
    the denoise step only.
    """

    each: Sequence[RowCollector]

    def begin_block(self, layer: int, denoise_step: int) -> None:
        """Tell every member."""
        for collector in self.each:
            collector.begin_block(layer, denoise_step)

    def sink(self, layer: int, denoise_step: int, action_queries: slice) -> RowSink | None:
        """Return the function that shares out the rows of this call, or None if no member wants them."""
        sinks = [collector.sink(layer, denoise_step, action_queries) for collector in self.each]
        if all(sink is None for sink in sinks):
            return None

        def take(rows: Tensor) -> None:
            for member, sink in enumerate(sinks):
                if sink is not None:
                    sink(rows[member : member + 1])

        return take

    def update_sink(self, layer: int, denoise_step: int, action_queries: slice) -> UpdateSink | None:
        """Return the function that shares out the update of this call, or None if no member wants it."""
        sinks = [collector.update_sink(layer, denoise_step, action_queries) for collector in self.each]
        if all(sink is None for sink in sinks):
            return None

        def take(values: Tensor, project: Projection, update: Tensor) -> None:
            for member, sink in enumerate(sinks):
                if sink is not None:
                    of_member = slice(member, member + 1)
                    sink(values[of_member], project, update[of_member])

        return take


def split_heads(x: Tensor, head_dim: int) -> Tensor:
    """Split (batch, token, head · dim) into (batch, head, token, dim)."""
    return torch.unflatten(x, -1, (-1, head_dim)).transpose(1, 2)


def join_heads(x: Tensor) -> Tensor:
    """Join (batch, head, token, dim) into (batch, token, head · dim)."""
    return x.transpose(1, 2).flatten(2)
