"""Whether the rows of a batch are apart in a policy's actions, of a policy call that the user can repeat.

Where a kernel is given (batch · head, query, dim), nothing in the shapes tells which of the two is the outer axis: with
the heads outside, rows of one environment would be stored as another's. Recorded calls tell it by what each row adds to
the residual stream (`replan_contributions.py`). Here the attention of the first row alone is changed.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from vla_attention.capture.torch_policies.attention_calls import AttentionCall, CallShape
from vla_attention.capture.torch_policies.call_order import CallOrder, KnownCalls
from vla_attention.capture.torch_policies.call_tensors import ChangeRefused
from vla_attention.capture.torch_policies.own_setting import arrays_of
from vla_attention.capture.torch_policies.policy_layout import PolicyLayout
from vla_attention.capture.torch_policies.watch import RandomNumbers, watch_attention
from vla_attention.schemas.errors import BadArgument


class BatchRowsMixed(BadArgument):
    """A policy whose rows of a batch are not apart in its attention calls."""


#: The weight of the last key of a changed row, as a factor; the first key's stays, those between follow.
_LOWEST_FACTOR = 0.05
#: Largest change of the other rows' actions, relative to that of the changed row's. Other kernels are no reason: both
#: calls are made with a mask.
_TOLERANCE = 1e-3


class _RowChanged:
    """A watcher that changes the calls of the layout's sites in the first row of their batch.

    factor: that of the last key's weight; 1 for a change that changes nothing.
    """

    def __init__(self, layout: PolicyLayout, policy: str, factor: float) -> None:
        self.batches: set[int] = set()
        self._order = CallOrder(KnownCalls(layout), policy)
        self._factor = factor

    def change(self, shape: CallShape) -> Tensor | None:
        place = self._order.place(shape)
        if place is None or place.site is None:
            return None
        added = torch.zeros(shape.batch, 1, 1, shape.keys)
        added[0] = torch.linspace(0, float(np.log(self._factor)), shape.keys)
        return added

    def saw(self, call: AttentionCall) -> None:
        place = self._order.place(call.shape)
        self._order.ran(call.shape, place)
        if place is not None and place.site is not None:
            self.batches.add(call.shape.batch)


def rows_apart(policy: object, layout: PolicyLayout, call: Callable[[], Any]) -> str:
    """Make a policy call of several rows twice, the second time with the first row changed; return what was found.

    call: can be repeated; those of the arrays that it returns which are actions begin with the batch. The states of
    torch's random numbers are as before the first call afterwards.

    Raises:
        BatchRowsMixed: the change of the first row changed the actions of another.
    """
    random, results = RandomNumbers(), []
    for factor in (1.0, _LOWEST_FACTOR):
        watcher = _RowChanged(layout, type(policy).__name__, factor)
        try:
            with watch_attention(policy, watcher):
                results.append(arrays_of(call()))
        except ChangeRefused as error:
            return f"not known ({error})"
        finally:
            random.again()
        batch = max(watcher.batches, default=1)
        if batch == 1:
            return "one"
    pairs = [
        (unchanged, changed)
        for unchanged, changed in zip(*results, strict=False)
        if unchanged.ndim and len(unchanged) == batch and unchanged.shape == changed.shape
    ]
    moved = [np.abs(unchanged - changed).reshape(batch, -1).max(axis=1, initial=0) for unchanged, changed in pairs]
    if len(watcher.batches) > 1 or not moved or not (first_moved := max(rows[0] for rows in moved)) > 0:
        return "not known (the call returns no actions by row, or they do not change)"
    others = max(rows[1:].max() for rows in moved)
    if others > _TOLERANCE * first_moved:
        raise BatchRowsMixed(
            f"The rows of a batch of {batch} are not apart: a change of the attention of row 0 changed the actions of "
            f"other rows by {others:.2g} (its own by {first_moved:.2g}). Where a policy folds heads and batch into one "
            "axis, the heads may be outside, and then a batch cannot be taken apart: record one environment at a time, "
            "with run.episode, and give own_setting a call of one row."
        )
    return f"apart ({batch} rows)"
